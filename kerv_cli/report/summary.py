"""Turn a study's table into tables that people read, in the terminal and on the page."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import pandas as pd
from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from kerv_cli.base.durations import count
from kerv_cli.engine.record import PHASES
from kerv_cli.episodes.identity import stress_text
from kerv_cli.report.results import MICRO, Result, averaged, is_number
from kerv_cli.report.statistics import Estimate
from kerv_cli.report.tables import StudyData

MISSING = "–"
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


def number(value: float) -> str:
    """Return a value with three significant digits and no exponent. `–` if it is missing."""
    if not is_number(value):
        return MISSING
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:#.3g}"


def share(value: float) -> str:
    """Return a value from 0 to 1 in per cent. `–` if it is missing."""
    return f"{100 * value:.0f} %" if is_number(value) else MISSING


def interval(estimate: Estimate, form: str = ".2f", unit: str = "", scale: float = 1.0, between: str = "–") -> str:
    """Return an estimate with its interval in brackets. `–` if it is missing.

    Args:
        estimate: The estimate.
        form: Format of the numbers. With `.0f` the value still gets one decimal, unless that decimal is 0. So a success
            of 99.5 % does not read as 100 %.
        unit: Text after the value.
        scale: Factor for value and interval; 100 for per cent.
        between: Text between the two ends of the interval.
    """
    if not is_number(estimate.value):
        return MISSING
    value, low, high = estimate.value * scale, estimate.low * scale, estimate.high * scale
    ends = ".1f" if form == ".2f" and value >= 10 else form
    shown = f"{value:{ends.replace('.0f', '.1f')}}".removesuffix(".0") + unit
    text = f"{shown} ({low:{ends}}{between}{high:{ends}})" if is_number(low) else shown
    return text.replace("+0 ", "0 ").replace("-0 ", "0 ").replace("-", "−")  # no sign before zero


def _speed(row: Result, speed: Estimate) -> str:
    """Return a speed as text.

    The baseline's speed is 1, or `–` if it was not timed. An asterisk marks a speed for which some pairs were not
    measured side by side in one block; those pairs do not count.
    """
    measures = row.measures
    if row.is_baseline:
        return "1×" if measures.is_timed else MISSING
    apart = is_number(measures.speedup.value) and measures.same_block < 1 and not measures.same_run
    return interval(speed, unit="×") + (APART if apart else "")


def cells_of(row: Result) -> dict[str, str]:
    """Return a row of a study's table as text, by the column's heading. The first `MAIN` columns are always shown."""
    of = row.measures
    return {
        "setting": row.label,
        "success": interval(of.success, ".0f", " %", 100.0),
        SPEEDS["episode_speedup"]: _speed(row, of.episode_speedup),
        DIFFERENCE: "" if row.is_baseline else interval(of.difference, "+.0f", "", 100.0, " to "),
        "tokens unverified": share(of.unverified_share),
        "slowest 5 % of decodes, ms": number(of.latency_p95_ms),
        SPEEDS["speedup"]: _speed(row, of.speedup),
        "a decode takes, ms": number(of.felt_latency_ms),
        "steps on a held action": share(of.held_share),
        "tokens per verification": number(of.AL),
        "forwards per step": number(of.forwards_per_step),
        "time per step, ms": number(of.time_per_step_ms),
        "steps per episode": f"{of.steps / row.episodes:.0f}",
        "decodes skipped": share(of.skip_rate),
        "decodes compensated": share(of.compensation_rate),
        "decodes retrieved": share(of.retrieval_share),
        "deviation from AR": number(of.deviation),
        "failures near the object": share(of.near_contact_failure),
        **{name.replace("_", " "): number(value) for name, value in of.added.items()},
        "speed at matched success": number(row.matched_success_speed),
        "pairs lost / won": f"{of.counts.only_baseline} / {of.counts.only_method}" if row.is_compared else "",
    }


def summary_frame(results: Sequence[Result], averaging: str = MICRO) -> pd.DataFrame:
    """Return a study's table as text: the main columns, and every other column with a value that is not 0 or empty.

    Args:
        results: The study's rows over all tasks.
        averaging: MICRO takes the rows that pool all tasks. MACRO takes the rows that average over difficulty groups.
    """
    frame = pd.DataFrame(map(cells_of, averaged(results, averaging)))
    is_used = ~frame.isin([MISSING, "0 %", ""]).all() | frame.columns.isin(frame.columns[:MAIN])
    return frame.loc[:, is_used]


@dataclass(frozen=True)
class SummaryTable:
    """A study's table as `rich` prints it, pooled over tasks.

    Attributes:
        results: The study's rows over all tasks.
        all: Print every column. If they do not fit side by side, they are printed in several parts.
        how: What to type to see every column. Empty: the table does not mention hidden columns.
    """

    results: Sequence[Result]
    all: bool = False
    how: str = ""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        """Yield the title, the table and the notes below it."""
        rows = averaged(self.results)
        first = rows[0]
        tasks, episodes = max(one.tasks for one in rows), max(one.episodes for one in rows)
        counts = f"{count(tasks, 'task')}, {count(episodes, 'episode')} per setting"
        device = f"{first.provenance['device_name']}, {first.settings['runtime.dtype']}"
        yield Text(f"{first.study}: {counts}, {device}", "bold", overflow="fold")
        frame = summary_frame(rows)
        own = [name for name in frame.columns if name.replace(" ", "_") in first.measures.added]  # of plugins
        shown = frame if self.all else frame[[*frame.columns[:MAIN], *own]]
        for part in _parts(shown, options.max_width):
            yield _printed(part)
        if self.how and len(shown.columns) < len(frame.columns):
            yield Text(f"{len(shown.columns)} of {len(frame.columns)} columns; {self.how} shows all")
        several = ", under the same stress and clock" if len({one.baseline for one in rows}) > 1 else ""
        yield Text(f"{NOTE} {of_runs(rows)} Baseline: {first.baseline}{several}.")
        if frame[SPEEDS["episode_speedup"]].str.endswith(APART).any():
            yield Text(f"{APART} only from pairs that were measured in turn")
        if untimed := [row.label for row in rows if not row.measures.is_timed]:
            yield Text(f"not timed, for success alone: {', '.join(untimed)}")


def of_runs(results: Sequence[Result]) -> str:
    """Return one sentence that says from how many runs the intervals of speed were computed."""
    runs = min(one.runs for one in results)
    return f"Intervals of speed: of {runs} runs." if runs > 2 else "Intervals of speed: of this run alone."


def _printed(frame: pd.DataFrame) -> Table:
    printed = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for name in frame.columns:
        is_label = name == "setting"  # labels wrap, measures do not
        printed.add_column(
            _heading(name), justify="left" if is_label else "right", overflow="fold", no_wrap=not is_label
        )
    for row in frame.itertuples(index=False):
        printed.add_row(*map(escape, map(str, row)))
    return printed


def _heading(name: str) -> str:
    """Return a heading wrapped into lines."""
    return textwrap.fill(name, _HEADING, break_long_words=False)


def _parts(frame: pd.DataFrame, width: int) -> Iterator[pd.DataFrame]:
    """Cut a table into parts that fit into `width` characters. The first part has at least name, success and speed."""
    widths = {name: 2 + max(map(len, [*_heading(name).split("\n"), *frame[name]])) for name in frame.columns}
    label = min(widths["setting"], 2 + max(_LABEL, *map(len, " ".join(frame["setting"]).split())))
    part = list(frame.columns[:3])
    for name in frame.columns[3:]:
        if label + sum(map(widths.__getitem__, (*part[1:], name))) > width:
            yield frame[part]
            part = ["setting"]
        part.append(name)
    yield frame[part]


def not_in_turn(results: Sequence[Result]) -> list[str]:
    """Return labels of settings that were timed but have no speedup.

    They have none because no pair was measured in the same block as its baseline.
    """
    apart: dict[str, None] = {}
    for row in results:
        of = row.measures
        if row.is_baseline and not of.is_timed:
            return []
        decodes = of.forwards_per_step + of.skip_rate > 0
        if row.is_compared and decodes and of.is_timed and not is_number(of.speedup.value):
            apart[row.label] = None
    return list(apart)


def setting_tables(data: StudyData) -> Iterator[tuple[Any, Any, str]]:
    """Yield the tables of a study with one setting: results per task, and time per phase of a decode.

    Yields:
        Column names, rows and title of each table.
    """
    episodes, setting = data.episodes, data.study.settings[0]
    over_all = [replace(row, task="all") for row in averaged(data.results) if row.tasks > 1]
    rows = list(map(_task_cells, [*data.task_results, *over_all]))
    seeds = f"{episodes['seed'].min()}…{episodes['seed'].max()}"
    observation = setting.identity.get("observation", "")
    title = f"{setting.label}, observation {observation}{stress_text(setting.settings)}, seeds {seeds}"
    timed = episodes["seconds"].notna().all()
    if not timed:
        title += f"; not timed: {setting.batch} episodes at a time"
    yield rows[0].keys(), list(map(dict.values, rows)), title
    if timed:
        decodes, total = episodes["decodes"].sum(), episodes["seconds"].sum()
        cells = []
        for phase in PHASES:
            seconds = episodes[f"seconds.{phase}"].sum()
            if seconds:
                cells.append((phase, f"{1000 * seconds / decodes:.2f}", f"{seconds / total:.0%}"))
        yield ("phase", "ms per decode", "share"), cells, "time by phase"


def _task_cells(row: Result) -> dict[str, str]:
    """Return a row of the table of a single setting as text, by the column's heading."""
    cells = cells_of(row)
    return {
        "task": row.task,
        "success": f"{row.measures.successes}/{row.episodes}",
        "steps per episode": cells["steps per episode"],
        "forwards per step": cells["forwards per step"],
        "tokens per verification": cells["tokens per verification"],
        "drafts accepted": number(row.measures.accepted_per_round),
        "time per step, ms": cells["time per step, ms"],
    }
