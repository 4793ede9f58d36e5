"""The registered environments, their tasks and suites. Registers kerv's own environment and its kinds of stress.

Imports nothing heavy until a spec is asked for: a spec imports numpy, a world its simulator.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.registry import add, load, parts

if TYPE_CHECKING:
    from kerv_cli.worlds.settings import WorldSettings
    from kerv_cli.worlds.spec import EnvironmentSpec

W = TypeVar("W", bound="WorldSettings")

KIND = "environment"
NAMES = "names"
"""Trait of an environment's part: `module:tuple` of its suites and tasks, importable without numpy, for completion."""


def specs() -> Mapping[str, EnvironmentSpec]:
    """Name -> specification of every registered environment."""
    return {name: load(part.build) for name, part in parts(KIND).items()}


def spec_of(task: str) -> EnvironmentSpec:
    """The environment that has the task, given by its full or its short name.

    Raises:
        UnknownName: no environment has it; the message names the nearest tasks. UsageError: several have it.
    """
    environments = specs()
    owners = [spec for spec in environments.values() if spec.full_name(task) is not None]
    if not owners:
        raise UnknownName("task", task, [name for spec in environments.values() for name in spec.tasks])
    if len(owners) > 1:
        raise UsageError(f"task '{task}' is one of {' and of '.join(spec.name for spec in owners)}: rename one of them")
    return owners[0]


def instruction_of(task: str) -> str:
    """The instruction of a task of any environment. UnknownName: no environment has it."""
    return spec_of(task).task(task).instruction


def resolve_tasks(names: Sequence[str]) -> tuple[str, ...]:
    """Full task names for a list of tasks and suites (`MT10`, `mt50`): order kept, duplicates dropped.

    Raises:
        UnknownName: a name that is neither a task nor a suite.
        UsageError: no name, or tasks of several environments, whose action spaces may differ.
    """
    if not names:
        raise UsageError("name at least one task or suite: task=NAME")
    environments = list(specs().values())
    tasks: dict[str, str] = {}  # full name -> environment
    for name in names:
        matches = {full: spec.name for spec in environments for full in spec.expand(name)}
        if not matches:
            raise UnknownName("task or suite", name, [n for spec in environments for n in (*spec.suites, *spec.tasks)])
        tasks |= matches
    owners = list(dict.fromkeys(tasks.values()))
    if len(owners) > 1:
        raise UsageError(f"task={','.join(names)}: tasks of {' and '.join(owners)} cannot be mixed: name one's")
    return tuple(tasks)


def stands_for_tasks(name: str) -> bool:
    """Whether demonstrations of this name are of the task or the suite that has it, in small letters."""
    return name == name.lower() and any(spec.expand(name) for spec in specs().values())


def task_names() -> Iterator[str]:
    """Suites and tasks of all environments, for completion."""
    for part in parts(KIND).values():
        if NAMES in part.traits:
            yield from load(part.traits[NAMES])
        else:
            spec = load(part.build)
            yield from (*spec.suites, *spec.tasks)


def settled(world: W, spec: EnvironmentSpec) -> W:
    """World settings with the environment's own camera and horizon where `world` leaves them open.

    Raises:
        UnknownName: the environment has no such camera. UsageError: a horizon that it cannot run.
    """
    camera = replace(world.camera, name=spec.camera_name(world.camera.name))
    return replace(world, camera=camera, horizon=spec.control_steps(world.horizon))


add("environment", "metaworld", "kerv_cli.worlds.metaworld.spec:SPEC", names="kerv_cli.worlds.metaworld.tasks:NAMES")
for _name, _made_by, _needed in (
    ("push", "push:Push", ("actions", "position")),
    ("actuation", "actuation:Actuation", ("actions",)),
    ("sensor", "sensor:Sensor", ("images",)),
    ("light", "light:Light", ("model",)),
    ("colour", "colour:Colour", ("model",)),
    ("camera", "camera:CameraJitter", ("model",)),
    ("object", "objects:Objects", ("model", "range")),
):
    add("stress", _name, f"kerv_cli.worlds.stress.{_made_by}", needed=_needed)
add("stress", "none", needed=())
