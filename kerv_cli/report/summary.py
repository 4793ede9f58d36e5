"""The main columns of a table as text, for the terminal and the report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd
from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from kerv_cli.report.measures import MICRO, own_columns
from kerv_cli.report.motion import differences
from kerv_cli.report.tables import is_number, rows_of

APART = "*"
WIDE = 130
"""Columns of a terminal that hold every measure."""

SPEEDS = {"episode_speedup": "per episode", "speedup": "per step"}
"""Speed against the baseline -> its heading."""

_MOTION = {
    "steps_to_success": "control steps",
    "path_m": "path, m",
    "jerk": "jerk, m/s³",
    "gripper_switches": "switches",
}
_ALWAYS = {"AL": "AL", "AFEP": "AFEP", "forwards_per_step": "forwards / step"}
_WHERE_USED = {
    "skip_rate": "skipped",
    "unverified_share": "unverified",
    "compensation_rate": "compensated",
    "retrieval_share": "retrieved",
    "deviation": "deviation",
    "felt_latency_ms": "felt ms",
    "held_share": "held",
}
_PERCENT = frozenset({"skip_rate", "unverified_share", "compensation_rate", "retrieval_share", "held_share"})


@dataclass(frozen=True)
class SummaryTable:
    """The rows of one averaging of `study_table`, for the terminal. From `WIDE` columns on every measure is there;
    80 columns hold labels of 16 characters and fewer measures."""

    table: pd.DataFrame
    averaging: str = MICRO

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        full = summary_frame(self.table, self.averaging)
        frame = full if options.max_width >= WIDE else _narrow(full)
        yield Text(_title(self.table, self.averaging), style="bold", overflow="fold")
        yield _printed(frame)
        first, several = self.table["baseline"].iloc[0], self.table["baseline"].nunique() > 1
        against = f"{first}, under the same stress" if several else first
        yield Text(f"brackets: 95 % intervals; p: exact McNemar test against {against}")
        if frame["per step"].str.endswith(APART).any():
            yield Text(f"{APART} of those pairs alone that were measured in turn")
        untimed = list(dict.fromkeys(self.table.loc[self.table["time_per_step_ms"].isna(), "label"]))
        if untimed:
            yield Text(f"not timed, for success alone: {', '.join(map(str, untimed))}")
        if "ceiling" in frame:
            yield Text("ceiling: speed per step if every chunk were accepted whole at once")
        yield from (Text(reason) for reason in differences(rows_of(self.table, self.averaging)))
        motion = motion_frame(self.table, self.averaging)
        if motion is not None and options.max_width >= WIDE:
            yield Text("Successful episodes, and ratios over the pairs in which both succeeded", style="bold")
            yield _printed(motion)


def _printed(frame: pd.DataFrame) -> Table:
    printed = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=0)
    for name in frame.columns:
        left = name == "setting"
        head = name.replace("forwards", "fwd").replace(" / ", "\n/ ").replace("ceiling", "ceil-\ning")
        interval = name in ("success %", "per episode", "per step")  # labels wrap, intervals do not
        printed.add_column(head, justify="left" if left else "right", overflow="fold", no_wrap=interval)
    for row in frame.itertuples(index=False):
        printed.add_row(*(escape(str(value)) for value in row))
    return printed


def summary_table(table: pd.DataFrame, averaging: str = MICRO) -> SummaryTable:
    """A study's table for the terminal."""
    return SummaryTable(table, averaging)


def _narrow(frame: pd.DataFrame) -> pd.DataFrame:
    """Fewer columns, for a terminal, and the shares of decodes in one."""
    dropped = ["AL", "AFEP", "ms / step", "p95 ms", "ceiling", "lost/won", "deviation"]
    frame = frame.drop(columns=dropped, errors="ignore")
    shares = [name for key, name in _WHERE_USED.items() if key in _PERCENT and name in frame]
    if shares:
        together = frame[shares].apply(lambda row: "/".join(text.removesuffix(" %") for text in row), axis=1)
        frame.insert(list(frame.columns).index(shares[0]), " / ".join(shares) + " %", together)
    return frame.drop(columns=shares)


def summary_frame(table: pd.DataFrame, averaging: str = MICRO) -> pd.DataFrame:
    """The rows of one averaging as text: 95 % intervals in brackets, `–` for missing values; columns that no row uses
    are left out."""
    rows = rows_of(table, averaging)
    optional = {**_WHERE_USED, **{name: name.replace("_", " ") for name in own_columns()}}
    used = {key: name for key, name in optional.items() if any(is_number(row[key]) and row[key] for row in rows)}
    limited = any(is_number(row["ceiling"]) for row in rows)
    return pd.DataFrame([_cells(row, _ALWAYS | used, limited) for row in rows])


def _cells(row: Mapping[str, Any], columns: Mapping[str, str], limited: bool) -> dict[str, str]:
    reference = row["label"] == row["baseline"]
    return {
        "setting": str(row["label"]),
        "success %": _interval(row, "success", 100.0, 0),
        **{name: _one(row) if reference else _interval(row, key, 1.0, 2) + _apart(row) for key, name in SPEEDS.items()},
        **({"ceiling": number(row["ceiling"])} if limited else {}),
        "p95 ms": number(row["latency_p95_ms"]),
        "ms / step": number(row["time_per_step_ms"]),
        **{name: _percent(row[key]) if key in _PERCENT else number(row[key]) for key, name in columns.items()},
        "lost/won": "" if reference or not row["pairs"] else f"{row['only_baseline']}/{row['only_method']}",
        "p": "" if reference or not row["pairs"] else _p(row["mcnemar_p"]),
    }


def motion_frame(table: pd.DataFrame, averaging: str = MICRO) -> pd.DataFrame | None:
    """The measures of `motion` as text, each with its ratio to the baseline's; None where no row has them."""
    rows = rows_of(table, averaging)
    if not any(is_number(row[key]) for row in rows for key in _MOTION):
        return None
    frame = []
    for row in rows:
        cells = {"setting": str(row["label"])}
        for key, name in _MOTION.items():
            cells[name] = number(row[key])
            cells[f"{name}: ratio"] = "" if row["label"] == row["baseline"] else _interval(row, f"{key}_ratio", 1.0, 2)
        frame.append(cells)
    return pd.DataFrame(frame)


def _one(row: Mapping[str, Any]) -> str:
    """The speedup of the baseline, where it has a time at all."""
    return "1" if is_number(row["time_per_step_ms"]) else "–"


def _apart(row: Mapping[str, Any]) -> str:
    """The mark of a speedup of some of the pairs."""
    return APART if is_number(row["speedup"]) and row["same_block"] < 1 and not row["same_run"] else ""


def not_in_turn(table: pd.DataFrame) -> list[str]:
    """Labels with times whose ratio to the baseline's does not exist: none of the pairs was measured in turn."""
    timed = table["time_per_step_ms"].notna() & (table["forwards_per_step"] + table["skip_rate"] > 0)
    rows = table[timed & (table["label"] != table["baseline"]) & (table["pairs"] > 0) & table["speedup"].isna()]
    of_baseline = table.loc[table["label"] == table["baseline"], "time_per_step_ms"].notna().all()
    return [str(label) for label in dict.fromkeys(rows["label"])] if of_baseline else []


def _p(value: float) -> str:
    return "<0.001" if value < 0.001 else f"{value:.2g}"


def _interval(row: Mapping[str, Any], name: str, scale: float, digits: int) -> str:
    if not is_number(row[name]):
        return "–"
    value = row[name] * scale
    # 99.5 % of success must not read as 100 %
    text = f"{value:.1f}".removesuffix(".0") if name == "success" else f"{value:.{digits}f}"
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    return f"{text} ({low * scale:.{digits}f}–{high * scale:.{digits}f})" if is_number(low) else text


def number(value: float) -> str:
    """Three significant digits without an exponent; `–` for a missing value."""
    if not is_number(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:#.3g}"


def _percent(value: float) -> str:
    return f"{100 * value:.0f} %" if is_number(value) else "–"


def _title(table: pd.DataFrame, averaging: str) -> str:
    rows = table[table["averaging"] == averaging]
    first = rows.iloc[0]
    counts = f"{rows['tasks'].max()} tasks, {rows['episodes'].max()} episodes each"
    return f"{first['study']}: {counts}, {averaging}, {first['device_name']}, {first['dtype']}"
