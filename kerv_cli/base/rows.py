"""Read an attribute of many objects at once, such as the label of every row of a table."""

from __future__ import annotations

from collections.abc import Iterable
from operator import attrgetter
from typing import Any, TypeVar

T = TypeVar("T")


def values_of(rows: Iterable[Any], name: str) -> list[Any]:
    """Return an attribute of each row, such as `label` or `measures.counts`."""
    return list(map(attrgetter(name), rows))


def distinct(rows: Iterable[Any], name: str) -> list[Any]:
    """Return the different values of an attribute, in the order of the rows."""
    return list(dict.fromkeys(map(attrgetter(name), rows)))


def keyed(rows: Iterable[T], name: str) -> dict[Any, T]:
    """Return a map from the value of an attribute, such as `label`, to the row that has this value."""
    return {getattr(row, name): row for row in rows}
