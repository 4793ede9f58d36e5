"""The parts that kerv is put together from, by kind and name: proposers, artifacts, targets, environments, commands.

Names, settings and needs of a part are known without importing torch or MuJoCo. `build` names the code that makes the
part, `module:function` or `module:Class.method`; the module is imported when the part is built.

A package adds parts by an entry point of the group `kerv.parts`, a file by `KERV_PLUGINS=module,…`. Its module is
imported and registers its parts.
"""

from __future__ import annotations

import functools
import importlib
import os
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any

from kerv_cli.base.errors import KervError, UnknownName, UsageError

PLUGINS = "KERV_PLUGINS"

MODULES = (
    "kerv_cli.worlds",
    "kerv_cli.targets",
    "kerv_cli.methods.ar",
    "kerv_cli.methods.spec_vla",
    "kerv_cli.methods.eagle",
    "kerv_cli.methods.early",
    "kerv_cli.methods.scout",
    "kerv_cli.methods.kerv",
    "kerv_cli.methods.parallel",
    "kerv_cli.methods.streak",
    "kerv_cli.methods.sp_vla",
    "kerv_cli.methods.heisd",
    "kerv_cli.methods.jacobi",
    "kerv_cli.methods.merged",
    "kerv_cli.methods.certified",
    "kerv_cli.lab.executors",
)
"""Modules that register kerv's own parts when they are imported. None imports anything heavy. Messages list parts in
this order.
"""

METHOD_KINDS = ("prefill_draft", "proposer", "acceptance", "threshold", "rectifier", "boundary", "skip")
"""The parts of a method, in the order in which a decode uses them."""

PART_GROUPS = (*METHOD_KINDS, "datastore")
"""Settings of a rollout whose choices are parts; YAML files in conf/<group>/ are further choices."""

SETTINGS_GROUPS = (*PART_GROUPS, "drafter")
"""All groups of settings whose choices are parts: those of a rollout, and what `kerv train drafter` trains."""

DRAFTING = "draft"
"""Cost of a proposer whose draft is made of forwards that follow the target's shape (docs/measuring.md)."""

PREFILL, STATES = "prefill", "states"
"""When a proposer can draft: before the prefill, or only behind it because it reads the target's hidden states."""


@dataclass
class NoSettings:
    """Settings of a part that has none but its name."""

    kind: str = "none"


@dataclass(frozen=True)
class Part:
    """One choice among the parts of a kind.

    Args:
        kind: proposer, acceptance, threshold, rectifier, boundary, skip, datastore, predictor, artifact, drafter,
            target, environment, stress, executor, column or command.
        name: The name by which it is chosen.
        build: `module:function` or `module:Class.method`. Its arguments are documented where the kind is used,
            those of a method's parts in `methods/context.py`.
        settings: Dataclass of its settings, with defaults and limits.
        needs: Kinds of artifacts that these settings need; for an artifact, those that it is made from.
        colour: 0xRRGGBB of its rows, lines and timeline.
        traits: What others need to know of the part. docs/extending.md lists their names.
    """

    kind: str
    name: str
    build: str = ""
    settings: type = NoSettings
    needs: Callable[[Any], tuple[str, ...]] = lambda settings: ()
    colour: int | None = None
    traits: Mapping[str, Any] = field(default_factory=dict)

    @property
    def absent(self) -> bool:
        """Whether it stands for the absence of a part, such as `proposer=none`."""
        return not self.build

    @property
    def default(self) -> Any:
        """Its default settings."""
        return self.settings(kind=self.name)

    def built(self, *arguments: Any, **keywords: Any) -> Any:
        """Import and call `build`; return None for an absent part."""
        return load(self.build)(*arguments, **keywords) if self.build else None


_PARTS: dict[str, dict[str, Part]] = {}


def register(part: Part) -> Part:
    """Add a part. The same code can register a name again, for example when a module is reloaded.

    Raises:
        UsageError: Another part of that kind has the name.
    """
    other = _PARTS.setdefault(part.kind, {}).get(part.name)
    if other is not None and other.build != part.build:
        raise UsageError(f"{part.kind} '{part.name}' is registered twice: {other.build} and {part.build}")
    _PARTS[part.kind][part.name] = part
    return part


def add(
    kind: str,
    name: str,
    build: str = "",
    settings: type = NoSettings,
    needs: tuple[str, ...] | Callable[[Any], tuple[str, ...]] = (),
    colour: int | None = None,
    **traits: Any,
) -> None:
    """Register a part with these fields.

    Args:
        kind: Kind of part.
        name: Its name.
        build: `module:function` that makes it.
        settings: Dataclass of its settings.
        needs: Kinds of artifacts that it needs, or a function of its settings.
        colour: 0xRRGGBB.
        **traits: What others need to know of the part.
    """
    register(Part(kind, name, build, settings, needs if callable(needs) else lambda _: needs, colour, traits))


def add_drafter(
    kind: str,
    build: str,
    settings: type,
    proposer: type = NoSettings,
    name: str = "",
    sees: bool = False,
    colour: int | None = None,
    **traits: Any,
) -> None:
    """Register a drafter with weights: its artifact, its training and its proposer.

    Args:
        kind: Name of the artifact and of the proposer.
        build: `module:Class` of a `TrainableDrafter` (`kerv_cli/methods/drafters.py`).
        settings: Dataclass of its shapes and training.
        proposer: Dataclass of the settings of its proposer.
        name: What `kerv train drafter drafter=NAME` calls it; empty: `kind`.
        sees: Whether it needs a target with cameras.
        colour: 0xRRGGBB of its rows, lines and timeline.
        traits: Those of the proposer.
    """
    add("artifact", kind, build, sees=sees)
    add("drafter", name or kind, build, settings)
    add("proposer", kind, f"{build}.proposer", proposer, (kind,), colour=colour, **traits)


def load(name: str) -> Any:
    """Import the object that `module:attribute` or `module:attribute.attribute` names.

    Raises:
        UsageError: No such module or attribute.
    """
    module, _, attribute = name.partition(":")
    try:
        imported = importlib.import_module(module)
    except ImportError as error:
        raise UsageError(f"{module} cannot be imported: {error}") from error
    try:
        return functools.reduce(getattr, attribute.split("."), imported)
    except AttributeError:
        raise UsageError(f"{module} has no {attribute}") from None


def find(kind: str, name: str, what: str = "") -> Part:
    """Return the part of a kind and name.

    Args:
        kind: Kind of part.
        name: Its name.
        what: How the message calls the kind.

    Raises:
        UnknownName: There is none. The message names the nearest ones.
    """
    by_name = parts(kind)
    if not isinstance(name, str) or name not in by_name:  # a damaged file may hold anything
        raise UnknownName(what or kind, str(name), by_name)
    return by_name[name]


def part_of(group: str, name: str) -> Part:
    """Return the part that a group of settings chooses. The part of a prefill draft is an ordinary proposer.

    Raises:
        UnknownName: There is none.
    """
    return find("proposer" if group == "prefill_draft" else group, name, f"{group}.kind")


def parts(kind: str) -> Mapping[str, Part]:
    """Return all parts of a kind by name, in the order of registration."""
    load_plugins()
    return _PARTS.get(kind, {})


def kinds() -> tuple[str, ...]:
    """Return every kind that has parts."""
    load_plugins()
    return tuple(_PARTS)


@functools.cache
def load_plugins() -> None:
    """Register kerv's own parts, then those of installed packages and of `KERV_PLUGINS`.

    Raises:
        UsageError: A plugin cannot be imported. The message names file and line.
    """
    for name in MODULES:
        importlib.import_module(name)
    files = [name.strip() for name in os.environ.get(PLUGINS, "").split(",") if name.strip()]
    for name in [*(entry.value for entry in entry_points(group="kerv.parts")), *files]:
        try:
            importlib.import_module(name)
        except Exception as error:
            what = error if isinstance(error, KervError) else f"{type(error).__name__}: {getattr(error, 'msg', error)}"
            raise UsageError(f"plugin {name}: {_place_of(error)}{what}; or leave it out of {PLUGINS}") from error


def _place_of(error: Exception) -> str:
    """Return `FILE:LINE: ` of an error in a plugin; empty if the plugin was not found."""
    if isinstance(error, SyntaxError):
        return f"{error.filename}:{error.lineno}: "
    frames = reversed(traceback.extract_tb(error.__traceback__)[2:])
    own = (one for one in frames if one.filename[0] != "<" and one.filename != __file__)
    return next((f"{one.filename}:{one.lineno}: " for one in own), "")
