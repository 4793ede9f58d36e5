"""What a method needs of a target besides the target itself: which artifacts, in which order, made by which command."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

from kerv_cli.base.config import compose, groups
from kerv_cli.base.errors import CheckpointError, UnknownName, UsageError
from kerv_cli.base.places import RESUME
from kerv_cli.base.registry import find, parts
from kerv_cli.catalogue.entries import state_of
from kerv_cli.episodes.resolve import resolve
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.artifacts import Artifacts, Weights, kind_of, removal
from kerv_cli.methods.compose import Method
from kerv_cli.training.demonstrations import demos_for
from kerv_cli.training.drafter import drafter_seconds
from kerv_cli.training.settings import PrepareSettings, TrainDrafterSettings
from kerv_cli.worlds import specs

THERE, MISSING = "there", "missing"


@dataclass(frozen=True)
class Step:
    """An artifact that a target needs. state: `there`, `missing`, `step 300 of 4000`, …. command: words behind `kerv`
    that make it, without those that every step shares. seconds: of making it, a guess; 0 where it is there."""

    kind: str
    state: str
    command: tuple[str, ...]
    seconds: float


def plan(settings: PrepareSettings) -> list[Step]:
    """The steps in their order, those that are done among them; nothing is loaded or made.

    Raises:
        UsageError: no such target or method, a target that drafts nothing. CheckpointError: no such demonstrations, or
            an artifact of another target lies where a new one is to be trained.
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
        command = list(files.command_beside(kinds))
        if command[0] == "train" and settings.steps:
            command.append(f"train.steps={settings.steps}")
        state = _state(artifacts, kind, kinds)
        seconds = files.seconds
        if command[0] == "train":
            seconds = drafter_seconds(kind, compose("train_drafter", command[2:], TrainDrafterSettings).train.steps)
        steps.append(Step(kind, state, tuple(command), 0.0 if state == THERE else seconds))
    if any(step.state != THERE and not find("artifact", step.kind).traits.get("study") for step in steps):
        demos_for(settings)
    return steps


@functools.cache
def needs(methods: tuple[str, ...], sees: bool, runnable: bool = True) -> tuple[str, ...]:
    """Kinds of artifacts that methods need, in the order in which they are made. methods: none: all that the target can
    have. sees: whether it has cameras. runnable: whether its environment can be run, and is not a recording alone.

    Raises:
        UnknownName: no such method. UsageError: one needs what a target without cameras cannot have.
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
    """Whether the artifact is there, missing, half trained or of other artifacts.

    Raises:
        CheckpointError: a trained one is of another target.
    """
    files, path = kind_of(kind), artifacts.path(kind)
    if not files.json(path).is_file():
        return MISSING
    try:
        described = files.checked(path, artifacts.description)
        present = [one for one in kinds if kind_of(one).json(artifacts.path(one)).is_file()]
        artifacts.check(present[: present.index(kind) + 1])
    except CheckpointError as error:
        if isinstance(files, Weights):
            raise CheckpointError(f"{str(error).split(': ')[0]}: {removal(kind, path)}") from error
        return "of other artifacts"
    if not files.is_complete(described, kinds):
        return MISSING
    state = state_of(path, kind) if isinstance(files, Weights) else THERE
    if state == "complete" and (path / RESUME).is_file() and not (path / "curves.png").is_file():
        return "without curves"  # the disk was full at the training's end
    return THERE if state == "complete" else state
