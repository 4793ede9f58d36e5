"""The main columns of a table as text, for the terminal and the report."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import pandas as pd
from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from kerv_cli.report.measures import MICRO, Row, registered_columns
from kerv_cli.report.tables import is_baseline, is_number, rows_of
from kerv_cli.report.text import (
    LOST_WON,
    Column,
    TextOf,
    compared,
    interval,
    intervals,
    lost_won,
    numbers,
    p_value,
    shares,
    text_frame,
)

APART = "*"
SPEEDS = {"episode_speedup": "per episode", "speedup": "per step"}
"""Speed against the baseline -> its heading."""

_SHARES = {
    "skip_rate": "skipped",
    "unverified_share": "unverified",
    "compensation_rate": "compensated",
    "retrieval_share": "retrieved",
}
_ALIKE = 0.02
"""Lengths of episodes that differ by a smaller share are alike."""

_SPARE = ("forwards / step", "felt ms", "AL", "ms / step", "p95 ms", "deviation", "AFEP")
"""Columns that a narrow terminal lacks where they do not fit, behind the speed per step and the shares, the most
important first."""
_LABEL = 16
"""Letters of a label that are not wrapped."""


def _speed(name: str) -> TextOf:
    """A speedup as text, marked if it is of some of the pairs alone; 1 for a baseline that was timed."""

    def text(row: Row) -> str:
        if is_baseline(row):
            return "1" if is_number(row["time_per_step_ms"]) else "–"
        apart = is_number(row["speedup"]) and row["same_block"] < 1 and not row["same_run"]
        return interval(row, name) + (APART if apart else "")

    return text


def _columns() -> list[Column]:
    return [
        Column("setting", lambda row: str(row["label"])),
        Column("success %", intervals("success", 100.0, 0)),
        *(Column(title, _speed(name)) for name, title in SPEEDS.items()),
        Column("p95 ms", numbers("latency_p95_ms")),
        Column("ms / step", numbers("time_per_step_ms")),
        Column("AL", numbers("AL")),
        Column("AFEP", numbers("AFEP")),
        Column("forwards / step", numbers("forwards_per_step")),
        *(Column(title, shares(name), needs=name) for name, title in _SHARES.items()),
        Column("deviation", numbers("deviation"), needs="deviation"),
        Column("felt ms", numbers("felt_latency_ms"), needs="felt_latency_ms"),
        Column("held", shares("held_share"), needs="held_share"),
        *(Column(name.replace("_", " "), numbers(name), needs=name) for name in registered_columns()),
        Column(LOST_WON, compared(lost_won)),
        Column("p", compared(p_value)),
    ]


@dataclass(frozen=True)
class SummaryTable:
    """A study's table for the terminal: its rows pooled over tasks, with all measures that fit; a narrow one wraps
    labels."""

    table: pd.DataFrame

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        frame = _fitting(summary_frame(self.table), options.max_width)
        yield Text(_title(self.table), style="bold", overflow="fold")
        yield _printed(frame)
        first, several = self.table["baseline"].iloc[0], self.table["baseline"].nunique() > 1
        against = f"{first}, under the same stress" if several else first
        yield Text(f"brackets: 95 % intervals; p: exact McNemar test against {against}")
        if frame["per episode"].str.endswith(APART).any():
            yield Text(f"{APART} of those pairs alone that were measured in turn")
        untimed = list(dict.fromkeys(self.table.loc[self.table["time_per_step_ms"].isna(), "label"]))
        if untimed:
            yield Text(f"not timed, for success alone: {', '.join(map(str, untimed))}")
        yield from (Text(reason) for reason in differences(rows_of(self.table, MICRO)))


def _printed(frame: pd.DataFrame) -> Table:
    printed = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=0)
    for name in frame.columns:
        left = name == "setting"  # labels wrap, measures do not
        head = "\n".join(_heading(name))
        printed.add_column(head, justify="left" if left else "right", overflow="fold", no_wrap=not left)
    for row in frame.itertuples(index=False):
        printed.add_row(*(escape(str(value)) for value in row))
    return printed


def _heading(name: str) -> list[str]:
    """A column's heading in lines."""
    short = name.replace("forwards", "fwd").replace(" / ", "\n/ ")
    return short.replace("lost/won of", "lost/won\nof").replace(": ", ":\n").split("\n")


def _width(frame: pd.DataFrame) -> int:
    """Characters of a printed table whose labels are wrapped where that helps."""
    wide = [max(map(len, [*_heading(name), *frame[name]])) for name in frame.columns]
    words = " ".join(frame["setting"]).split()
    return sum(wide) - max(0, wide[0] - max([_LABEL, *map(len, words)])) + len(wide) - 1


def _fitting(frame: pd.DataFrame, width: int) -> pd.DataFrame:
    """The columns that fit into so many characters."""
    if _width(frame) <= width:
        return frame
    spares = ("per step", *_SHARES.values(), "held", *_SPARE)
    fitting = frame.drop(columns=list(spares), errors="ignore")
    for spare in spares:
        wider = frame[[name for name in frame.columns if name in fitting or name == spare]]
        fitting = wider if _width(wider) <= width else fitting
    return fitting


def summary_frame(table: pd.DataFrame, averaging: str = MICRO) -> pd.DataFrame:
    """The rows of one averaging as text: 95 % intervals in brackets, `–` for missing values; columns that no row uses
    are left out."""
    return text_frame(rows_of(table, averaging), _columns())


def not_in_turn(table: pd.DataFrame) -> list[str]:
    """Labels with times whose ratio to the baseline's does not exist: none of the pairs was measured in turn."""
    timed = table["time_per_step_ms"].notna() & (table["forwards_per_step"] + table["skip_rate"] > 0)
    rows = table[timed & (table["label"] != table["baseline"]) & (table["pairs"] > 0) & table["speedup"].isna()]
    of_baseline = table.loc[table["label"] == table["baseline"], "time_per_step_ms"].notna().all()
    return [str(label) for label in dict.fromkeys(rows["label"])] if of_baseline else []


def _title(table: pd.DataFrame) -> str:
    rows = table[table["averaging"] == MICRO]
    first = rows.iloc[0]
    counts = f"{rows['tasks'].max()} tasks, {rows['episodes'].max()} episodes each"
    return f"{first['study']}: {counts}, {MICRO}, {first['device_name']}, {first['dtype']}"


def why_different(row: Row, reference: Row) -> str:
    """Why a row's speed per episode differs from that per control step, in one line; empty where their intervals
    overlap.

    Args:
        row, reference: a row of a study's table and its baseline's.
    """
    names = ("episode_speedup", "episode_speedup_low", "episode_speedup_high", "speedup", "speedup_low", "speedup_high")
    episode, low, high, step, step_low, step_high = (float(row[name]) for name in names)
    if math.isnan(low + high + step_low + step_high) or (low <= step_high and step_low <= high):
        return ""
    lengths = [r["steps"] / r["episodes"] for r in (row, reference)]
    failures = [r["episodes"] / max(1, r["repeats"]) - r["successes"] for r in (row, reference)]
    reasons = [f"{lengths[0]:.0f} control steps an episode instead of {lengths[1]:.0f}"]
    if failures[0] != failures[1]:
        more = "more" if failures[0] > failures[1] else "fewer"
        reasons.append(f"{more} failures, which run to the horizon ({failures[0]:.0f} instead of {failures[1]:.0f})")
    if abs(lengths[0] / lengths[1] - 1) < _ALIKE:
        reasons.append("its time per step is lower in short episodes than in long ones" if episode < step
                       else "its time per step is lower in long episodes than in short ones")  # fmt: skip
    return f"{row['label']}: {episode:.2f} per episode, {step:.2f} per step: {', '.join(reasons)}"


def differences(rows: Sequence[Row]) -> list[str]:
    """`why_different` of all rows of a study's table, those without a reason left out."""
    by_label = {row["label"]: row for row in rows}
    reasons = [why_different(row, by_label[row["baseline"]]) for row in rows if row["baseline"] in by_label]
    return [reason for reason in reasons if reason]
