"""Episodes of one method: load the policy once per process, build the decoder, warm it up, run."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kerv_cli.decoding.calibration import Calibration, calibration_beside, load_calibration
from kerv_cli.decoding.chunk import Proposer
from kerv_cli.decoding.decoder import Decoder, Parts
from kerv_cli.decoding.proposers import DrafterProposer, HoldProposer, MergedProposer, RetrievalProposer
from kerv_cli.decoding.record import DecodeRecord, EpisodeRecord
from kerv_cli.decoding.rectify import Compensation
from kerv_cli.drafting.datastore import Datastore, check_target, read_manifest
from kerv_cli.drafting.datastore_build import datastore_beside
from kerv_cli.drafting.drafter import Drafter, load_drafter
from kerv_cli.drafting.kinematics import FILTERS, MINIMUM, build_predictor
from kerv_cli.errors import UnknownName, UsageError
from kerv_cli.files import sha256_of
from kerv_cli.places import drafter_beside, find_target
from kerv_cli.rollouts.episode import ActionDecoder, Recording, run_episode
from kerv_cli.runtime import set_up
from kerv_cli.settings import EVALUATION_SEED, CameraSettings, MethodSettings, RolloutSettings, WorldSettings
from kerv_cli.sim.camera import CameraConfig
from kerv_cli.sim.tasks import resolve_tasks
from kerv_cli.sim.world import World
from kerv_cli.vla.action_tokens import GRIPPER
from kerv_cli.vla.checkpoint import load_target, read_description
from kerv_cli.vla.target import Target

WARM_UP_DECODES = 3
PREDICTED_FROM = {"hold": 1, "linear": 2}  # actions that a predictor needs at least; filters: see kinematics


@dataclass(frozen=True)
class Policy:
    """Loaded weights and the hashes that name them."""

    target: Target
    drafter: Drafter | None
    calibration: Calibration | None
    datastore: Datastore | None
    identity: dict[str, str]


def identity_of(settings: RolloutSettings) -> dict[str, str]:
    """Hashes of the weights that determine a result, without loading them."""
    folder = find_target(settings.results, settings.policy.target)
    description = read_description(folder, "target")
    identity = {"target": description["sha256"], "observation": observation_of(description)}
    if settings.proposer.kind == "drafter":
        identity["drafter"] = read_description(_drafter_folder(settings, folder), "drafter")["sha256"]
    if needs_calibration(settings.parts()):
        identity["calibration"] = sha256_of(calibration_beside(folder))
    if needs_datastore(settings.parts()):
        identity["datastore"] = sha256_of(datastore_beside(folder) / "manifest.json")
    return identity


def needs_datastore(method: MethodSettings) -> bool:
    """Whether a part retrieves stored chunks."""
    return method.proposer.kind == "retrieval" or method.opening.kind in ("retrieval", "merged")


def observation_of(description: Mapping[str, Any]) -> str:
    """What the target is shown, for every row: one that is given the scene must not pass for one that sees it."""
    kind = description["settings"]["observation"]
    return "state (privileged)" if kind == "state" else str(kind)


def needs_calibration(method: MethodSettings) -> bool:
    """Whether a part reads what `kerv calibrate` fitted."""
    reference = method.threshold.kind in ("kinematic", "change") and method.threshold.k_s is None
    return reference or (method.rectifier.kind == "compensate" and method.rectifier.predictor in FILTERS)


def check(settings: RolloutSettings) -> None:
    """Refuse what cannot run before anything heavy starts.

    Raises:
        UsageError: a number out of range, training seeds, a camera that the policy was not trained on.
        CheckpointError: no such policy, a damaged one, a drafter of another target.
    """
    if settings.episodes < 1:
        raise UsageError(f"episodes={settings.episodes}: at least 1")
    if settings.seed < EVALUATION_SEED:
        raise UsageError(f"seed={settings.seed} is a training seed: evaluation begins at {EVALUATION_SEED}")
    folder = find_target(settings.results, settings.policy.target)
    description = read_description(folder, "target")
    size, camera = description["settings"]["image_size"], settings.world.camera
    if description["settings"]["observation"] == "vision" and camera.size != size:
        raise UsageError(f"world.camera.size={camera.size}: the policy was trained on {size} pixels")
    if settings.proposer.kind == "drafter":
        drafter = read_description(_drafter_folder(settings, folder), "drafter")
        if drafter["target"] != description["sha256"]:
            load_drafter_error(settings, folder, drafter["target"], description["sha256"])
    if needs_datastore(settings.parts()):
        check_target(read_manifest(datastore_beside(folder)), description, datastore_beside(folder))
    if needs_calibration(settings.parts()):
        calibration = load_calibration(
            calibration_beside(folder), description["sha256"], description["settings"]["chunk"]
        )
        for name in resolve_tasks(settings.task):
            calibration.threshold(settings.threshold, name)


def load_drafter_error(settings: RolloutSettings, folder: Path, trained_for: str, target: str) -> None:
    from kerv_cli.errors import CheckpointError

    raise CheckpointError(
        f"the drafter in {_drafter_folder(settings, folder)} was trained for target {trained_for[:12]}, not for "
        f"{target[:12]}: train one with 'kerv train drafter policy.target={settings.policy.target}'"
    )


def _drafter_folder(settings: RolloutSettings, target: Path) -> Path:
    name = settings.policy.drafter
    if name is None:
        return drafter_beside(target)
    if "/" in name:
        return Path(name).expanduser()
    return Path(settings.results) / "artifacts" / "drafter" / name


@functools.lru_cache(maxsize=2)
def _load(target: Path, drafter: Path | None, calibrated: bool, stored: bool, device: str, dtype_name: str) -> Policy:
    from kerv_cli.runtime import DTYPES

    loaded, description = load_target(target, device, DTYPES[dtype_name])
    identity = {"target": description["sha256"]}
    beside = None
    if drafter is not None:
        beside, described = load_drafter(drafter, loaded, description["sha256"])
        identity["drafter"] = described["sha256"]
    calibration = None
    if calibrated:
        chunk = loaded.settings.chunk
        calibration = load_calibration(calibration_beside(target), description["sha256"], chunk)
    datastore = Datastore.open(datastore_beside(target), description) if stored else None
    return Policy(loaded, beside, calibration, datastore, identity)


def load_policy(settings: RolloutSettings) -> Policy:
    """The policy on its device; kept, so that the cells of a sweep share it."""
    device, _ = set_up(settings.runtime)
    folder = find_target(settings.results, settings.policy.target)
    drafter = _drafter_folder(settings, folder) if settings.proposer.kind == "drafter" else None
    method = settings.parts()
    return _load(folder, drafter, needs_calibration(method), needs_datastore(method), device, settings.runtime.dtype)


def build_decoder(policy: Policy, method: MethodSettings) -> Decoder:
    """The method's parts around the policy."""
    return Decoder(policy.target, method, build_parts(policy, method))


def build_parts(policy: Policy, method: MethodSettings) -> Parts:
    return Parts(build_opening(policy, method), build_proposer(policy, method), build_compensation(policy, method))


def build_opening(policy: Policy, method: MethodSettings) -> Proposer | None:
    settings = method.opening
    if settings.kind == "none":
        return None
    if settings.kind == "hold":
        return HoldProposer()
    if settings.kind in ("retrieval", "merged"):
        retrieval = build_retrieval(policy, settings.neighbours, settings.nodes)
        return retrieval if settings.kind == "retrieval" else MergedProposer(retrieval, HoldProposer(), settings.nodes)
    raise UnknownName("opening.kind", settings.kind, ["none", "hold", "retrieval", "merged"])


def build_retrieval(policy: Policy, neighbours: int, nodes: int) -> RetrievalProposer:
    assert policy.datastore is not None
    if min(neighbours, nodes) < 1:
        raise UsageError("retrieval needs at least one neighbour and one node")
    return RetrievalProposer(policy.datastore, policy.target, neighbours, nodes)


def build_compensation(policy: Policy, method: MethodSettings) -> Compensation | None:
    settings = method.rectifier
    if settings.kind not in ("reinfer", "compensate"):
        raise UnknownName("rectifier.kind", settings.kind, ["reinfer", "compensate"])
    if settings.kind == "reinfer":
        return None
    chunk = policy.target.settings
    if policy.calibration is not None and settings.predictor in FILTERS:
        predictor = policy.calibration.predictor(settings.predictor, horizon=chunk.chunk)
    else:
        least = PREDICTED_FROM.get(settings.predictor, MINIMUM)
        predictor = build_predictor(settings.predictor, chunk.dofs, {}, least, horizon=chunk.chunk, gripper=GRIPPER)
    return Compensation(settings, predictor)


def build_proposer(policy: Policy, method: MethodSettings) -> Proposer | None:
    settings = method.proposer
    if settings.kind == "none":
        return None
    if settings.kind == "drafter":
        assert policy.drafter is not None
        if min(settings.depth, settings.top_k, settings.nodes) < 1:
            raise UsageError("proposer.depth, proposer.top_k and proposer.nodes must be at least 1")
        return DrafterProposer(policy.drafter, policy.target, settings)
    if settings.kind == "retrieval":
        return build_retrieval(policy, settings.top_k, settings.nodes)
    if settings.kind == "hold":
        return HoldProposer()
    raise UnknownName("proposer.kind", settings.kind, ["none", "drafter", "retrieval", "hold"])


class Sampled:
    """A decoder that, every so many decodes, also asks AR about the same observation, outside the timing."""

    def __init__(self, decoder: Decoder, reference: Decoder, every: int) -> None:
        self.decoder, self.reference, self.every, self.count = decoder, reference, every, 0

    @property
    def needs_frame(self) -> bool:
        return self.decoder.needs_frame

    def reset(self, task: str, instruction: str) -> None:
        self.count = 0
        self.decoder.reset(task, instruction)
        self.reference.reset(task, instruction)

    def decode(self, frame: np.ndarray | None, state: np.ndarray) -> DecodeRecord:
        record = self.decoder.decode(frame, state)
        self.count += 1
        if self.count % self.every:
            return record
        tokenizer = self.decoder.target.actions
        wanted = self.reference.decode(frame, state).actions[: len(record.actions)]
        gap = np.abs(tokenizer.normalise(record.actions) - tokenizer.normalise(wanted))
        return dataclasses.replace(record, deviation=float(gap.mean()))

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        self.decoder.observe(action, end_effector)

    def finish(self, success: bool) -> None:
        self.decoder.finish(success)


def episode_decoder(policy: Policy, settings: RolloutSettings, task: str) -> ActionDecoder:
    """The method's decoder, with the task's own reference level where the threshold follows one."""
    method = settings.parts()
    if policy.calibration is not None:
        method = dataclasses.replace(method, threshold=policy.calibration.threshold(method.threshold, task))
    decoder = build_decoder(policy, method)
    if settings.deviation_every <= 0:
        return decoder
    return Sampled(decoder, Decoder(policy.target, MethodSettings()), settings.deviation_every)


def warm_up(decoder: ActionDecoder, camera: CameraSettings) -> None:
    """First calls allocate, choose kernels and fault pages in: they are no part of any inference time."""
    decoder.reset("reach-v3", "")
    frame = np.zeros((camera.size, camera.size, 3), dtype=np.uint8)
    for _ in range(WARM_UP_DECODES):
        decoder.decode(frame, np.zeros(39))


def camera_config(settings: CameraSettings) -> CameraConfig:
    return CameraConfig(**dataclasses.asdict(settings))


@functools.lru_cache(maxsize=1)
def _world(task: str, camera: CameraConfig, horizon: int) -> World:
    return World(task, camera, horizon)


_opened: list[World] = []


def open_world(task: str, settings: WorldSettings) -> World:
    """This process's world for `task`; only one is kept, fifty would take 1.2 GB."""
    world = _world(task, camera_config(settings.camera), settings.horizon)
    for other in [w for w in _opened if w is not world]:
        other.close()
        _opened.remove(other)
    if world not in _opened:
        _opened.append(world)
    return world


def close_worlds() -> None:
    _world.cache_clear()
    while _opened:
        _opened.pop().close()


def run_task(
    settings: RolloutSettings,
    task: str,
    seeds: Sequence[int],
    on_episode: Callable[[EpisodeRecord], None] = lambda record: None,
) -> Iterator[EpisodeRecord]:
    """One method on one task, seed by seed. The first `settings.record` episodes keep frames for their .rrd."""
    policy = load_policy(settings)
    decoder = episode_decoder(policy, settings, task)
    warm_up(decoder, settings.world.camera)
    world = open_world(task, settings.world)
    logged = dataclasses.replace(camera_config(settings.world.camera), size=settings.record_size, supersample=1)
    for number, seed in enumerate(seeds):
        recorded = settings.record < 0 or number < settings.record
        record = run_episode(world, decoder, seed, Recording(logged if recorded else None))
        on_episode(record)
        yield record


def success_of(target: Target, tasks: Iterable[str], seeds: Sequence[int], settings: WorldSettings) -> float:
    """Share of successful AR episodes over tasks and seeds."""
    decoder = Decoder(target, MethodSettings())
    outcomes = [run_episode(open_world(task, settings), decoder, seed).success for task in tasks for seed in seeds]
    close_worlds()
    return float(np.mean(outcomes))
