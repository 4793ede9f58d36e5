"""Tables as text, for the terminal and the page: a declaration per column, and how numbers are written."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import pandas as pd

from kerv_cli.report.measures import Row
from kerv_cli.report.tables import is_baseline, is_number

TextOf = Callable[[Row], str]

LOST_WON = "lost/won of pairs"
"""Heading of `lost_won`, which no p stands without."""


@dataclass(frozen=True)
class Column:
    """A column of text. needs: a number of the row; where all rows lack it or have 0 the column is left out."""

    title: str
    text: TextOf
    needs: str = ""


def text_frame(rows: Iterable[Row], columns: Iterable[Column]) -> pd.DataFrame:
    """The rows as text."""
    rows = list(rows)
    present = [c for c in columns if not c.needs or any(is_number(row[c.needs]) and row[c.needs] for row in rows)]
    return pd.DataFrame([{column.title: column.text(row) for column in present} for row in rows])


def numbers(name: str) -> TextOf:
    """A column's value with three significant digits and no exponent; `–` where there is none."""

    def text(row: Row) -> str:
        value = row[name]
        if not is_number(value):
            return "–"
        return f"{value:.0f}" if abs(value) >= 100 else f"{value:#.3g}"

    return text


def shares(name: str) -> TextOf:
    """A column's share in per cent."""
    return lambda row: f"{100 * row[name]:.0f} %" if is_number(row[name]) else "–"


def intervals(name: str, scale: float = 1.0, digits: int = 2, between: str = "–") -> TextOf:
    """A column's value with its interval in brackets; `–` where there is none."""
    return lambda row: interval(row, name, scale, digits, between)


def compared(text: TextOf, of_baseline: str = "") -> TextOf:
    """The text of a setting; `of_baseline` for the baseline, which is not compared with itself."""
    return lambda row: of_baseline if is_baseline(row) else text(row)


def interval(row: Row, name: str, scale: float = 1.0, digits: int = 2, between: str = "–") -> str:
    """A value with its 95 % interval in brackets; `–` for a missing value."""
    if not is_number(row[name]):
        return "–"
    value = row[name] * scale
    # 99.5 % of success must not read as 100 %
    text = f"{value:.{digits}f}" if digits else f"{value:.1f}".removesuffix(".0")
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    return f"{text} ({low * scale:.{digits}f}{between}{high * scale:.{digits}f})" if is_number(low) else text


def p_value(row: Row) -> str:
    """McNemar's p; empty without pairs."""
    if not row["pairs"]:
        return ""
    return "<0.001" if row["mcnemar_p"] < 0.001 else f"{row['mcnemar_p']:.2g}"


def lost_won(row: Row) -> str:
    """Pairs that the baseline alone and the setting alone solved, of how many: what McNemar's p is of; empty without
    pairs."""
    return f"{row['only_baseline']}/{row['only_method']} of {row['pairs']}" if row["pairs"] else ""
