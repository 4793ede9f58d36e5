"""The policy of a rollout: which files it needs, whether they fit together, and loading them once per process."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kerv_cli.decoding.calibration import Calibration, calibration_beside, load_calibration
from kerv_cli.drafting.datastore import Datastore, check_target, read_manifest
from kerv_cli.drafting.datastore_build import datastore_beside
from kerv_cli.drafting.drafter import Drafter, load_drafter, read_drafter
from kerv_cli.drafting.kinematics import FILTERS
from kerv_cli.errors import UsageError
from kerv_cli.files import sha256_of
from kerv_cli.places import drafter_folder, find_target
from kerv_cli.runtime import DTYPES, set_up
from kerv_cli.settings import EVALUATION_SEED, MethodSettings, RolloutSettings
from kerv_cli.sim.tasks import resolve_tasks
from kerv_cli.vla.checkpoint import load_target, read_description
from kerv_cli.vla.target import Target


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
        identity["drafter"] = read_description(
            drafter_folder(settings.results, settings.policy.drafter, folder), "drafter"
        )["sha256"]
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
        beside = drafter_folder(settings.results, settings.policy.drafter, folder)
        read_drafter(beside, description["sha256"])
    if needs_datastore(settings.parts()):
        check_target(read_manifest(datastore_beside(folder)), description, datastore_beside(folder))
    if needs_calibration(settings.parts()):
        calibration = load_calibration(
            calibration_beside(folder), description["sha256"], description["settings"]["chunk"]
        )
        for name in resolve_tasks(settings.task):
            calibration.threshold(settings.threshold, name)


@functools.lru_cache(maxsize=4)
def _load(target: Path, drafter: Path | None, calibrated: bool, stored: bool, device: str, dtype_name: str) -> Policy:
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
    drafter = (
        drafter_folder(settings.results, settings.policy.drafter, folder)
        if settings.proposer.kind == "drafter"
        else None
    )
    method = settings.parts()
    return _load(folder, drafter, needs_calibration(method), needs_datastore(method), device, settings.runtime.dtype)
