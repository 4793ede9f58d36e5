"""Environments that exist only as recordings: a dataset's tasks and spaces, without a world to act in.

A dataset whose manifest has `instructions` registers one when it is opened, so that every command that reads
demonstrations finds its tasks. Nothing can be rolled out in it.
"""

from __future__ import annotations

from collections.abc import Mapping

from kerv_cli.base.registry import Part, register
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.worlds.spec import EnvironmentSpec, Task

_SPECS: dict[str, EnvironmentSpec] = {}


def register_recorded(
    name: str, actions: ActionSpace, observation: ObservationSpace, instructions: Mapping[str, str], camera: str
) -> EnvironmentSpec:
    """Registers the environment of a recorded dataset. name: an identifier; instructions: task -> instruction."""
    tasks = {task: Task(task, instruction, "recorded") for task, instruction in instructions.items()}
    suite = {name.upper(): tuple(tasks)}
    _SPECS[name] = EnvironmentSpec(name, actions, observation, tasks, suite, ("recorded",), 10_000, (camera,))
    register(Part("environment", name, f"{__name__}:{name}"))
    return _SPECS[name]


def __getattr__(name: str) -> EnvironmentSpec:
    if name not in _SPECS:
        raise AttributeError(name)
    return _SPECS[name]
