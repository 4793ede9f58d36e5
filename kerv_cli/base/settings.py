"""Settings that all commands share, as plain dataclasses. Each field states type, default, range and description once.

Nothing heavy is imported here, so a wrong override is answered before torch or MuJoCo load.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, TypeVar

from kerv_cli.base import manifests
from kerv_cli.base.limits import choice, number, setting
from kerv_cli.base.registry import SETTINGS_GROUPS, find, part_of

S = TypeVar("S")


def chosen(kind: str, name: str = "none") -> Callable[[], Any]:
    """Return a function that makes the settings of a part: the default of a group."""
    return lambda: find(kind, name).default


def part(kind: str, name: str = "none", help: str = "") -> Any:
    """Return a field with the settings of a part of a kind. The field's name is a group of conf/."""
    return setting(chosen(kind, name), help, group=name)


@dataclass
class RuntimeSettings:
    """Device, number format and parallelism of a process."""

    device: str = setting("cpu", "cpu, cuda or auto")
    dtype: str = choice("float32", "float32", "bfloat16", "float16", help="number format of the models")
    threads: int = number(1, 1, 256, help="torch's threads in each process")
    executor: str = setting("local", "sweeps: what runs the blocks: local (processes here), slurm, ray")
    workers: int = number(1, 1, 4096, help="sweeps: blocks that run at the same time")
    executor_options: dict[str, Any] = setting({}, "see kerv_cli/lab/executors/__init__.py")


@dataclass(kw_only=True)
class CommandSettings:
    """Settings of every command."""

    groups: ClassVar[Mapping[str, str]] = {}
    """Groups of conf/ -> default choice, in the order of composition: a later one outranks an earlier one."""

    results: str = setting("results", "folder of everything that kerv makes")
    store: str = setting(
        "", "database, postgresql://USER@HOST/DB; empty: $KERV_STORE, else SQLite in the results folder"
    )


@dataclass(kw_only=True)
class RunSettings(CommandSettings):
    """Settings of every command that computes."""

    groups: ClassVar = {"runtime": "cpu"}

    runtime: RuntimeSettings = setting(RuntimeSettings, "device, number format, threads, processes")


@dataclass(kw_only=True)
class TaskSettings(RunSettings):
    """Settings of every command that works on tasks."""

    task: list[str] = setting(
        [], "tasks and suites: reach, drawer-open, MT10, …; empty: those that the target was trained on"
    )


def choices_of(schema: type) -> dict[str, str]:
    """Return the groups that these settings choose from -> the default choice, in the order of composition."""
    parts = {at.name: str(at.metadata["group"]) for at in fields(schema) if "group" in at.metadata}
    return parts | dict(getattr(schema, "groups", {}))


def read_settings(schema: type[S], plain: Mapping[str, Any]) -> S:
    """Return settings from nested dicts and lists, the inverse of `asdict`. Each part gets its own settings class.

    Raises:
        CheckpointError: They are not such settings.
        UnknownName: A part that is not registered here.
    """
    settings = manifests.read(schema, plain, "a stored setting")
    for group in SETTINGS_GROUPS:
        value = getattr(settings, group, None)
        if not isinstance(value, Mapping):
            continue  # the settings name no such part: its default
        part_settings = part_of(group, value["kind"]).settings
        setattr(settings, group, manifests.read(part_settings, value, f"a stored setting's {group}"))
    return settings
