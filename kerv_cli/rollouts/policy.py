"""The policy of a rollout: which files it needs, whether they fit together, and loading them once per process."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

from kerv_cli.decoding.calibration_file import Calibration, calibration_beside, load_calibration
from kerv_cli.drafting.datastore import Datastore, check_backend, check_target, open_datastore, read_manifest
from kerv_cli.drafting.eagle import Drafter, load_drafter, read_drafter
from kerv_cli.drafting.early import EarlyDrafter, load_early, read_early
from kerv_cli.drafting.kinematics import FILTERS
from kerv_cli.environments import resolve_tasks
from kerv_cli.errors import UsageError
from kerv_cli.files import sha256_of
from kerv_cli.places import drafter_folder, early_folder, find_target
from kerv_cli.rollouts.composition import check_composition
from kerv_cli.runtime import DTYPES, set_up
from kerv_cli.settings import EVALUATION_SEED, DatastoreSettings, MethodSettings, RolloutSettings, opening_sources
from kerv_cli.targets.checkpoint import TargetDescription, load_target, read_target
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.training.datastore import datastore_beside


@dataclass(frozen=True)
class Policy:
    """Loaded weights and the hashes that name them."""

    target: CompactTarget
    drafter: Drafter | None
    early: EarlyDrafter | None
    calibration: Calibration | None
    datastore: Datastore | None
    datastore_sha256: str


def identity_of(settings: RolloutSettings) -> dict[str, str]:
    """Hashes of the weights that determine a result, without loading them."""
    if is_expert(settings):
        return {"target": "", "observation": "state (privileged)"}
    folder = find_target(settings.results, settings.policy.target)
    description = read_target(folder)
    identity = {"target": description.sha256, "observation": observation_of(description)}
    method = settings.parts()
    if needs_drafter(method):
        beside = drafter_folder(settings.results, settings.policy.drafter, folder)
        identity["drafter"] = read_drafter(beside, description.sha256, description.actions).sha256
    if needs_early(method):
        beside = early_folder(settings.results, settings.policy.early, folder)
        identity["early"] = read_early(beside, description).sha256
    if needs_calibration(method):
        identity["calibration"] = sha256_of(calibration_beside(folder))
    if needs_datastore(method):
        identity["datastore"] = sha256_of(datastore_beside(folder) / "manifest.json")
    return identity


def is_expert(settings: RolloutSettings) -> bool:
    """Whether Meta-World's scripted policy acts in the target's place."""
    return settings.proposer.kind == "expert"


def needs_drafter(method: MethodSettings) -> bool:
    return method.proposer.kind in ("drafter", "hybrid")


def needs_early(method: MethodSettings) -> bool:
    return method.proposer.kind == "early" or "early" in opening_sources(method.opening.sources)


def needs_datastore(method: MethodSettings) -> bool:
    """Whether a part retrieves stored chunks."""
    if method.proposer.kind in ("retrieval", "hybrid") or method.skip.kind != "none":
        return True
    return "retrieval" in opening_sources(method.opening.sources)


def observation_of(description: TargetDescription) -> str:
    """What the target is shown, for every row: one that is given the scene must not pass for one that sees it."""
    kind = description.settings["observation"]
    return "state (privileged)" if kind == "state" else str(kind)


def needs_calibration(method: MethodSettings) -> bool:
    """Whether a part reads what `kerv calibrate` fitted."""
    predictors = {method.proposer.kind, *opening_sources(method.opening.sources)}
    if method.rectifier.kind == "compensate":
        predictors.add(method.rectifier.predictor)
    return (
        not predictors.isdisjoint(FILTERS)
        or (method.threshold.kind in ("kinematic", "change") and method.threshold.k_s is None)
        or method.boundary.kind == "fused"
        or (method.skip.kind == "similarity" and method.skip.s_min is None)
    )


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
    if is_expert(settings):
        if settings.deviation_every > 0:
            raise UsageError(f"deviation_every={settings.deviation_every}: the expert has no AR to differ from")
        return
    folder = find_target(settings.results, settings.policy.target)
    description = read_target(folder)
    size, camera = description.settings["image_size"], settings.world.camera
    if description.cameras and camera.size != size:
        raise UsageError(f"world.camera.size={camera.size}: the policy was trained on {size} pixels")
    method = settings.parts()
    check_composition(method, description.chunk)
    if needs_drafter(method):
        beside = drafter_folder(settings.results, settings.policy.drafter, folder)
        read_drafter(beside, description.sha256, description.actions)
    if needs_early(method):
        read_early(early_folder(settings.results, settings.policy.early, folder), description)
    if needs_datastore(method):
        check_backend(settings.datastore)
        check_target(read_manifest(datastore_beside(folder)), description, datastore_beside(folder))
    if needs_calibration(method):
        calibration = load_calibration(calibration_beside(folder), description.sha256, description.chunk)
        for name in resolve_tasks(settings.task):
            calibration.threshold(settings.threshold, name)


@functools.lru_cache(maxsize=4)
def _load(
    target: Path,
    drafter: Path | None,
    early: Path | None,
    calibrated: bool,
    stored: tuple[str, str | None] | None,
    device: str,
    dtype_name: str,
) -> Policy:
    """stored: the datastore's backend and url."""
    loaded, description = load_target(target, device, DTYPES[dtype_name])
    sha256, chunk, at = description.sha256, loaded.chunk, datastore_beside(target)
    return Policy(
        target=loaded,
        drafter=load_drafter(drafter, loaded, sha256)[0] if drafter is not None else None,
        early=load_early(early, loaded, description)[0] if early is not None else None,
        calibration=load_calibration(calibration_beside(target), sha256, chunk) if calibrated else None,
        datastore=open_datastore(at, description, DatastoreSettings(*stored)) if stored else None,
        datastore_sha256=sha256_of(at / "manifest.json") if stored else "",
    )


def load_policy(settings: RolloutSettings) -> Policy:
    """The policy on its device; kept, so that the cells of a sweep share it."""
    device, _ = set_up(settings.runtime)
    results, policy, method = settings.results, settings.policy, settings.parts()
    folder = find_target(results, policy.target)
    return _load(
        folder,
        drafter_folder(results, policy.drafter, folder) if needs_drafter(method) else None,
        early_folder(results, policy.early, folder) if needs_early(method) else None,
        needs_calibration(method),
        (settings.datastore.backend, settings.datastore.url) if needs_datastore(method) else None,
        device,
        settings.runtime.dtype,
    )
