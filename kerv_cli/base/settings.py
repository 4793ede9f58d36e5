"""Settings that several commands share, as dataclasses. A field states its type, default, range and description.

Neither torch nor MuJoCo is imported here, so a mistyped override is reported at once.
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
    return lambda: find(kind, name).default


def part(kind: str, name: str = "none", help: str = "") -> Any:
    """Return a dataclass field that holds the settings of a part, such as a proposer.

    The user chooses another part with `FIELD=PART`, such as `threshold=fixed`. So the field must be named like one of
    `SETTINGS_GROUPS` (`registry.py`).
    """
    return setting(chosen(kind, name), help, group=name)


@dataclass
class RuntimeSettings:
    """Device, number format and parallelism of a process."""

    device: str = setting("cpu", "cpu, cuda or auto")
    dtype: str = choice("float32", "float32", "bfloat16", "float16", help="number format of the models")
    threads: int = number(1, 1, 256, help="torch's threads in each process")
    workers: int = number(1, 0, 4096, help="sweeps: number of processes that run episodes at once; 0: start none")
    launch: str = setting("", "sweeps: shell command that starts workers elsewhere; {command} is a worker's line")


REPLACE = "replace what another command has made under this name"


@dataclass(kw_only=True)
class CommandSettings:
    """Settings of every command."""

    # The file that is chosen by default in each group of conf/. If two groups set the same key, the later one wins.
    groups: ClassVar[Mapping[str, str]] = {}

    results: str = setting("results", "folder that kerv writes everything to")
    store: str = setting(
        "", "database, postgresql://USER@HOST/DB; empty: $KERV_STORE, else SQLite in the results folder"
    )


@dataclass(kw_only=True)
class RunSettings(CommandSettings):
    """Settings of every command that runs a model or a simulator."""

    groups: ClassVar = {"runtime": "cpu"}

    runtime: RuntimeSettings = setting(RuntimeSettings, "device, number format, threads, processes")


@dataclass(kw_only=True)
class TaskSettings(RunSettings):
    """Settings of every command that takes a list of tasks."""

    task: list[str] = setting(
        [], "tasks and suites: reach, drawer-open, MT10, …; empty: the tasks that the target was trained on"
    )


def choices_of(schema: type) -> dict[str, str]:
    """Return the default choices of a command's groups of conf/. If two choices set a key, the later one wins."""
    parts = {at.name: str(at.metadata["group"]) for at in fields(schema) if "group" in at.metadata}
    return parts | dict(getattr(schema, "groups", {}))


def read_settings(schema: type[S], plain: Mapping[str, Any]) -> S:
    """Return settings from nested dicts and lists, the inverse of `asdict`. Each part gets its own settings class."""
    settings = manifests.read(schema, plain, "a stored setting")
    for group in SETTINGS_GROUPS:
        value = getattr(settings, group, None)
        if not isinstance(value, Mapping):
            continue  # no settings of this part were stored, so the defaults stay
        part_settings = part_of(group, value["kind"]).settings
        setattr(settings, group, manifests.read(part_settings, value, f"a stored setting's {group}"))
    return settings
