"""Find environments, their tasks and suites (named groups of tasks) by name.

This package registers Meta-World and LIBERO. Importing the package loads nothing heavy. numpy is imported with an
environment's specification, and the simulator when a world is opened.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.registry import Part

if TYPE_CHECKING:
    from kerv_cli.worlds.settings import WorldSettings
    from kerv_cli.worlds.spec import EnvironmentSpec


@dataclass(frozen=True)
class Task:
    """One manipulation task."""

    name: str  # full name. No other environment has a task with this name.
    instruction: str  # sentence that the policy reads
    horizon: int = 0  # control steps of an episode. 0 stands for the environment's.
    expert: bool = True  # whether the environment's scripted experts solve it


W = TypeVar("W", bound="WorldSettings")


class EnvironmentPart(Part):
    """An environment. It decorates the function that returns the environment's `EnvironmentSpec`."""

    kind = "environment"


def specs() -> Mapping[str, EnvironmentSpec]:
    return {name: part.built() for name, part in EnvironmentPart.every().items()}


def spec_of(task: str) -> EnvironmentSpec:
    owners = [spec for spec in specs().values() if spec.full_name(task) is not None]
    if not owners:
        raise UnknownName("task", task, [name for spec in specs().values() for name in spec.tasks])
    if len(owners) > 1:
        raise UsageError(f"task '{task}' is one of {' and of '.join(spec.name for spec in owners)}: rename one of them")
    return owners[0]


def instruction_of(task: str) -> str:
    return spec_of(task).task(task).instruction


def resolve_tasks(names: Sequence[str]) -> tuple[str, ...]:
    """Return the full names of the tasks that `names` (tasks or suites, such as `MT10`) stand for, each once."""
    if not names:
        raise UsageError("name at least one task or suite: task=NAME")
    environments = specs().values()
    tasks: dict[str, str] = {}  # full name -> environment
    for name in names:
        matches: dict[str, str] = {}
        for spec in environments:
            matches |= dict.fromkeys(spec.expand(name), spec.name)
        if not matches:
            raise UnknownName("task or suite", name, task_names())
        tasks |= matches
    owners = list(dict.fromkeys(tasks.values()))
    if len(owners) > 1:
        raise UsageError(f"task={','.join(names)}: choose tasks of one environment, {' or '.join(owners)}")
    return tuple(tasks)


def stands_for_tasks(name: str) -> bool:
    """Return whether `name` is a task or suite in small letters, as default names of demonstrations are."""
    return name == name.lower() and any(spec.expand(name) for spec in specs().values())


def imported_name(instruction: str) -> str:
    """Return the name of a task of imported data: the words of its instruction, joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", instruction.lower()).strip("-")[:60]


def task_names() -> list[str]:
    return [name for spec in specs().values() for name in (*spec.suites, *spec.tasks)]


def settled(world: W, tasks: Sequence[str]) -> W:
    """Replace an empty camera name and a horizon of 0 by the defaults of the tasks."""
    spec = spec_of(tasks[0])
    camera = replace(world.camera, name=spec.camera_name(world.camera.name))
    return replace(world, camera=camera, horizon=spec.control_steps(world.horizon, tasks))


@EnvironmentPart("metaworld")
def metaworld() -> EnvironmentSpec:
    from kerv_cli.worlds.metaworld.spec import SPEC

    return SPEC


@EnvironmentPart("libero")
def libero() -> EnvironmentSpec:
    from kerv_cli.worlds.libero.spec import SPEC

    return SPEC
