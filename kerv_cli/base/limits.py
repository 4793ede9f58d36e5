"""Make fields of settings dataclasses, with a description and the allowed values, and check the values."""

from __future__ import annotations

import functools
import math
from dataclasses import Field, field, fields, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

from kerv_cli.base.errors import UnknownName, UsageError

MOST_TOKENS = 65_536  # limit of settings that count tokens of a draft or nodes of its tree
MOST_BINS = 65_536  # limit of settings that are distances between tokens
MOST_DECODES = 1_000_000  # limit of settings that count decodes of an episode


def setting(default: Any, help: str = "", **metadata: Any) -> Any:
    """Make a field of a settings dataclass.

    `default` is the value, or a function (such as a dataclass) that makes it. `help` is one line for `--help` and
    `--cfg`. `metadata` can have `limits` (from the function `limits`), `names` (the allowed values) and `group` (the
    default file in the folder of conf/ that has the field's name).
    """
    metadata |= {"help": help} if help else {}
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    if isinstance(default, list | dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


def limits(least: float = -math.inf, most: float = math.inf, above: float = -math.inf) -> dict[str, Any]:
    """Return metadata that limit a number, or every number in a list or mapping. None is allowed, NaN is not."""
    return {"limits": (least, most, above)}


def number(
    default: float | None, least: float = -math.inf, most: float = math.inf, above: float = -math.inf, help: str = ""
) -> Any:
    """Return a field of a settings dataclass that holds a number. A default of None makes it optional."""
    return setting(default, help, **limits(least, most, above))


def choice(default: str, *names: str, help: str = "") -> Any:
    return setting(default, help, names=names)


def description(at: Field[Any]) -> str:
    return ": ".join(filter(None, (" | ".join(at.metadata.get("names", ())), at.metadata.get("help", ""))))


def check_label(label: str) -> str:
    if not 0 < len(label) <= 1000 or not label.isprintable():
        raise UsageError(f"'{' '.join(label[:80].split())}' names no setting: write one line of text")
    return label


def check_settings(settings: Any, what: str = "") -> None:
    """Check all values in a settings dataclass and in the dataclasses inside it. In errors, `what.` precedes each key.

    If a dataclass has a method `check_together(prefix)`, it is called to check settings that depend on each other.
    """
    prefix = f"{what}." if what else ""
    for at, element in _declared(type(settings)):  # type: ignore[arg-type]
        name, value = f"{prefix}{at.name}", getattr(settings, at.name)
        values = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else [value]
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
    # each field, with the type of its elements if it is a list or a dict of plain values, else None
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
    if least > -math.inf and most < math.inf:
        return f"from {least:g} to {most:.12g}"
    low = f"above {above:g}" if above > -math.inf else f"at least {least:g}" if least > -math.inf else ""
    high = f"at most {most:.12g}" if most < math.inf else ""
    return ", ".join(filter(None, (low, high))) or "a number"
