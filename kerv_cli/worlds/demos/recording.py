"""Record demonstrations: scripted experts solve tasks, and each episode is saved to disk.

By default, half of the episodes are executed with noise, so that they visit states off the expert's path. The recorded
labels are still the expert's actions without noise. Only successful episodes are kept.

Instead of the expert, an *actor* such as a policy can move the robot. Then the expert only labels the states that the
actor visits (DAgger, Ross et al. 2011), and every episode is kept.

On disk: `recording.json` (configuration and versions), `episodes/<task>/<seed:06d>.safetensors`,
`failed/<task>/<seed:06d>.json` and, when the recording is complete, `manifest.json`.
"""

from __future__ import annotations

import contextlib
import json
import platform
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.files import read_mapping, write_json
from kerv_cli.base.limits import check_settings, limits, number
from kerv_cli.base.manifests import read
from kerv_cli.base.processes import Workers
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.worlds import resolve_tasks, spec_of
from kerv_cli.worlds.demos.dataset import FORMAT, DemoManifest, EpisodeEntry, OnProgress, episode_path, totals
from kerv_cli.worlds.demos.files import DemoEpisode, load_episode
from kerv_cli.worlds.mujoco_world import choose_backend
from kerv_cli.worlds.settings import CameraSettings
from kerv_cli.worlds.spec import EnvironmentSpec, World
from kerv_cli.worlds.vectors import unit_vector

_SEEDS_PER_JOB = 10  # seeds of a job share one simulator
_EXTRA_SEEDS = 20  # of a task, plus one per requested episode, to replace failed seeds


@dataclass(frozen=True)
class DemoConfig:
    """What to record."""

    tasks: tuple[str, ...]
    episodes: int = field(metadata=limits(1))  # number of successful episodes per task
    first_seed: int = 0  # first seed of every task. It must be a training seed.
    # share of episodes that are executed with noise. `is_perturbed` chooses these episodes.
    perturbed: float = number(0.5, 0, 1)
    # 0: noise in every control step. Else only bursts of noise, each followed by this many control steps without noise.
    quiet: int = number(0, 0)
    camera: CameraSettings = field(default_factory=CameraSettings)
    frame_stride: int = number(1, 1)  # record an image at every n-th control step
    # number of labels to record after the success. Action chunks that begin near the end need them.
    tail: int = number(8, 0)
    workers: int = number(2, 1)  # number of processes. The result does not depend on it.
    horizon: int = 0  # control steps within which the expert must succeed. 0 stands for the environment's default.
    policy: str = ""  # hash of the actor's method and weights. Empty if the expert moves the robot.
    expert_share: float = number(0.0, 0, 1)  # probability that the expert, not the actor, executes a chunk of actions

    def __post_init__(self) -> None:
        object.__setattr__(self, "tasks", resolve_tasks(self.tasks))
        object.__setattr__(self, "camera", self.spec.camera(self.camera))
        object.__setattr__(self, "horizon", self.spec.control_steps(self.horizon, self.tasks))
        self.spec.check_experts(self.tasks)
        check_settings(self, "demonstrations")
        ends = self.first_seed, self.first_seed + self.episodes - 1
        self.spec.seeds.check(ends, "training", "demonstrations")

    @property
    def spec(self) -> EnvironmentSpec:
        return spec_of(self.tasks[0])


# makes what moves the robot instead of the expert, a `PolicyActor`; called in the process that records: picklable
MakeActor = Callable[[DemoConfig], Any]


def run_expert(world: World, seed: int, config: DemoConfig, actor: Any) -> DemoEpisode | None:
    """Run one episode and label every state with the expert's action. An actor's episode is always returned.

    Without an actor, return None if the expert did not succeed within `config.horizon` steps, or only when fewer than
    `config.tail` steps were left.
    """
    expert = world.spec.expert(world.task)
    observation = world.reset(seed)
    noisy = is_perturbed(seed, config.perturbed)
    act: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    if actor is not None:
        actor.reset(world, seed)
        act = actor.act
    elif noisy:
        act = Perturbation(world.task, seed, world.spec.actions, config.quiet)
    states, labels, executed, frames, frame_steps = [], [], [], [], []
    last_step = min(config.horizon, world.horizon - config.tail)
    while not world.success and world.steps < last_step:
        if world.steps % config.frame_stride == 0:
            frames.append(world.frame())
            frame_steps.append(world.steps)
        states.append(observation.state)
        labels.append(expert(observation))
        executed.append(act(labels[-1]) if act else labels[-1])
        observation = world.step(executed[-1])
    if not world.success and actor is None:
        return None
    for _ in range(config.tail):
        labels.append(expert(observation))
        observation = world.step(labels[-1])
    return DemoEpisode(
        task=world.task,
        seed=seed,
        perturbed=actor is not None or noisy,
        steps=len(states),
        frames=np.stack(frames),
        frame_steps=np.array(frame_steps, dtype=np.int64),
        states=np.array(states, dtype=np.float32),
        labels=np.array(labels, dtype=np.float32),
        executed=np.array(executed, dtype=np.float32),
        initial_state=world.initial_state,
    )


def record(
    config: DemoConfig,
    out: Path,
    on_progress: OnProgress = lambda done, total: None,
    make_actor: MakeActor | None = None,
) -> DemoManifest:
    """Record demonstrations into a folder, or continue an interrupted recording.

    If the expert fails for a seed, the next seed after the requested range replaces that seed. If too many seeds fail,
    the dataset is smaller. The episodes do not depend on the number of workers.
    """
    config.spec.check_installed()
    choose_backend()
    identity, begun = check_recording(config, out), out / "recording.json"
    if not begun.exists():
        write_json(begun, identity)
    entries: dict[str, list[EpisodeEntry]] = {task: [] for task in config.tasks}
    failed: dict[str, list[int]] = {task: [] for task in config.tasks}
    seeds = dict.fromkeys(config.tasks, range(config.first_seed, config.first_seed + config.episodes))
    limit = min(config.first_seed + 2 * config.episodes + _EXTRA_SEEDS, config.spec.seeds.training.stop)
    while any(seeds.values()):
        jobs = []
        for task, block in seeds.items():
            firsts = range(0, len(block), _SEEDS_PER_JOB)
            jobs += [(task, block[first : first + _SEEDS_PER_JOB]) for first in firsts]
        for task, outcomes in _run_jobs(config, out, jobs, make_actor):
            for seed, entry in outcomes.items():
                if entry is None:
                    failed[task].append(seed)
                else:
                    entries[task].append(entry)
            on_progress(sum(map(len, entries.values())), config.episodes * len(config.tasks))
        # one new seed per failure, in order, so that the result does not depend on the number of workers
        for task, block in seeds.items():
            stop = block.stop + config.episodes - len(entries[task])
            seeds[task] = range(block.stop, min(stop, limit))
    empty = [task for task, rows in entries.items() if not rows]
    if empty:
        raise KervError(f"no expert episode succeeded within {config.horizon} steps for {', '.join(empty)}")
    missing = config.episodes * len(config.tasks) - sum(map(len, entries.values()))
    manifest = {**identity, **totals(entries, failed, missing)}
    write_json(out / "manifest.json", manifest)
    return read(DemoManifest, manifest, str(out / "manifest.json"))


def _identity(config: DemoConfig) -> dict[str, Any]:
    settings = asdict(config) | {"noise_low": SIGMA[0], "noise_high": SIGMA[1], "burst_probability": BURST_PROBABILITY}
    del settings["workers"]
    if not config.quiet:  # left out, so that recordings from before it existed can be resumed
        del settings["quiet"]
    spec = config.spec
    experts = {task: spec.experts[task] for task in config.tasks if task in spec.experts}
    if experts:
        settings["experts"] = experts
    identity = {
        "format": FORMAT,
        "environment": spec.name,
        "actions": spec.actions.as_dict(),
        "observation": asdict(spec.observation),
        "config": settings,
        "versions": {name: version(name) for name in (*spec.packages, "numpy")} | {"python": platform.python_version()},
    }
    return dict(json.loads(json.dumps(identity)))  # turns tuples into lists, as in the file


def check_recording(config: DemoConfig, out: Path) -> dict[str, Any]:
    """Refuse a folder with demonstrations of another configuration. Return the manifest's fields known so far."""

    def flat(one: dict[str, Any]) -> dict[str, Any]:
        # Another Python or numpy may resume a recording. Another simulator version may have other physics.
        versions = one.get("versions", {})
        return {
            "quiet": 0,
            **one,
            **one.get("config", {}),
            **{name: versions.get(name) for name in packages},
            "versions": {},
        }

    identity, packages, path = _identity(config), config.spec.packages, out / "recording.json"
    new, old = flat(identity), flat(read_mapping(path) if path.exists() else identity)
    for key in [*new, *old]:
        if key != "config" and new.get(key) != old.get(key):
            raise UsageError(
                f"{out} holds demonstrations with {key}={old.get(key)}, not {new.get(key)}: "
                "give these another name=; demos=A+B joins both"
            )
    return identity


_Outcomes = dict[int, EpisodeEntry | None]  # seed -> the manifest's entry, None if the expert failed


def _run_jobs(
    config: DemoConfig, out: Path, jobs: Sequence[tuple[str, range]], make_actor: MakeActor | None
) -> Iterator[tuple[str, _Outcomes]]:
    if config.workers == 1 or len(jobs) == 1:
        yield from (_record_seeds(config, out, task, seeds, make_actor) for task, seeds in jobs)
        return
    pool = Workers(min(config.workers, len(jobs)))
    try:
        work = [pool.submit(_record_seeds, config, out, task, seeds, make_actor) for task, seeds in jobs]
        pool.submit(int)  # wakes the pool's thread, which may not watch the process that was started last
        for done in as_completed(work):
            yield done.result()
    except BrokenProcessPool as error:
        raise KervError("a worker process was killed: run the same command again to go on") from error
    finally:
        pool.kill()


def _record_seeds(
    config: DemoConfig, out: Path, task: str, seeds: Sequence[int], make_actor: MakeActor | None
) -> tuple[str, _Outcomes]:
    actor, outcomes = make_actor(config) if make_actor else None, _Outcomes()
    # the world also runs the tail, so a short horizon leaves it the task's own
    horizon = max(config.horizon, config.spec.control_steps(0, [task]))
    with config.spec.open_world(task, config.camera, horizon) as world:
        for seed in seeds:
            path, failure = episode_path(out, world.task, seed), out / "failed" / world.task / f"{seed:06d}.json"
            outcomes[seed] = None
            if failure.exists():
                continue
            with contextlib.suppress(CheckpointError):  # missing or damaged: record it again
                outcomes[seed] = EpisodeEntry.of(path, load_episode(path))
                continue
            recorded = run_expert(world, seed, config, actor)
            if recorded is None:
                perturbed = is_perturbed(seed, config.perturbed)
                write_json(failure, {"task": world.task, "seed": seed, "perturbed": perturbed})
            else:
                outcomes[seed] = EpisodeEntry.saved(out, recorded)
    return task, outcomes


SIGMA = 0.2, 0.6  # lowest and highest standard deviation of the Gaussian noise; 1 is half of a DoF's range
BURST_PROBABILITY = 0.02  # probability that a burst begins, per control step


def is_perturbed(seed: int, fraction: float) -> bool:
    """Return whether the episode of a seed is executed with noise. The seeds with noise are spread evenly."""
    return int((seed + 1) * fraction) > int(seed * fraction)


class Perturbation:
    """Adds noise to the actions (D,) of one episode. The noisy actions stay within the limits.

    The noise is Gaussian. Now and then, for 3 to 8 control steps, a burst in one random direction replaces the action.
    With `quiet` there is no Gaussian noise, and a burst begins `quiet` control steps after the end of the last one.
    Strict DoFs (such as a gripper) are not changed.
    """

    def __init__(self, task: str, seed: int, space: ActionSpace, quiet: int = 0) -> None:
        self._random = np.random.default_rng([seed, *task.encode()])
        self.sigma = 0.0 if quiet else float(self._random.uniform(*SIGMA))
        self.quiet = quiet
        self._burst_left = 0
        self._quiet_left = int(self._random.integers(quiet)) if quiet else 0
        self._noisy = ~space.is_strict
        self._low, self._high = np.array(space.low)[self._noisy], np.array(space.high)[self._noisy]
        self._half, self._middle = space.half[self._noisy], space.middle[self._noisy]
        self._direction = np.zeros(len(self._half))  # normalised

    def __call__(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        if self._quiet_left > 0:
            self._quiet_left -= 1
            return action
        dofs = len(self._half)
        noise = self._random.normal(0.0, self.sigma, size=dofs)
        if self._burst_left == 0 and (self.quiet or self._random.random() < BURST_PROBABILITY):
            self._burst_left = int(self._random.integers(3, 9))
            self._direction = unit_vector(self._random, dofs)
        moved = action[self._noisy] + noise * self._half
        if self._burst_left > 0:
            self._burst_left -= 1
            self._quiet_left = 0 if self._burst_left else self.quiet
            moved = self._direction * self._half + self._middle
        executed = action.copy()
        executed[self._noisy] = np.clip(moved, self._low, self._high)
        return executed
