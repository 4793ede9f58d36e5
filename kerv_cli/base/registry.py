"""The registry of parts, by kind and name. Parts are proposers, artifacts, targets, environments, commands, ….

A part is a class or function with a decorator, such as `@SkipPart("streak", StreakSkipSettings, takes_draft=True)`. The
decorator states the name, the settings and further attributes. Error messages list parts in the order of registration.

The modules that register kerv's own parts import neither torch nor MuJoCo. A part that needs them imports them when it
is built.

Plugins register parts of their own when they are imported. kerv imports the modules that installed packages name in the
entry point group `kerv.parts`, and the modules that the environment variable KERV_PLUGINS names, separated by commas.
"""

from __future__ import annotations

import functools
import importlib
import os
import pkgutil
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import entry_points
from operator import attrgetter
from typing import Any, ClassVar, Literal, Self, TypeVar, cast

from kerv_cli.base.errors import KervError, UnknownName, UsageError

PLUGINS = "KERV_PLUGINS"

_COMMANDS = "doctor rollout sweep report board view demos train prepare build calibrate runs serve work estimate bench"

# For each kind, the modules that register kerv's own parts, in order. METHODS registers the parts of other kinds.
MODULES: Mapping[str, Sequence[str]] = {
    "command": tuple(f"kerv_cli.cli.{name}" for name in _COMMANDS.split()),
    "environment": ("kerv_cli.worlds",),
    "stress": ("kerv_cli.worlds.stress",),
    "target": ("kerv_cli.targets",),
}

METHODS = ("kerv_cli.methods",)

# The kinds of parts that make up a method, in the order in which a decode uses them.
METHOD_KINDS = ("prefill_draft", "proposer", "acceptance", "threshold", "rectifier", "boundary", "skip")

# Groups of settings that choose a part, as in `proposer=drafter`. YAML files in conf/<group>/ are further choices.
# `drafter` chooses what `kerv train drafter` trains.
SETTINGS_GROUPS = (*METHOD_KINDS, "drafter")

# Kind of cost (docs/measuring.md) of a proposer whose drafter is one decoder layer of the target's shape.
DRAFTING = "draft"

PREFILL: Literal["prefill"] = "prefill"
# When a proposer can draft. PREFILL: before the target's prefill. STATES: only after the prefill, because the
# proposer reads the target's hidden states.
STATES: Literal["states"] = "states"

C = TypeVar("C")


@dataclass
class NoSettings:
    """Settings of a part that has no settings except its name."""

    kind: str = "none"


@dataclass(frozen=True)
class Part:
    """A registered part, which is one of the choices of its kind. Also the decorator that registers the part.

    A subclass for each kind adds attributes that other modules read.

    Args:
        name: Name that chooses the part, such as `drafter` in `proposer=drafter`.
        settings: Dataclass of the part's settings, with defaults and limits.
        needs: Kinds of artifacts that the part needs, such as `drafter`, or a function that returns these kinds for
            the part's settings. For an artifact: kinds of artifacts from which it is made.
        colour: Colour in tables and plots, 0xRRGGBB. None if the part has no colour of its own.
        idle: Function that takes the part's settings. It returns each setting that has no effect, with the reason.
        any_code: For a part of a method: whether it works with tokens that have no distance, see `ActionSpace.code`.
        code: The decorated class or function. None for a name such as `none` in `proposer=none`: the
            method then has no part of this kind.
    """

    kind: ClassVar[str]

    name: str
    settings: type = NoSettings
    needs: tuple[str, ...] | Callable[[Any], tuple[str, ...]] = field(default=(), kw_only=True)
    colour: int | None = field(default=None, kw_only=True)
    idle: Callable[[Any], Mapping[str, str]] = field(default=lambda settings: {}, kw_only=True)
    any_code: bool = field(default=False, kw_only=True)
    code: Any = field(default=None, kw_only=True)

    def __call__(self, code: C) -> C:
        """Register the part with the decorated class or function. Return that class or function.

        Raises:
            UsageError: The class lacks methods of its interface, or another part has the name.
        """
        missing = getattr(code, "__abstractmethods__", ())
        if missing:
            raise UsageError(f"{self.kind} '{self.name}' lacks the method {', '.join(sorted(missing))}")
        replace(self, code=code).add()
        return code

    def add(self) -> None:
        """Register the part. A module that is reloaded can register its parts again.

        Raises:
            UsageError: A part of the same kind and name, but with other code, is registered already.
        """
        same = _PARTS.setdefault(self.kind, {})
        known = same.get(self.name, self)
        if known.origin != self.origin:
            raise UsageError(f"{self.kind} '{self.name}' is registered twice: {known.origin} and {self.origin}")
        same[self.name] = self

    @classmethod
    def every(cls) -> Mapping[str, Self]:
        return {name: part for name, part in parts(cls.kind).items() if isinstance(part, cls)}

    @classmethod
    def find(cls, name: str, what: str = "") -> Self:
        return cast(Self, find(cls.kind, name, what))

    @property
    def module(self) -> str:
        return getattr(self.code, "__module__", "")

    @property
    def origin(self) -> str:
        return "" if self.code is None else f"{self.module}:{self.code.__qualname__}"

    @property
    def absent(self) -> bool:
        return self.code is None

    @property
    def default(self) -> Any:
        return self.settings(kind=self.name)

    def check_code(self, group: str, coded: bool) -> None:
        """Refuse a part that compares tokens by distance if the tokens are `coded` (FAST): these have no distance."""
        if coded and not (self.absent or self.any_code):
            raise UsageError(
                f"{group}={self.name}: it needs a distance between tokens, and the target's code has none; choose a "
                "lossless method, such as method=naive_sd"
            )

    def needed(self, settings: Any) -> tuple[str, ...]:
        """Return the kinds of artifacts that must exist to use the part with these settings."""
        return self.needs(settings) if callable(self.needs) else self.needs

    def built(self, *arguments: Any) -> Any:
        """Build the part: call its function, or the `build` method of its class, or else the class itself.

        Args:
            arguments: For a part of a method, its settings and the `Context` (`kerv_cli/methods/context.py`).

        Returns:
            The part. None if there is no part, as in `proposer=none`, or if the method works without the part.
        """
        return None if self.code is None else getattr(self.code, "build", self.code)(*arguments)


_PARTS: dict[str, dict[str, Part]] = {}


@dataclass(frozen=True, kw_only=True)
class ProposerPart(Part):
    """A registered proposer, which drafts tokens.

    Args:
        when: PREFILL if the proposer reads only the prompt, executed actions and committed tokens. STATES if it reads
            the target's hidden states.
        chains: Whether the proposer drafts chains, so that `proposer=merged` and `skip=always` can use it.
        drafts_whole_chunk: Whether it drafts every token of a chunk.
        merged: Whether it merges chains of several proposers.
        has_boundary: Whether a boundary chooses between retrieval and a drafter.
        looks_up: Whether it searches a datastore.
        cost: Key of a draft's seconds in a latency profile. Empty if a draft costs nothing.
        measured_by: Name of the method that `kerv bench` runs to measure this cost. Empty if the cost is not measured.
    """

    kind = "proposer"
    when: Literal["prefill", "states"]
    chains: bool = False
    drafts_whole_chunk: bool = False
    merged: bool = False
    has_boundary: bool = False
    looks_up: bool = False
    cost: str = ""
    measured_by: str = ""


@dataclass(frozen=True, kw_only=True)
class DrafterPart(ProposerPart):
    """A drafter with weights. It is a proposer, and an artifact that `kerv train drafter drafter=NAME` trains.

    The decorated function imports and returns the subclass of `TrainableDrafter` (`kerv_cli/methods/drafters.py`).
    `settings` is the class of the proposer's settings.

    Args:
        trained: Dataclass of the settings for the drafter's shape and training.
    """

    trained: type

    def add(self) -> None:
        ArtifactPart(self.name, self.trained, code=self.code).add()
        super().add()

    def needed(self, settings: Any) -> tuple[str, ...]:
        return (self.name,)

    def built(self, settings: Any, context: Any) -> Any:
        return self.code().proposer(settings, context)


@dataclass(frozen=True, kw_only=True)
class AcceptancePart(Part):
    """A registered acceptance rule, which decides which draft tokens are accepted.

    Args:
        reads_threshold: Whether the rule uses the acceptance radius that the threshold gives.
    """

    kind = "acceptance"
    reads_threshold: bool = True


@dataclass(frozen=True, kw_only=True)
class ThresholdPart(Part):
    """A registered threshold: the rule that chooses the acceptance radius r of each decode.

    Args:
        radius: Name of the setting with the largest radius, such as `r_max`. A radius that is larger than the largest
            distance between two tokens is refused. Empty if there is no such setting.
    """

    kind = "threshold"
    radius: str = ""


class RectifierPart(Part):
    """A rectifier, which completes a chunk after a rejection."""

    kind = "rectifier"


@dataclass(frozen=True, kw_only=True)
class BoundaryPart(Part):
    """A boundary, which decides what drafts the next chunk, or how many tokens of the chunk are decoded.

    Args:
        chooses: Whether it chooses between retrieval and the drafter, for `proposer=hybrid`.
    """

    kind = "boundary"
    chooses: bool = False


@dataclass(frozen=True, kw_only=True)
class SkipPart(Part):
    """A skip rule, which decides whether a chunk is executed without verification.

    Args:
        takes_draft: Whether the rule can execute the prefill draft.
        merges: Whether the prefill draft may be merged from several proposers.
        verifies: Whether it ever lets the target verify a draft.
    """

    kind = "skip"
    takes_draft: bool = False
    merges: bool = False
    verifies: bool = True


@dataclass(frozen=True, kw_only=True)
class ArtifactPart(Part):
    """A kind of artifact. The decorated function returns the subclass of `Artifact` that makes and loads it.

    Args:
        by_task: Whether it contains separate numbers or data for each task.
        needs_task: Whether it can be used only for tasks that it contains.
        described_by: Name of the file that describes the artifact. If empty, it is `<kind>.json`.
    """

    kind = "artifact"
    by_task: bool = False
    needs_task: bool = False
    described_by: str = ""

    def built(self) -> Any:
        return self.code()()


class ColumnPart(Part):
    """A column of tables. The decorated function takes a data frame of one setting's episodes and returns a number."""

    kind = "column"


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
    by_name = parts(kind)
    if not isinstance(name, str) or name not in by_name:  # a damaged file may hold anything
        raise UnknownName(what or kind, str(name), by_name)
    return by_name[name]


def part_of(group: str, name: str) -> Part:
    return find("proposer" if group == "prefill_draft" else group, name, f"{group}.kind")


def parts(kind: str, module: str = "") -> Mapping[str, Part]:
    """Return the parts of a kind by name, in the order of registration.

    `kind="drafter"` returns the artifacts that have settings, because only these are trained. With `module`, a name in
    MODULES, no other module of kerv is imported.
    """
    load_plugins()
    if kind == "drafter":
        return {name: part for name, part in parts("artifact").items() if part.settings is not NoSettings}
    for name in [module] if module else MODULES.get(kind, METHODS):
        importlib.import_module(name)
    return _PARTS.get(kind, {})


def kinds() -> tuple[str, ...]:
    load_plugins()
    _load_all()
    return tuple(_PARTS)


def _load_all() -> None:
    for names in (*MODULES.values(), METHODS):
        for name in names:
            importlib.import_module(name)


@functools.cache
def load_plugins() -> None:
    """Register the parts that plugins define: installed packages, and modules named in `KERV_PLUGINS`.

    kerv's own parts are registered first, so that a plugin cannot take their names.

    Raises:
        UsageError: A plugin cannot be imported. The message names its file and line.
    """
    plugins = list(map(attrgetter("value"), entry_points(group="kerv.parts")))
    plugins += os.environ.get(PLUGINS, "").replace(",", " ").split()
    if plugins:
        _load_all()
    for name in plugins:
        try:
            importlib.import_module(name)
        except Exception as error:
            what = error if isinstance(error, KervError) else f"{type(error).__name__}: {getattr(error, 'msg', error)}"
            raise UsageError(f"plugin {name}: {_line_of(error)}{what}; or leave it out of {PLUGINS}") from error


def _line_of(error: Exception) -> str:
    if isinstance(error, SyntaxError):
        return f"{error.filename}:{error.lineno}: "
    for one in reversed(traceback.extract_tb(error.__traceback__)[2:]):
        if one.filename[0] != "<" and one.filename != __file__:
            return f"{one.filename}:{one.lineno}: "
    return ""
