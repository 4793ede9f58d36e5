"""The registry of parts, by kind and name. Parts are proposers, artifacts, targets, environments, commands, ….

A part's name, settings and required artifacts are known without importing torch or MuJoCo. Its `build` names the code
that makes it, as `module:function` or `module:Class.method`. That module is imported when the part is built.

Plugins register parts of their own when they are imported. kerv imports the modules that installed packages name in the
entry point group `kerv.parts`, and those in the environment variable KERV_PLUGINS (separated by commas).
"""

from __future__ import annotations

import functools
import importlib
import os
import pkgutil
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
    "kerv_cli.methods.contact",
    "kerv_cli.methods.heisd",
    "kerv_cli.methods.jacobi",
    "kerv_cli.methods.merged",
    "kerv_cli.methods.certified",
)
"""Modules that register kerv's own parts when they are imported. They import neither torch nor MuJoCo.

Error messages list parts in this order.
"""

METHOD_KINDS = ("prefill_draft", "proposer", "acceptance", "threshold", "rectifier", "boundary", "skip")
"""The parts of a method, in the order in which a decode uses them."""

PART_GROUPS = (*METHOD_KINDS, "datastore")
"""Groups of a rollout's settings that choose a part, as in `proposer=drafter`. YAML files in conf/<group>/ are further
choices."""

SETTINGS_GROUPS = (*PART_GROUPS, "drafter")
"""The groups of a rollout that choose a part, and `drafter=`, which chooses the drafter that is trained."""

DRAFTING = "draft"
"""Kind of cost of a proposer that drafts with a drafter layer of the target's shape (docs/measuring.md)."""

PREFILL, STATES = "prefill", "states"
"""When a proposer can draft: before the prefill, or only after it, because it reads the target's hidden states."""


@dataclass
class NoSettings:
    """Settings of a part that has no settings except its name."""

    kind: str = "none"


@dataclass(frozen=True)
class Part:
    """A registered part: one of the choices of its kind, such as the proposer `drafter`.

    Args:
        kind: proposer, acceptance, threshold, rectifier, boundary, skip, datastore, artifact, target, environment,
            stress, column or command.
        name: The name by which it is chosen.
        build: The code that makes it, as `module:function` or `module:Class.method`. For the parts of a method,
            `methods/context.py` describes the arguments. Empty: choosing this name means having no such part.
        settings: Dataclass of its settings, with defaults and limits.
        needs: Function of the part's settings. It returns the kinds of artifacts that must exist to use the part. For
            an artifact, it returns the kinds of artifacts from which the artifact is made.
        colour: Colour in tables and plots, 0xRRGGBB. None: no colour of its own.
        traits: Further properties that other modules read. docs/extending.md lists them.
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
        """Whether choosing this name means having no such part, as in `proposer=none`."""
        return not self.build

    @property
    def default(self) -> Any:
        """The part's default settings."""
        return self.settings(kind=self.name)

    def built(self, *arguments: Any, **keywords: Any) -> Any:
        """Import the code that makes the part, call it with these arguments, and return its result.

        Return None if choosing the part means having none, as in `proposer=none`.
        """
        return load(self.build)(*arguments, **keywords) if self.build else None


_PARTS: dict[str, dict[str, Part]] = {}


def add(
    kind: str,
    name: str,
    build: str = "",
    settings: type = NoSettings,
    needs: tuple[str, ...] | Callable[[Any], tuple[str, ...]] = (),
    colour: int | None = None,
    **traits: Any,
) -> None:
    """Register a part; see `Part`. A module that is reloaded can register its parts again.

    Args:
        kind: Kind of part, such as `proposer`.
        name: The name by which it is chosen.
        build: The code that makes it, as `module:function`. Empty: the name means having no such part.
        settings: Dataclass of its settings.
        needs: Kinds of artifacts that must exist to use it, or a function of its settings that returns them.
        colour: Colour in tables and plots, 0xRRGGBB.
        **traits: Further properties that other modules read. docs/extending.md lists them.

    Raises:
        UsageError: A part of the same kind and name, but with a different `build`, is registered already.
    """
    same = _PARTS.setdefault(kind, {})
    if name in same and same[name].build != build:
        raise UsageError(f"{kind} '{name}' is registered twice: {same[name].build} and {build}")
    same[name] = Part(kind, name, build, settings, needs if callable(needs) else lambda _: needs, colour, traits)


def add_drafter(
    kind: str,
    build: str,
    settings: type,
    proposer: type = NoSettings,
    sees: bool = False,
    colour: int | None = None,
    **traits: Any,
) -> None:
    """Register both parts of a trained drafter: its artifact and its proposer.

    Args:
        kind: Name of the artifact and of the proposer. `kerv train drafter drafter=KIND` trains it.
        build: Subclass of `TrainableDrafter` (`kerv_cli/methods/drafters.py`), as `module:Class`.
        settings: Dataclass of the settings of its shapes and training.
        proposer: Dataclass of the settings of its proposer.
        sees: Whether it needs a target that reads images.
        colour: Colour in tables and plots, 0xRRGGBB.
        **traits: Further properties of the proposer. docs/extending.md lists them.
    """
    add("artifact", kind, build, settings, sees=sees)
    add("proposer", kind, f"{build}.proposer", proposer, (kind,), colour=colour, **traits)


def load(name: str) -> Any:
    """Import an object by its name, written as `module:attribute` or `module:attribute.attribute`.

    Raises:
        UsageError: The module cannot be imported, or it has no such attribute.
    """
    try:
        return pkgutil.resolve_name(name)
    except ImportError as error:
        raise UsageError(f"{name} cannot be imported: {error}") from error
    except AttributeError:
        raise UsageError(f"{name} does not exist") from None


def find(kind: str, name: str, what: str = "") -> Part:
    """Return a registered part.

    Args:
        kind: Kind of part, such as `proposer`.
        name: Name of the part.
        what: Text for the error message instead of the kind.

    Raises:
        UnknownName: No part of this kind has the name. The message suggests similar names.
    """
    by_name = parts(kind)
    if not isinstance(name, str) or name not in by_name:  # a damaged file may hold anything
        raise UnknownName(what or kind, str(name), by_name)
    return by_name[name]


def part_of(group: str, name: str) -> Part:
    """Return the part with this name in a group of settings.

    Args:
        group: Name of the group, such as `acceptance`. Parts of the group `prefill_draft` are proposers.
        name: Name of the part.

    Raises:
        UnknownName: No such part is registered.
    """
    return find("proposer" if group == "prefill_draft" else group, name, f"{group}.kind")


def parts(kind: str) -> Mapping[str, Part]:
    """Return the parts of a kind as a map from name to part, in the order of registration.

    `drafter` is a special case. It gives the parts of the kind `artifact` that have settings: only those are trained.
    """
    load_plugins()
    if kind == "drafter":
        return {name: part for name, part in _PARTS["artifact"].items() if part.settings is not NoSettings}
    return _PARTS.get(kind, {})


def kinds() -> tuple[str, ...]:
    """Return the kinds of all registered parts."""
    load_plugins()
    return tuple(_PARTS)


@functools.cache
def load_plugins() -> None:
    """Register kerv's own parts, then those of plugins: installed packages and the modules in `KERV_PLUGINS`.

    Raises:
        UsageError: A plugin cannot be imported. The message names its file and line.
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
    """Return where a plugin raised an error, as `FILE:LINE: `. Empty if the plugin was not found."""
    if isinstance(error, SyntaxError):
        return f"{error.filename}:{error.lineno}: "
    frames = reversed(traceback.extract_tb(error.__traceback__)[2:])
    own = (one for one in frames if one.filename[0] != "<" and one.filename != __file__)
    return next((f"{one.filename}:{one.lineno}: " for one in own), "")
