"""What `kerv prepare` makes for a target: which artifacts, in which order, by which command."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

from kerv_cli.base.config import compose, groups
from kerv_cli.base.errors import CheckpointError, UnknownName, UsageError
from kerv_cli.base.registry import find, parts
from kerv_cli.catalogue.entries import state_of
from kerv_cli.episodes.resolve import resolve
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.runs import command_to_go_on
from kerv_cli.methods.artifacts import Artifacts, kind_of, removal
from kerv_cli.methods.compose import Method
from kerv_cli.methods.drafters import TrainableDrafter
from kerv_cli.training.demonstrations import demos_for
from kerv_cli.training.settings import PrepareSettings
from kerv_cli.worlds import specs

THERE, MISSING = "there", "missing"


@dataclass(frozen=True)
class Step:
    """An artifact that a target needs.

    Attributes:
        kind: Kind of the artifact.
        state: `there`, `missing`, `unfinished`, `step 300 of 4000`, …
        command: The words after `kerv` that make it, without those that all steps share.
    """

    kind: str
    state: str
    command: tuple[str, ...]


def plan(settings: PrepareSettings) -> list[Step]:
    """Return all steps in order, also those that are done; nothing is loaded or made.

    Raises:
        UsageError: No such target or method, or a target that drafts nothing.
        CheckpointError: No such demonstrations, or another target's artifact is where one would be trained.
    """
    artifacts = Artifacts(settings.results, settings.policy)
    description = artifacts.description
    description.check_autoregressive(f"policy.target={settings.policy.target}", "it needs nothing more")
    spec = specs().get(description.environment)
    runnable = spec is not None and bool(spec.world_class)
    kinds = needs(tuple(settings.methods), bool(description.cameras), runnable)
    steps: list[Step] = []
    for kind in kinds:
        files = kind_of(kind)
        command = files.command_beside(kinds)
        if isinstance(files, TrainableDrafter) and settings.steps:
            command = (*command, f"train.steps={settings.steps}")
        steps.append(Step(kind, _state(artifacts, kind, kinds), command))
    if any(step.state != THERE and not find("artifact", step.kind).traits.get("study") for step in steps):
        demos_for(settings)
    return steps


@functools.cache
def needs(methods: tuple[str, ...], sees: bool, runnable: bool = True) -> tuple[str, ...]:
    """Return the kinds of artifacts that methods need, in the order in which they are made.

    Args:
        methods: Names of methods; empty: all that the target can have.
        sees: Whether the target has cameras.
        runnable: Whether its environment can be run; some exist only as a recording.

    Raises:
        UnknownName: No such method.
        UsageError: One needs what a target without cameras cannot have.
    """
    names = groups()["method"]
    for name in methods:
        if name not in names:
            raise UnknownName("method", name, names)
    artifacts = parts("artifact")
    seeing = {kind for kind, part in artifacts.items() if part.traits.get("sees")}
    kinds: set[str] = set()
    for name in methods or names:
        method = Method.of(compose("rollout", [f"method={name}"], RolloutSettings))
        if methods and not sees and seeing & set(method.needs):
            raise UsageError(f"for={name}: it needs a target that sees, this one reads the state")
        kinds |= set(method.needs)
    studies = {kind: part.traits["study"] for kind, part in artifacts.items() if "study" in part.traits}
    for study in [studies[kind] for kind in kinds & set(studies)] if sees and runnable else ():
        kinds |= {
            kind for settings in resolve([f"study={study}"]).settings.values() for kind in Method.of(settings).needs
        }
    if not sees:
        kinds -= seeing
    if not runnable:
        kinds -= set(studies)
    order = dict.fromkeys(kind for name, part in artifacts.items() for kind in (*part.needs(None), name))
    return tuple(kind for kind in order if kind in kinds and kind_of(kind).command)


def _state(artifacts: Artifacts, kind: str, kinds: Sequence[str]) -> str:
    """Return whether the artifact is there, missing, half trained or made from other artifacts.

    Raises:
        CheckpointError: A trained one is of another target.
    """
    files, path = kind_of(kind), artifacts.path(kind)
    if not files.json(path).is_file():
        return MISSING
    try:
        described = files.checked(path, artifacts.description)
        present = [one for one in kinds if kind_of(one).json(artifacts.path(one)).is_file()]
        artifacts.check(present[: present.index(kind) + 1])
    except CheckpointError as error:
        if isinstance(files, TrainableDrafter):
            raise CheckpointError(f"{str(error).split(': ')[0]}: {removal(kind, path)}") from error
        return "of other artifacts"
    if not files.is_complete(described, kinds):
        return MISSING
    state = state_of(path, kind) if isinstance(files, TrainableDrafter) else THERE
    if state == "complete" and command_to_go_on(artifacts.results, kind, path):
        return "unfinished"  # e.g. the disk was full before the last files were written
    return THERE if state == "complete" else state
