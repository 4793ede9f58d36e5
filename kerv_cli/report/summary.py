"""Turn a study's table into tables that people read, in the terminal and on the page."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pandas as pd
from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from kerv_cli.base.durations import count
from kerv_cli.engine.record import PHASES
from kerv_cli.episodes.identity import batch_of, stress_text
from kerv_cli.report.measures import MICRO, Row, registered_columns
from kerv_cli.report.tables import StudyData, is_baseline, is_number, rows_of

TextOf = Callable[[Row], str]

APART = "*"
SPEEDS = {"episode_speedup": "speed, per episode", "speedup": "speed, per step"}
"""Table column of each kind of speed -> its heading."""
DIFFERENCE = "change in success"
MAIN = 5
"""Number of columns that are always shown. `--all`, and "more columns" on the page, show the others."""
NOTE = (
    "In brackets: 95 % intervals. Change in success: points against the baseline, from the same initial states. Speed: "
    "times as fast as the baseline. Slowest 5 % of decodes: they take at least this many ms."
)
_HEADING = 12
"""Width at which a heading is wrapped, in characters."""
_LABEL = 16
"""Width at which a label is wrapped, in characters."""


def numbers(name: str) -> TextOf:
    """Return a function that formats a column's value.

    The text has three significant digits and no exponent. It is `–` if the value is missing.
    """

    def text(row: Row) -> str:
        value = row[name]
        if not is_number(value):
            return "–"
        return f"{value:.0f}" if abs(value) >= 100 else f"{value:#.3g}"

    return text


def shares(name: str) -> TextOf:
    """Return a function that formats a column's value (a share from 0 to 1) in per cent."""
    return lambda row: f"{100 * row[name]:.0f} %" if is_number(row[name]) else "–"


def intervals(name: str, form: str = ".2f", unit: str = "", scale: float = 1.0, between: str = "–") -> TextOf:
    """Return a function that formats a column's value with its interval in brackets. The text is `–` if it is missing.

    Args:
        name: The column.
        form: Format of the numbers. Even with `.0f` the value gets one decimal unless that is 0, because a success of
            99.5 % must not read as 100 %.
        unit: Text after the value.
        scale: Factor for value and interval; 100 for per cent.
        between: Text between the two ends of the interval.
    """

    def text(row: Row) -> str:
        if not is_number(row[name]):
            return "–"
        value, low, high = (row[f"{name}{end}"] * scale for end in ("", "_low", "_high"))
        ends = ".1f" if form == ".2f" and value >= 10 else form
        shown = f"{value:{ends.replace('.0f', '.1f')}}".removesuffix(".0") + unit
        return _minus(f"{shown} ({low:{ends}}{between}{high:{ends}})" if is_number(low) else shown)

    return text


def _minus(text: str) -> str:
    """Return the text with proper minus signs and without a sign before zero."""
    return text.replace("+0 ", "0 ").replace("-0 ", "0 ").replace("-", "−")


def _difference(row: Row) -> str:
    """Return the change in success, in points with its interval, as text. Empty for the baseline."""
    return "" if is_baseline(row) else intervals("difference", "+.0f", "", 100.0, " to ")(row)


def _speed(name: str) -> TextOf:
    """Return a function that formats a speed.

    The baseline's speed is 1, or `–` if it was not timed. An asterisk marks a speed for which some pairs were not
    measured side by side in one block; those pairs do not count.
    """

    def text(row: Row) -> str:
        if is_baseline(row):
            return "1×" if is_number(row["time_per_step_ms"]) else "–"
        apart = is_number(row["speedup"]) and row["same_block"] < 1 and not row["same_run"]
        return intervals(name, unit="×")(row) + (APART if apart else "")

    return text


def _columns() -> dict[str, TextOf]:
    """Return the functions that format a cell, by the column's heading. The first `MAIN` columns are always shown."""
    return {
        "setting": lambda row: str(row["label"]),
        "success": intervals("success", ".0f", " %", 100.0),
        DIFFERENCE: _difference,
        SPEEDS["episode_speedup"]: _speed("episode_speedup"),
        "slowest 5 % of decodes, ms": numbers("latency_p95_ms"),
        "tokens unverified": shares("unverified_share"),
        SPEEDS["speedup"]: _speed("speedup"),
        "a decode takes, ms": numbers("felt_latency_ms"),
        "steps on a held action": shares("held_share"),
        "tokens per verification": numbers("AL"),
        "forwards per step": numbers("forwards_per_step"),
        "time per step, ms": numbers("time_per_step_ms"),
        "steps per episode": lambda row: f"{row['steps'] / row['episodes']:.0f}",
        "decodes skipped": shares("skip_rate"),
        "decodes compensated": shares("compensation_rate"),
        "decodes retrieved": shares("retrieval_share"),
        "deviation from AR": numbers("deviation"),
        "failures near the object": shares("near_contact_failure"),
        **{name.replace("_", " "): numbers(name) for name in registered_columns()},
        "speed at matched success": numbers("matched_success_speed"),
        "pairs lost / won": lost_won,
    }


def lost_won(row: Row) -> str:
    """Return in how many pairs only the baseline succeeded (lost), and in how many only the setting (won), as text."""
    return "" if is_baseline(row) or not row["pairs"] else f"{row['only_baseline']} / {row['only_method']}"


def summary_frame(table: pd.DataFrame, averaging: str = MICRO) -> pd.DataFrame:
    """Return the rows of a study's table as text, with the main columns and those that are not all empty or zero.

    Args:
        table: The study's table.
        averaging: Take the rows that pool all tasks (MICRO) or that average over difficulty groups (MACRO).
    """
    rows, columns = rows_of(table, averaging), _columns()
    frame = pd.DataFrame([{title: text(row) for title, text in columns.items()} for row in rows])
    is_used = ~frame.isin(["–", "0 %", ""]).all() | frame.columns.isin(frame.columns[:MAIN])
    return frame.loc[:, is_used]


@dataclass(frozen=True)
class SummaryTable:
    """A study's table as `rich` prints it, pooled over tasks.

    Attributes:
        table: The study's table.
        all: Print every column. If they do not fit side by side, they are printed in several parts.
        how: What to type to see every column. Empty: do not say it.
    """

    table: pd.DataFrame
    all: bool = False
    how: str = ""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        """Yield the title, the table and the notes below it."""
        rows = self.table[self.table["averaging"] == MICRO]
        first, tasks = rows.iloc[0], int(rows["tasks"].max())
        counts = f"{count(tasks, 'task')}, {count(rows['episodes'].max(), 'episode')} per setting"
        yield Text(
            f"{first['study']}: {counts}, {first['device_name']}, {first['runtime.dtype']}", "bold", overflow="fold"
        )
        frame = summary_frame(self.table)
        own = [name for name in frame.columns if name.replace(" ", "_") in registered_columns()]  # of plugins
        shown = frame if self.all else frame[[*frame.columns[:MAIN], *own]]
        for part in _parts(shown, options.max_width):
            yield _printed(part)
        if self.how and len(shown.columns) < len(frame.columns):
            yield Text(f"{len(shown.columns)} of {len(frame.columns)} columns; {self.how} shows all")
        several = ", under the same stress and clock" if rows["baseline"].nunique() > 1 else ""
        yield Text(f"{NOTE} {of_runs(self.table)} Baseline: {first['baseline']}{several}.")
        if frame[SPEEDS["episode_speedup"]].str.endswith(APART).any():
            yield Text(f"{APART} only from pairs that were measured in turn")
        if untimed := list(rows.loc[rows["time_per_step_ms"].isna(), "label"]):
            yield Text(f"not timed, for success alone: {', '.join(untimed)}")


def of_runs(table: pd.DataFrame) -> str:
    """Return one sentence that says how many runs the intervals of speed cover."""
    runs = int(table["runs"].min()) if "runs" in table else 1
    return f"Intervals of speed: of {runs} runs." if runs > 2 else "Intervals of speed: of this run alone."


def _printed(frame: pd.DataFrame) -> Table:
    printed = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for name in frame.columns:
        is_label = name == "setting"  # labels wrap, measures do not
        printed.add_column(
            _heading(name), justify="left" if is_label else "right", overflow="fold", no_wrap=not is_label
        )
    for row in frame.itertuples(index=False):
        printed.add_row(*(escape(str(value)) for value in row))
    return printed


def _heading(name: str) -> str:
    """Return a heading wrapped into lines."""
    return textwrap.fill(name, _HEADING, break_long_words=False)


def _parts(frame: pd.DataFrame, width: int) -> Iterator[pd.DataFrame]:
    """Cut a table into parts that fit into `width` characters. The first part has at least the main columns."""
    widths = {name: 2 + max(map(len, [*_heading(name).split("\n"), *frame[name]])) for name in frame.columns}
    label = min(widths["setting"], 2 + max(_LABEL, *map(len, " ".join(frame["setting"]).split())))
    part = list(frame.columns[:MAIN])
    for name in frame.columns[MAIN:]:
        if label + sum(widths[one] for one in part[1:]) + widths[name] > width:
            yield frame[part]
            part = ["setting"]
        part.append(name)
    yield frame[part]


def not_in_turn(table: pd.DataFrame) -> list[str]:
    """Return labels of settings that were timed but have no speedup.

    They have none because no pair was measured in the same block as its baseline.
    """
    timed = table["time_per_step_ms"].notna() & (table["forwards_per_step"] + table["skip_rate"] > 0)
    rows = table[timed & (table["label"] != table["baseline"]) & (table["pairs"] > 0) & table["speedup"].isna()]
    of_baseline = table.loc[table["label"] == table["baseline"], "time_per_step_ms"].notna().all()
    return [str(label) for label in dict.fromkeys(rows["label"])] if of_baseline else []


def setting_tables(data: StudyData) -> Iterator[tuple[Any, Any, str]]:
    """Yield the tables of a study with one setting: results per task, and time per phase of a decode.

    Yields:
        Column names, rows and title of each table.
    """
    episodes, setting, every = data.episodes, data.study.settings[0], _columns()
    columns: dict[str, TextOf] = {
        "task": lambda row: str(row["task"]),
        "success": lambda row: f"{row['successes']}/{row['episodes']}",
        **{name: every[name] for name in ("steps per episode", "forwards per step", "tokens per verification")},
        "drafts accepted": numbers("accepted_per_round"),
        "time per step, ms": every["time per step, ms"],
    }
    rows = rows_of(data.per_task) + [row | {"task": "all"} for row in rows_of(data.table, MICRO) if row["tasks"] > 1]
    seeds = f"{episodes['seed'].min()}…{episodes['seed'].max()}"
    observation = setting.identity.get("observation", "")
    title = f"{setting.label}, observation {observation}{stress_text(setting.settings)}, seeds {seeds}"
    timed = episodes["seconds"].notna().all()
    if not timed:
        title += f"; not timed: {batch_of(setting.settings)} episodes at a time"
    yield columns, ([text(row) for text in columns.values()] for row in rows), title
    if timed:
        sums = episodes[[f"seconds.{phase}" for phase in PHASES]].sum()
        decodes, total = episodes["decodes"].sum(), episodes["seconds"].sum()
        phases = {str(name).removeprefix("seconds."): float(s) for name, s in sums.items() if s}
        cells = [(name, f"{1000 * s / decodes:.2f}", f"{s / total:.0%}") for name, s in phases.items()]
        yield ("phase", "ms per decode", "share"), cells, "time by phase"
