"""`kerv prepare`: find the artifacts that the methods need for a target, and the commands that make them, in order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from kerv_cli.base.config import compose, groups
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.registry import ArtifactPart
from kerv_cli.catalogue.entries import artifact_entry
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import command_to_go_on
from kerv_cli.methods.artifacts import Artifacts, kind_of
from kerv_cli.methods.compose import Method
from kerv_cli.methods.drafters import TrainableDrafter
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.training.demonstrations import demos_for
from kerv_cli.training.settings import PrepareSettings

THERE, MISSING, INCOMPLETE = "there", "missing", "incomplete"


@dataclass(frozen=True)
class Step:
    """One artifact that the methods need for a target.

    Attributes:
        kind: Kind of the artifact, such as `drafter` or `datastore`.
        state: `there`, `missing`, `unfinished`, `incomplete` (a calibration without some numbers), `of other artifacts`
            (made from artifacts that have been replaced since) or, while a drafter trains, `step 300 of 4000`.
        command: Command-line arguments after `kerv` that make the artifact, without the arguments that all steps share.
    """

    kind: str
    state: str
    command: tuple[str, ...]


def plan(settings: PrepareSettings, database: Database) -> list[Step]:
    """Return all steps in order, including finished ones. No weights are loaded and nothing is made."""
    artifacts = Artifacts(settings.results, settings.policy)
    description = artifacts.description
    description.check_autoregressive(f"policy.target={settings.policy.target}", "it needs nothing more")
    kinds = needs(settings.methods, description)
    steps: list[Step] = []
    for kind in kinds:
        files = kind_of(kind)
        command = files.command
        if isinstance(files, TrainableDrafter) and settings.steps:
            command = (*command, f"train.steps={settings.steps}")
        state = _state(artifacts, database, kind, kinds, settings.replace)
        steps.append(Step(kind, state, command))
    if any(step.state != THERE for step in steps):
        demos_for(settings, description, database)
    return steps


def needs(methods: Sequence[str], target: TargetDescription) -> tuple[str, ...]:
    """Return the kinds of artifacts that the methods need, in the order in which they must be made.

    Without `methods`, all that this target can use count: a target of FAST tokens needs no calibration.
    """
    kinds: set[str] = set()
    for name in methods or groups()["method"]:
        method = Method.of(compose("rollout", [f"method={name}"], RolloutSettings))
        try:
            method.check(target)
        except UsageError:
            if methods:
                raise
        else:
            kinds.update(method.needs)
    order = [name for kind, part in ArtifactPart.every().items() for name in (*part.needed(None), kind)]
    possible = [kind for kind in dict.fromkeys(order) if kind in kinds]
    return tuple(kind for kind in possible if kind_of(kind).command)


def _state(artifacts: Artifacts, database: Database, kind: str, kinds: Sequence[str], replace: bool) -> str:
    files, path = kind_of(kind), artifacts.path(kind)
    remedy = f"type replace=true, or name another by policy.artifacts.{kind}="
    if not artifacts.exists(kind):
        return MISSING
    try:
        described = files.checked(path, artifacts.description)
        present = [one for one in kinds if artifacts.exists(one)]
        artifacts.check(present[: present.index(kind) + 1])
    except CheckpointError as error:
        if not replace:
            raise CheckpointError(f"{str(error).split(': ')[0]}: {remedy}") from error
        return "of other artifacts"
    if not files.is_complete(described, kinds):
        if not replace:
            raise CheckpointError(f"the {files.noun} in {path} lacks a part that these methods need: {remedy}")
        return INCOMPLETE
    state = artifact_entry(path, kind).state if isinstance(files, TrainableDrafter) else THERE
    if state == "complete" and command_to_go_on(database, kind, path):
        return "unfinished"  # e.g. the disk was full before the last files were written
    return THERE if state == "complete" else state
