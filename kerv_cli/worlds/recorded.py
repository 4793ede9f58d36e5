"""Environments that exist only as recordings: a dataset's tasks and spaces, without a world to act in.

A dataset whose manifest has `instructions` registers one when it is opened, so that every command that reads
demonstrations finds its tasks. Nothing can be rolled out in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace

from kerv_cli.base.registry import Part, register
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.worlds.spec import EnvironmentSpec, Task

SPECS = SimpleNamespace()
"""The specification of every recorded environment, an attribute of its name."""


def register_recorded(
    name: str, actions: ActionSpace, observation: ObservationSpace, instructions: Mapping[str, str], camera: str
) -> EnvironmentSpec:
    """Registers the environment of a recorded dataset. name: an identifier; instructions: task -> instruction."""
    tasks = {task: Task(task, instruction, "recorded") for task, instruction in instructions.items()}
    suite = {name.upper(): tuple(tasks)}
    spec = EnvironmentSpec(name, actions, observation, tasks, suite, ("recorded",), 10_000, (camera,))
    setattr(SPECS, name, spec)
    register(Part("environment", name, f"{__name__}:SPECS.{name}"))
    return spec
