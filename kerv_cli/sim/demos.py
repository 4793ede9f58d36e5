"""Demonstrations: scripted experts, recorded to disk with clean labels, and read back.

Half of the episodes (by default) are executed with noise, so that states beside the expert's path are visited; the
labels are the clean expert's actions at the visited states all the same. Only successful episodes are kept.

On disk: `recording.json` (what is being recorded), `episodes/<task>/<seed:06d>.safetensors`, `failed/<task>/<seed>.json`
and, when all is done, `manifest.json`.
"""

from __future__ import annotations

import hashlib
import io
import json
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kerv_cli.errors import CheckpointError, KervError, UsageError
from kerv_cli.files import atomic_path, read_json, sha256_of, write_json
from kerv_cli.sim.camera import CameraConfig, choose_backend
from kerv_cli.sim.tasks import resolve_tasks
from kerv_cli.sim.world import ACTION_SIZE, MAX_HORIZON, STATE_SIZE, Expert, Observation, World

MAX_TRAINING_SEED = 99_999
"""Demonstrations use seeds up to this one; evaluation starts at 100000, so the two never meet."""
FORMAT = 1
_SEEDS_PER_JOB = 5
_EXTRA_ATTEMPTS = 20
"""Seeds tried beyond the requested range: this many, plus one per requested episode."""


@dataclass(frozen=True)
class DemoConfig:
    """What to record.

    Attributes:
        tasks: tasks and suites.
        episodes: successful episodes per task.
        first_seed: seeds start here, per task.
        perturbed: fraction of episodes executed with noise; which ones follows from the seed.
        noise_low, noise_high: range of the Gaussian noise's standard deviation on xyz, drawn once per episode.
        burst_probability: chance per step that a burst starts: 3 to 8 steps in one random direction.
        camera: the frames' view.
        frame_stride: control steps per recorded frame.
        tail: labels recorded beyond success, so that an action chunk that starts near the end has true labels.
        workers: processes; changes nothing in the result.
        horizon: control steps within which the expert must succeed.
    """

    tasks: tuple[str, ...]
    episodes: int
    first_seed: int = 0
    perturbed: float = 0.5
    noise_low: float = 0.2
    noise_high: float = 0.6
    burst_probability: float = 0.02
    camera: CameraConfig = field(default_factory=CameraConfig)
    frame_stride: int = 1
    tail: int = 8
    workers: int = 2
    horizon: int = MAX_HORIZON

    def __post_init__(self) -> None:
        object.__setattr__(self, "tasks", resolve_tasks(self.tasks))
        wrong = [
            text
            for bad, text in (
                (not self.tasks, "tasks must name at least one task"),
                (self.episodes < 1, f"episodes must be 1 or more, not {self.episodes}"),
                (self.first_seed < 0, f"first_seed must be 0 or more, not {self.first_seed}"),
                (not 0.0 <= self.perturbed <= 1.0, f"perturbed must lie between 0 and 1, not {self.perturbed}"),
                (not 0.0 <= self.noise_low <= self.noise_high, "noise must satisfy 0 <= noise_low <= noise_high"),
                (not 0.0 <= self.burst_probability <= 1.0, "burst_probability must lie between 0 and 1"),
                (self.frame_stride < 1, f"frame_stride must be 1 or more, not {self.frame_stride}"),
                (not 0 <= self.tail < MAX_HORIZON, f"tail must lie between 0 and {MAX_HORIZON - 1}, not {self.tail}"),
                (self.workers < 1, f"workers must be 1 or more, not {self.workers}"),
                (not 1 <= self.horizon <= MAX_HORIZON, f"horizon must lie between 1 and {MAX_HORIZON}"),
                (
                    self.first_seed + self.episodes - 1 > MAX_TRAINING_SEED,
                    f"training seeds end at {MAX_TRAINING_SEED}: seeds from 100000 on belong to evaluation",
                ),
            )
            if bad
        ]
        if wrong:
            raise UsageError(f"demonstrations: {wrong[0]}")

    @property
    def seed_limit(self) -> int:
        """One past the last seed that may be tried when experts fail."""
        return min(self.first_seed + 2 * self.episodes + _EXTRA_ATTEMPTS, MAX_TRAINING_SEED + 1)


@dataclass(frozen=True)
class DemoEpisode:
    """One successful episode of T control steps (up to and including the first success).

    Attributes:
        task, seed, perturbed: which episode, and whether its execution was noisy.
        steps: T.
        frames: (n, size, size, 3) uint8, the frames before the actions of `frame_steps`.
        frame_steps: (n,) int64.
        states: (T, 39) float32, privileged state before each action.
        labels: (T + tail, 4) float32, the clean expert's clipped actions; the last `tail` lie beyond the success.
        executed: (T, 4) float32, the actions that moved the robot.
        rand_vec: (3,) or (6,) float64, object and goal placement.
    """

    task: str
    seed: int
    perturbed: bool
    steps: int
    frames: NDArray[np.uint8]
    frame_steps: NDArray[np.int64]
    states: NDArray[np.float32]
    labels: NDArray[np.float32]
    executed: NDArray[np.float32]
    rand_vec: NDArray[np.float64]

    @property
    def end_effector(self) -> NDArray[np.float32]:
        """(T, 3) float32: the hand's position in metres before each action."""
        return self.states[:, :3]


def is_perturbed(seed: int, fraction: float) -> bool:
    """Whether the episode of this seed is executed with noise: spreads `fraction` evenly over consecutive seeds."""
    return int((seed + 1) * fraction) > int(seed * fraction)


class Perturbation:
    """Noise on the executed action: Gaussian on xyz, now and then a burst in one direction. The gripper stays clean."""

    def __init__(self, config: DemoConfig, task: str, seed: int) -> None:
        """Fixed by task and seed alone."""
        self._random = np.random.default_rng([seed, *task.encode()])
        self.sigma = float(self._random.uniform(config.noise_low, config.noise_high))
        self._burst_probability = config.burst_probability
        self._burst_left = 0
        self._direction = np.zeros(3)

    def __call__(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """The action to execute, (4,) in [-1, 1], for the clean `action`."""
        noise = self._random.normal(0.0, self.sigma, size=3)
        if self._burst_left == 0 and self._random.random() < self._burst_probability:
            self._burst_left = int(self._random.integers(3, 9))
            direction = self._random.normal(size=3)
            self._direction = direction / np.linalg.norm(direction)
        xyz = action[:3] + noise
        if self._burst_left > 0:
            self._burst_left -= 1
            xyz = self._direction
        return np.append(np.clip(xyz, -1.0, 1.0), action[3])


def run_expert(world: World, seed: int, config: DemoConfig) -> DemoEpisode | None:
    """Runs one episode; None when the expert did not succeed within the horizon.

    An episode also counts as failed when its tail would not fit the simulator's 500 steps.
    """
    expert = Expert(world.task)
    perturbed = is_perturbed(seed, config.perturbed)
    perturb = Perturbation(config, world.task, seed) if perturbed else None
    observation = world.reset(seed)
    states, labels, executed, frames, frame_steps = [], [], [], [], []
    last_step = min(config.horizon, MAX_HORIZON - config.tail)
    while not observation.success:
        if observation.step >= last_step:
            return None
        if observation.step % config.frame_stride == 0:
            frames.append(world.frame())
            frame_steps.append(observation.step)
        label = expert(observation)
        action = perturb(label) if perturb else label
        states.append(observation.state)
        labels.append(label)
        executed.append(action)
        observation = world.step(action)
    labels += _tail_labels(world, expert, observation, config.tail)
    return DemoEpisode(
        task=world.task,
        seed=seed,
        perturbed=perturbed,
        steps=len(states),
        frames=np.stack(frames),
        frame_steps=np.array(frame_steps, dtype=np.int64),
        states=np.array(states, dtype=np.float32),
        labels=np.array(labels, dtype=np.float32),
        executed=np.array(executed, dtype=np.float32),
        rand_vec=world.rand_vec,
    )


def _tail_labels(world: World, expert: Expert, observation: Observation, tail: int) -> list[NDArray[np.float64]]:
    labels = []
    for _ in range(tail):
        labels.append(expert(observation))
        observation = world.step(labels[-1])
    return labels


def save_episode(path: Path, episode: DemoEpisode) -> None:
    """Writes one episode, atomically; frames as PNG bytes, end to end, with n + 1 offsets.

    Raises:
        StorageError: the disk refused.
    """
    from safetensors.numpy import save_file

    pictures = [_encode_png(frame) for frame in episode.frames]
    offsets = np.cumsum([0, *map(len, pictures)], dtype=np.int64)
    tensors = {
        "png": np.frombuffer(b"".join(pictures), dtype=np.uint8),
        "png_offsets": offsets,
        "frame_steps": episode.frame_steps,
        "states": episode.states,
        "labels": episode.labels,
        "executed": episode.executed,
        "rand_vec": episode.rand_vec,
    }
    metadata = {
        "format": str(FORMAT),
        "task": episode.task,
        "seed": str(episode.seed),
        "perturbed": str(episode.perturbed).lower(),
        "steps": str(episode.steps),
        "frame_size": str(episode.frames.shape[1]),
    }
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata=metadata)


def load_episode(path: Path) -> DemoEpisode:
    """Reads one episode.

    Raises:
        CheckpointError: the file is missing, damaged or of another format.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != str(FORMAT):
                raise CheckpointError(f"{path} is not a demonstration episode of format {FORMAT}")
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        return _episode_from(arrays, metadata)
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise CheckpointError(f"{path} is missing or damaged: {error}") from error


def read_metadata(path: Path) -> dict[str, str]:
    """The text that an episode file carries: task, seed, perturbed, steps, frame_size. Reads no array.

    Raises:
        CheckpointError: the file is missing or damaged.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            return dict(file.metadata() or {})
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} is missing or damaged: {error}") from error


def _episode_from(arrays: Mapping[str, NDArray[Any]], metadata: Mapping[str, str]) -> DemoEpisode:
    offsets = arrays["png_offsets"]
    png = arrays["png"].tobytes()
    frames = [_decode_png(png[start:end]) for start, end in zip(offsets[:-1], offsets[1:], strict=True)]
    steps = int(metadata["steps"])
    if arrays["states"].shape != (steps, STATE_SIZE) or arrays["executed"].shape != (steps, ACTION_SIZE):
        raise ValueError(f"arrays do not hold {steps} steps")
    return DemoEpisode(
        task=metadata["task"],
        seed=int(metadata["seed"]),
        perturbed=metadata["perturbed"] == "true",
        steps=steps,
        frames=np.stack(frames),
        frame_steps=arrays["frame_steps"],
        states=arrays["states"],
        labels=arrays["labels"],
        executed=arrays["executed"],
        rand_vec=arrays["rand_vec"],
    )


def _encode_png(frame: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()


def _decode_png(data: bytes) -> NDArray[np.uint8]:
    from PIL import Image

    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image)


def record(
    config: DemoConfig, out: Path, on_progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Records demonstrations into the folder `out`; a killed run goes on where it stopped.

    Args:
        config: what to record.
        out: the dataset's folder.
        on_progress: called with (episodes done, episodes wanted).

    Returns:
        The manifest, as written to `out/manifest.json`. Where a task's expert failed too often, fewer episodes than
        requested are kept, and the manifest's `missing` says how many are not there.

    Raises:
        UsageError: `out` holds demonstrations of another configuration.
        RenderingUnavailable: no frame can be drawn here.
        StorageError: the disk refused.
        KervError: a task's expert never succeeded.
    """
    out = Path(out)
    choose_backend()
    identity = _identity(config)
    _claim_folder(out, identity)
    kept: dict[str, list[int]] = {task: [] for task in config.tasks}
    failed: dict[str, list[int]] = {task: [] for task in config.tasks}
    wanted = {task: range(config.first_seed, config.first_seed + config.episodes) for task in config.tasks}
    total = config.episodes * len(config.tasks)
    while any(wanted.values()):
        jobs = [
            (task, tuple(seeds[start : start + _SEEDS_PER_JOB]))
            for task, seeds in wanted.items()
            for start in range(0, len(seeds), _SEEDS_PER_JOB)
        ]
        for task, outcomes in _run_jobs(config, out, jobs):
            kept[task] += [seed for seed, success in outcomes if success]
            failed[task] += [seed for seed, success in outcomes if not success]
            if on_progress is not None:
                on_progress(sum(map(len, kept.values())), total)
        wanted = {task: _next_seeds(config, len(kept[task]), wanted[task]) for task in config.tasks}
    empty = [task for task, seeds in kept.items() if not seeds]
    if empty:
        raise KervError(f"no expert episode succeeded for {', '.join(empty)}")
    manifest = {**identity, "tasks": {task: _task_summary(out, config, task, kept[task], failed[task]) for task in kept}}
    manifest["episodes"] = sum(len(seeds) for seeds in kept.values())
    manifest["missing"] = total - manifest["episodes"]
    manifest["sha256"] = _dataset_hash(manifest["tasks"])
    write_json(out / "manifest.json", manifest)
    return manifest


def _next_seeds(config: DemoConfig, kept: int, tried: range) -> range:
    # One new seed per failure, in order: the outcome does not depend on how the work was divided.
    return range(tried.stop, min(tried.stop + config.episodes - kept, config.seed_limit))


def _identity(config: DemoConfig) -> dict[str, Any]:
    settings = json.loads(json.dumps(asdict(config)))
    del settings["workers"]
    versions = {name: version(name) for name in ("metaworld", "mujoco", "numpy")}
    return {"format": FORMAT, "config": settings, "versions": {**versions, "python": platform.python_version()}}


def _claim_folder(out: Path, identity: dict[str, Any]) -> None:
    path = out / "recording.json"
    if not path.exists():
        write_json(path, identity)
        return
    there = read_json(path)
    for section in identity:
        if there.get(section) != identity[section]:
            changed = _first_difference(there.get(section), identity[section])
            raise UsageError(f"{out} holds other demonstrations ({section}{changed}): choose another folder")


def _first_difference(there: Any, here: Any) -> str:
    if not isinstance(there, dict) or not isinstance(here, dict):
        return f": {there} there, {here} here"
    key = next(key for key in [*there, *here] if there.get(key) != here.get(key))
    return f".{key}{_first_difference(there.get(key), here.get(key))}"


def _run_jobs(
    config: DemoConfig, out: Path, jobs: Sequence[tuple[str, tuple[int, ...]]]
) -> Iterator[tuple[str, list[tuple[int, bool]]]]:
    if config.workers == 1 or len(jobs) == 1:
        try:
            for task, seeds in jobs:
                yield _record_seeds(config, out, task, seeds)
        finally:
            _release_world()
        return
    from joblib import Parallel, delayed, parallel_config

    # loky starts fresh interpreters: a fork after this process has drawn would deadlock in the GL driver.
    with parallel_config(backend="loky", n_jobs=min(config.workers, len(jobs)), inner_max_num_threads=1):
        work = (delayed(_record_seeds)(config, out, task, seeds) for task, seeds in jobs)
        yield from Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs")(work)


_world: World | None = None


def _record_seeds(
    config: DemoConfig, out: Path, task: str, seeds: Sequence[int]
) -> tuple[str, list[tuple[int, bool]]]:
    """In a worker: brings each seed's outcome to disk, unless it is there already; returns (seed, success) pairs."""
    outcomes = []
    for seed in seeds:
        path, failure = episode_path(out, task, seed), out / "failed" / task / f"{seed:06d}.json"
        if not failure.exists() and not _is_valid(path, task, seed):
            episode = run_expert(_world_for(task, config), seed, config)
            if episode is None:
                write_json(failure, {"task": task, "seed": seed, "perturbed": is_perturbed(seed, config.perturbed)})
            else:
                save_episode(path, episode)
        outcomes.append((seed, not failure.exists()))
    return task, outcomes


def _world_for(task: str, config: DemoConfig) -> World:
    global _world
    if _world is None or (_world.task, _world.camera) != (task, config.camera):
        _release_world()
        _world = World(task, config.camera)
    return _world


def _release_world() -> None:
    global _world
    if _world is not None:
        _world.close()
    _world = None


def episode_path(out: Path, task: str, seed: int) -> Path:
    """Where an episode lies within a dataset's folder."""
    return Path(out) / "episodes" / task / f"{seed:06d}.safetensors"


def _is_valid(path: Path, task: str, seed: int) -> bool:
    if not path.exists():
        return False
    try:
        episode = load_episode(path)
    except CheckpointError:
        return False
    return (episode.task, episode.seed) == (task, seed)


def _task_summary(
    out: Path, config: DemoConfig, task: str, kept: Sequence[int], failed: Sequence[int]
) -> dict[str, Any]:
    episodes = []
    for seed in sorted(kept):
        path = episode_path(out, task, seed)
        steps = read_metadata(path)["steps"]
        episodes.append(
            {
                "seed": seed,
                "perturbed": is_perturbed(seed, config.perturbed),
                "steps": int(steps),
                "bytes": path.stat().st_size,
                "sha256": sha256_of(path),
            }
        )
    mean = sum(episode["steps"] for episode in episodes) / len(episodes)
    return {"mean_steps": round(mean, 2), "failed_seeds": sorted(failed), "episodes": episodes}


def _dataset_hash(tasks: Mapping[str, Any]) -> str:
    digest = hashlib.sha256()
    for task, summary in sorted(tasks.items()):
        for episode in summary["episodes"]:
            digest.update(f"{task} {episode['seed']} {episode['sha256']}\n".encode())
    return digest.hexdigest()
