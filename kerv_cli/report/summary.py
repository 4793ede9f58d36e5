"""Turn a study's rows into tables that people read, in the terminal and on the page, and explain the columns."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import markupsafe
from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from kerv_cli.base.durations import count
from kerv_cli.engine.record import PHASES
from kerv_cli.episodes.identity import stress_text
from kerv_cli.lab.plan import seeds_text
from kerv_cli.report.measures import Result, is_number
from kerv_cli.report.profiles import ENCODERS
from kerv_cli.report.reprice import Priced
from kerv_cli.report.statistics import Estimate
from kerv_cli.report.tables import StudyData

MISSING = "–"
APART = "*"
PER_EPISODE, PER_STEP = "speed, per episode", "speed, per step"
DIFFERENCE = "change in success"
LATENCY = "slowest 5 % of decodes, ms"
# One row of a printed table: heading to text. All rows of a table have the same headings.
Cells = dict[str, str]
# Columns that are always shown. `--all`, and "more columns" on the page, show the others.
MAIN = 5
_TASK_COLUMNS = (
    "task", "success", "steps per episode", "forwards per step", "tokens per verification", "drafts accepted",
    "time per step, ms",
)  # fmt: skip
# Width at which a heading is wrapped, in characters
_HEADING = 12
# Width at which a label is wrapped, in characters
_LABEL = 16
ANSWER, OF_SERVER = "an answer takes, ms", "of it the server's, ms"
# Heading -> what the column means. `{0}` is the baseline.
MEANINGS = {
    "success": "share of episodes that solved their task",
    DIFFERENCE: "points more or less than {0}, over pairs: episodes of both from the same initial state",
    PER_EPISODE: "inference time of {0} until success or the horizon, divided by the setting's, over pairs on the same "
    "device",
    PER_STEP: "the same for the time of a control step. * means: some pairs were not measured in turn; the "
    "speed is of the others",
    LATENCY: "95 % of the decodes take less time than this",
    ANSWER: "mean time from an observation to the server's actions, as the client sees it",
    OF_SERVER: "mean of the time that the server itself measures for an answer",
    "tokens unverified": "executed tokens that the policy neither wrote nor accepted",
    "tokens per verification": "how many tokens one verification yields on average (acceptance length)",
    "pairs lost / won": "initial states that only {0}, and only the setting, solved",
}
ASSUMES = (
    "Speed against the baseline by the cost model: the recorded decodes at a profile's costs, as if the other machine "
    "and target decoded the same tokens in the same control steps; success is the recorded policy's"
)


def number(value: float) -> str:
    if not is_number(value):
        return MISSING
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:#.3g}"


def share(value: float) -> str:
    return f"{100 * value:.0f} %" if is_number(value) else MISSING


def interval(estimate: Estimate, form: str = ".2f", unit: str = "", scale: float = 1.0, between: str = "–") -> str:
    """Return an estimate as text, with its interval in brackets. `–` if it is missing.

    Args:
        form: Python format of the numbers. With `.0f`, the value still gets one decimal, unless that is 0, so 99.5 %
            success does not become 100 %. With `.2f`, an estimate of 10 or more gets only one.
        scale: Factor for value and interval, such as 100 for per cent.
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
    measures = row.measures
    if row.is_baseline:
        return "1×"
    apart = is_number(measures.speedup.value) and measures.same_block < 1 and not measures.same_run
    return interval(speed, unit="×") + (APART if apart else "")


def cells_of(row: Result) -> Cells:
    """Return a row of a study's table as text, by heading. The first `MAIN` columns are always shown."""
    of = row.measures
    return {
        "setting": row.label,
        "success": interval(of.success, ".0f", " %", 100.0),
        PER_EPISODE: _speed(row, of.episode_speedup),
        DIFFERENCE: "" if row.is_baseline else interval(of.difference, "+.0f", "", 100.0, " to "),
        "tokens unverified": share(of.unverified_share),
        LATENCY: number(of.latency_p95_ms),
        PER_STEP: _speed(row, of.speedup),
        "a decode takes, ms": number(of.felt_latency_ms),
        ANSWER: number(of.answer_ms) if is_number(of.server_ms) else MISSING,
        OF_SERVER: number(of.server_ms),
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
        "pairs lost / won": f"{of.counts.only_baseline} / {of.counts.only_method}" if row.is_compared else "",
    }


def summary(results: Sequence[Result]) -> list[Cells]:
    """Return a study's table as text: the main columns, and all others with a value that is not 0 or empty."""
    rows = list(map(cells_of, results))
    names = list(rows[0])
    used = [name for name in names if name in names[:MAIN] or {row[name] for row in rows} - {MISSING, "0 %", ""}]
    return [{name: row[name] for name in used} for row in rows]


def columns_shown(rows: Sequence[Cells]) -> set[str]:
    return {name for name in rows[0] if {row[name] for row in rows} - {MISSING, ""}}


def about(results: Sequence[Result]) -> str:
    first = results[0]
    targets = list(dict.fromkeys(str(row.settings["policy.target"]) for row in results))
    names = ", ".join(targets) if len(targets) <= 2 else f"{len(targets)} policies"
    tasks, episodes = (max(map(attrgetter(name), results)) for name in ("tasks", "episodes"))
    counts = f"{count(len(results), 'setting')} on {count(tasks, 'task')}, {count(episodes, 'episode')} each"
    return f"{names} · {counts} · {first.provenance['device_name']}, {first.settings['runtime.dtype']}"


@dataclass(frozen=True)
class SummaryTable:
    """A study's table as `rich` prints it."""

    results: Sequence[Result]
    all: bool = False  # print every column. If they do not fit side by side, they are printed in several parts.
    how: str = ""  # what to type to see every column. If empty, the table does not mention hidden columns.

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        results = self.results
        first = results[0]
        yield Text(f"{first.study}: {about(results)}", "bold", overflow="fold")
        rows = summary(results)
        own = [name for name in rows[0] if name.replace(" ", "_") in first.measures.added]  # of plugins
        names = list(rows[0]) if self.all else list(dict.fromkeys([*list(rows[0])[:MAIN], *own]))
        for part in _parts(rows, names, options.max_width):
            yield _printed(rows, part)
        if self.how and len(names) < len(rows[0]):
            yield Text(f"{len(names)} of {len(rows[0])} columns; {self.how} shows all")
        several = ", under the same stress and clock" if len({row.baseline for row in results}) > 1 else ""
        yield Text(f"{note_of(results, names)}Baseline: {first.baseline}{several}.")
        if any(row[PER_EPISODE].endswith(APART) for row in rows):
            yield Text(f"{APART} only from pairs that were measured in turn")


def note_of(results: Sequence[Result], names: Sequence[str] = ()) -> str:
    """Return the note below a table. It explains the columns in `names`, or, if empty, all columns with values."""
    shown = columns_shown(summary(results)) & set(names or cells_of(results[0]))
    notes = ["In brackets: 95 % intervals."]
    if any(row.is_compared for row in results):
        notes += ["Change in success: points against the baseline, from the same initial states."]
    if any(is_number(row.speed) and not row.is_baseline for row in results):
        runs = min(map(attrgetter("runs"), results))
        of_runs = f"{runs} runs" if runs > 2 else "this run alone"
        notes += [f"Speed: times as fast as the baseline. Intervals of speed: of {of_runs}."]
    if LATENCY in shown:
        notes += ["Slowest 5 % of decodes: they take at least this many ms."]
    return " ".join([*notes, ""])


def _printed(rows: Sequence[Cells], names: Sequence[str]) -> Table:
    printed = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for name in names:
        is_label = name == "setting"  # labels wrap, measures do not
        printed.add_column(
            _heading(name), justify="left" if is_label else "right", overflow="fold", no_wrap=not is_label
        )
    for row in rows:
        printed.add_row(*(escape(row[name]) for name in names))
    return printed


def _heading(name: str) -> str:
    return textwrap.fill(name, _HEADING, break_long_words=False)


def _parts(rows: Sequence[Cells], names: Sequence[str], width: int) -> Iterator[list[str]]:
    """Split a table into several of at most `width` characters, each with some columns. The first has the success."""
    widths = {name: 2 + max(map(len, [*_heading(name).split("\n"), *(row[name] for row in rows)])) for name in names}
    labels = " ".join(row["setting"] for row in rows)
    label = min(widths["setting"], 2 + max(_LABEL, *map(len, labels.split())))
    part = list(names[:3])
    for name in names[3:]:
        if label + sum(map(widths.__getitem__, (*part[1:], name))) > width:
            yield part
            part = ["setting"]
        part.append(name)
    yield part


def not_in_turn(results: Sequence[Result]) -> list[str]:
    """Return the labels of settings that share no block with the baseline, so that no speedup is known."""
    apart: dict[str, None] = {}
    for row in results:
        of = row.measures
        decodes = of.forwards_per_step + of.skip_rate > 0 or is_number(of.server_ms)
        if row.is_compared and decodes and not is_number(of.speedup.value):
            apart[row.label] = None
    return list(apart)


def setting_tables(data: StudyData) -> Iterator[tuple[Any, Any, str]]:
    """Yield columns, rows and title of each table of a study with one setting: per task, and per phase of a decode."""
    episodes, setting = data.episodes, data.study.settings[0]
    rows = []
    for row in [*data.task_results, *data.results]:
        task = row.where or "all"
        success, accepted = f"{row.measures.successes}/{row.episodes}", number(row.measures.accepted_per_round)
        cells = cells_of(row) | {"task": task, "success": success, "drafts accepted": accepted}
        if task != "all" or row.tasks > 1:
            rows.append(list(map(cells.__getitem__, _TASK_COLUMNS)))
    seeds = seeds_text(episodes["seed"])
    seeds = f"seeds {seeds}" if episodes["seed"].nunique() > 1 else f"seed {seeds}"
    observation = setting.identity.get("observation", "")
    title = f"{setting.label}, observation {observation}{stress_text(setting.settings)}, {seeds}"
    yield _TASK_COLUMNS, rows, title
    decodes, total = episodes["decodes"].sum(), episodes["seconds"].sum()
    shares = []
    times = {phase: episodes[f"seconds.{phase}"].sum() for phase in PHASES}
    if of_server := episodes["server_seconds"].sum():
        times = {"server": of_server, "network and client": total - of_server}
    for phase, seconds in times.items():
        if seconds:
            shares.append((phase, f"{1000 * seconds / decodes:.2f}", f"{seconds / total:.0%}"))
    yield ("phase", "ms per decode", "share"), shares, "time by phase"


def task_table(results: Sequence[Result]) -> list[Cells]:
    """Return the page's table of successes and speeds. Rows are tasks, or settings if there are more settings."""
    cells: dict[tuple[str, str], str] = {}
    for row in results:
        speed = row.measures.episode_speedup.value
        timed = f" · {speed:.2f}×" if not row.is_baseline and is_number(speed) else ""
        cells[row.task, row.label] = f"{row.measures.successes}/{row.episodes}{timed}"
    tasks, labels = sorted({row.task for row in results}), list(dict.fromkeys(row.label for row in results))
    if len(labels) > len(tasks):
        return [{"setting": label} | {task: cells.get((task, label), MISSING) for task in tasks} for label in labels]
    return [{"task": task} | {label: cells.get((task, label), MISSING) for label in labels} for task in tasks]


def repriced_summary(priced: Sequence[Priced]) -> list[Cells]:
    rows: dict[str, Cells] = {}
    for row in priced:
        machine, is_baseline = row.machine.title, row.result.is_baseline
        cells = rows.setdefault(row.result.label, {"setting": row.result.label})
        measured = f"measured, {row.result.provenance['device_name']}"
        for source, of in ((measured, row.result.measures), (machine, row.measures)):
            cells[f"{source}: per episode"] = "1×" if is_baseline else interval(of.episode_speedup, unit="×")
            cells[f"{source}: per step"] = "1×" if is_baseline else interval(of.speedup, unit="×")
        if row.encoders:
            heading = f"{machine}: per episode, if the encoder takes {', '.join(ENCODERS.values())}"
            texts = ["1"] * len(ENCODERS) if is_baseline else map("{:.2f}".format, row.encoders.values())
            cells[heading] = f"{' / '.join(texts)}×"
    return list(rows.values())


def with_code(text: str) -> markupsafe.Markup:
    return markupsafe.Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(markupsafe.escape(text))))
