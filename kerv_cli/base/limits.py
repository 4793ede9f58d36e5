"""The range of every setting. It is stated beside the default, and checked whenever settings are composed or read."""

from __future__ import annotations

import functools
import math
import re
from dataclasses import Field, field, fields, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

from kerv_cli.base.errors import UnknownName, UsageError

MOST_TOKENS = 65_536  # of a draft or its tree
MOST_BINS = 65_536
MOST_DECODES = 1_000_000  # of an episode, in which a setting may count

PLAIN_NAME = re.compile(r"\w[\w.+-]{0,199}")
"""Names of folders in the results folder: no separators, not hidden, never `..`."""


def setting(default: Any, help: str = "", **metadata: Any) -> Any:
    """Return a field of a settings dataclass.

    Args:
        default: A value, or a dataclass or function that makes one.
        help: What the setting is, in one line without its default, for `--help` and `--cfg`.
        **metadata: Further facts about the field.
    """
    metadata |= {"help": help} if help else {}
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    if isinstance(default, list | dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


def limits(least: float = -math.inf, most: float = math.inf, above: float = -math.inf) -> dict[str, Any]:
    """Return metadata for a field whose numbers lie in `least` ≤ value ≤ `most` and above `above`.

    They hold for the value itself, or for each element of a list. None is allowed, NaN is not.
    """
    return {"limits": (least, most, above)}


def number(
    default: float | None, least: float = -math.inf, most: float = math.inf, above: float = -math.inf, help: str = ""
) -> Any:
    """Return a `setting` with `limits`."""
    return setting(default, help, **limits(least, most, above))


def choice(default: str, *names: str, help: str = "") -> Any:
    """Return a `setting` that is one of `names`. The default is one of them."""
    return setting(default, help, names=names)


def field_of(schema: type, key: str) -> tuple[Field[Any] | None, Any]:
    """Return the field of a dotted key of a settings class, and its default.

    Both are None for a key that only a chosen part has.
    """
    value, at = schema(), None
    for name in key.split("."):
        at = next((at for at in fields(value) if at.name == name), None) if is_dataclass(value) else None
        value = getattr(value, name, None)
    return at, value


def description(at: Field[Any]) -> str:
    """Return what a setting is: its `help`, after the names that it can have."""
    return ": ".join(filter(None, (" | ".join(at.metadata.get("names", ())), at.metadata.get("help", ""))))


def check_name(name: str, what: str) -> str:
    """Return `name`, which must be a plain folder name.

    Raises:
        UsageError: It is not.
    """
    if not PLAIN_NAME.fullmatch(name):
        raise UsageError(
            f"{what} '{name}' must be letters, digits, '_', '-', '+', '.' and begin with a letter or a digit"
        )
    return name


def check_label(label: str) -> str:
    """Return the label of a setting, which must be one printable line.

    Raises:
        UsageError: It is not.
    """
    if not 0 < len(label) <= 1000 or not label.isprintable():
        raise UsageError(f"'{' '.join(label[:80].split())}' names no setting: write one line of text")
    return label


def check_settings(settings: Any, what: str = "") -> None:
    """Check a dataclass of settings and those inside it: types of elements, limits, choices.

    A dataclass can check its fields together in a method `check_together`.

    Args:
        settings: The dataclass.
        what: Its dotted key in messages; empty for the root.

    Raises:
        UsageError: The first setting that is wrong.
    """
    prefix = f"{what}." if what else ""
    for at, element in _declared(type(settings)):  # type: ignore[arg-type]
        name, value = f"{prefix}{at.name}", getattr(settings, at.name)
        values = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else [value]
        if element is not None and not isinstance(value, list | dict):
            raise UsageError(f"{name}={value}: a list or a mapping is wanted", name)
        if element is not None and not all(isinstance(x, element) for x in values):
            raise UsageError(f"{name}={value}: every element must be of type {element.__name__}", name)
        for x in values:
            _check_value(name, x, at.metadata)
        if is_dataclass(value):
            check_settings(value, name)
    together = getattr(settings, "check_together", None)
    if together is not None:
        together(prefix)


@functools.cache
def _declared(kind: type) -> tuple[tuple[Field[Any], type | None], ...]:
    """Return the fields of a dataclass, each with the type of its elements if it is a list or dict of plain values."""
    hints = get_type_hints(kind)

    def element(name: str) -> type | None:
        inner = get_args(hints[name])[-1] if get_origin(hints[name]) in (list, dict) else None
        return inner if inner in (str, int, float, bool) else None

    return tuple((at, element(at.name)) for at in fields(kind))


def _check_value(name: str, value: Any, metadata: Any) -> None:
    if value is None:
        return
    if "names" in metadata and value not in metadata["names"]:
        raise UnknownName(name, str(value), metadata["names"])
    if "limits" in metadata:
        least, most, above = metadata["limits"]
        if isinstance(value, str) or not (least <= value <= most and value > above):
            raise UsageError(f"{name}={value}: {_range_text(least, most, above)}", name)


def _range_text(least: float, most: float, above: float) -> str:
    low = f"above {above:g}" if not math.isinf(above) else f"at least {least:g}" if not math.isinf(least) else ""
    if math.isinf(most):
        return low or "a number"
    high = f"{most:g}" if most != int(most) or most < 10**6 else f"{int(most)}"
    if low.startswith("at least"):
        return f"from {least:g} to {high}"
    return f"{low}, at most {high}" if low else f"at most {high}"
