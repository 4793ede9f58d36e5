"""Turn a study's table into tables that people read, in the terminal and on the page, and explain their names."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import markupsafe
import pandas as pd
from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from kerv_cli.base.durations import count
from kerv_cli.engine.record import PHASES
from kerv_cli.episodes.identity import Setting, stress_text
from kerv_cli.lab.plan import seeds_text
from kerv_cli.report.measures import MACRO, MICRO, Result, averaged, frame_of, is_number
from kerv_cli.report.profiles import ENCODERS
from kerv_cli.report.reprice import Priced
from kerv_cli.report.statistics import Estimate
from kerv_cli.report.tables import StudyData

MISSING = "–"
APART = "*"
SPEEDS = {"episode_speedup": "speed, per episode", "speedup": "speed, per step"}
"""Table column of each kind of speed -> its heading."""
DIFFERENCE = "change in success"
MAIN = 5
"""Number of columns that are always shown. `--all`, and "more columns" on the page, show all other columns."""
NOTE = (
    "In brackets: 95 % intervals. Change in success: points against the baseline, from the same initial states. Speed: "
    "times as fast as the baseline. Slowest 5 % of decodes: they take at least this many ms."
)
_TASK_COLUMNS = (
    "task", "success", "steps per episode", "forwards per step", "tokens per verification", "drafts accepted",
    "time per step, ms",
)  # fmt: skip
_HEADING = 12
"""Width at which a heading is wrapped, in characters."""
_LABEL = 16
"""Width at which a label is wrapped, in characters."""
METHODS = {
    "ar": "token by token: one run of the policy for each token",
    "early_unverified": "a small network writes every action, nobody verifies it",
    "expert": "Meta-World's scripted expert, which is no policy",
    "heisd": "similar demonstrations draft; very similar ones run unverified",
    "jacobi": "guesses all tokens and corrects them in parallel, without a drafter",
    "kerv": "Spec-VLA; after a rejection a Kalman filter predicts the rest",
    "last_action": "the last action drafts, only equal tokens are accepted, nothing is trained",
    "naive_sd": "a small network drafts, only equal tokens are accepted",
    "one_pass": "a network drafts the action; one run verifies prompt and draft",
    "parallel": "a policy that writes all tokens in one run",
    "retrieval_unverified": "the most similar demonstration runs, nobody verifies it",
    "spec_vla": "a small network drafts a tree of tokens, the policy verifies",
}
"""Family of methods -> what its methods do."""
WORDS = {
    "chain": "drafts one chain of tokens in place of a tree",
    "code": "as in the public code, where the paper says otherwise",
    "literal": "the paper's formula, word for word",
    "skip": "drafts that are similar enough run unverified",
    "streak": "after drafts that agree, more of them run unverified",
    "strict": "accepts only tokens that equal the policy's",
    "tree": "then a small network drafts a tree of tokens",
    "tuned": "changed by us, to suit these policies",
}
"""Word in the label of a setting -> what the word means."""
UNVERIFIED = "executed tokens that the policy neither wrote nor accepted"
ASSUMES = (
    "Speed against the baseline by the cost model: the recorded decodes at a profile's costs, as if the other machine "
    "and target decoded the same tokens in the same control steps; success is the recorded policy's"
)


def number(value: float) -> str:
    """Return a value as text with three significant digits and no exponent. The text is `–` if the value is missing."""
    if not is_number(value):
        return MISSING
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:#.3g}"


def share(value: float) -> str:
    """Return a value from 0 to 1 as text in per cent. The text is `–` if the value is missing."""
    return f"{100 * value:.0f} %" if is_number(value) else MISSING


def interval(estimate: Estimate, form: str = ".2f", unit: str = "", scale: float = 1.0, between: str = "–") -> str:
    """Return an estimate as text, with its interval in brackets. The text is `–` if the estimate is missing.

    Args:
        estimate: The estimate.
        form: Python format of the numbers. With `.0f`, the value still gets one decimal, unless that decimal is 0. So
            99.5 % success does not become 100 %. With `.2f`, an estimate of 10 or more gets only one decimal.
        unit: Text after the value.
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
    """Return a speed as text.

    The text for the baseline is `1×`, or `–` if the baseline was not timed. Pairs that were not measured side by side
    in one block do not count. An asterisk marks a speed with such pairs.
    """
    measures = row.measures
    if row.is_baseline:
        return "1×" if measures.is_timed else MISSING
    apart = is_number(measures.speedup.value) and measures.same_block < 1 and not measures.same_run
    return interval(speed, unit="×") + (APART if apart else "")


def cells_of(row: Result) -> dict[str, str]:
    """Return a row of a study's table as a dictionary from heading to text. The first `MAIN` are always shown."""
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
        how: What to type to see every column. If empty, the table does not mention hidden columns.
    """

    results: Sequence[Result]
    all: bool = False
    how: str = ""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        """Yield the title, the table and the notes below it."""
        rows = averaged(self.results)
        first = rows[0]
        table = frame_of(rows)
        counts = f"{count(table['tasks'].max(), 'task')}, {count(table['episodes'].max(), 'episode')} per setting"
        device = f"{first.provenance['device_name']}, {first.settings['runtime.dtype']}"
        yield Text(f"{first.study}: {counts}, {device}", "bold", overflow="fold")
        frame = summary_frame(rows)
        own = [name for name in frame.columns if name.replace(" ", "_") in first.measures.added]  # of plugins
        shown = frame if self.all else frame[[*frame.columns[:MAIN], *own]]
        for part in _parts(shown, options.max_width):
            yield _printed(part)
        if self.how and len(shown.columns) < len(frame.columns):
            yield Text(f"{len(shown.columns)} of {len(frame.columns)} columns; {self.how} shows all")
        several = ", under the same stress and clock" if table["baseline"].nunique() > 1 else ""
        yield Text(f"{note_of(rows)} Baseline: {first.baseline}{several}.")
        if frame[SPEEDS["episode_speedup"]].str.endswith(APART).any():
            yield Text(f"{APART} only from pairs that were measured in turn")
        untimed = table.loc[table["time_per_step_ms"].isna(), "label"]
        if len(untimed):
            yield Text(f"not timed, for success alone: {', '.join(untimed)}")


def note_of(results: Sequence[Result]) -> str:
    """Return the note below a table. Its last sentence says from how many runs the intervals of speed were computed."""
    runs = min(map(attrgetter("runs"), results))
    return f"{NOTE} Intervals of speed: of {f'{runs} runs' if runs > 2 else 'this run alone'}."


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
    """Cut a table into parts that fit into `width` characters. The first part always has label, success and speed."""
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
    """Return the labels of the settings that were timed but have no speedup.

    A setting has no speedup if the two episodes of each pair ran in different blocks. A block is episodes that ran side
    by side in one process.
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
    rows = []
    for row in [*data.task_results, *averaged(data.results)]:
        task = "all" if row.averaging == MICRO else row.task
        success, accepted = f"{row.measures.successes}/{row.episodes}", number(row.measures.accepted_per_round)
        cells = cells_of(row) | {"task": task, "success": success, "drafts accepted": accepted}
        if task != "all" or row.tasks > 1:
            rows.append(list(map(cells.__getitem__, _TASK_COLUMNS)))
    seeds = seeds_text(episodes["seed"])
    seeds = f"seeds {seeds}" if episodes["seed"].nunique() > 1 else f"seed {seeds}"
    observation = setting.identity.get("observation", "")
    title = f"{setting.label}, observation {observation}{stress_text(setting.settings)}, {seeds}"
    timed = episodes["seconds"].notna().all()
    if not timed:
        title += f"; not timed: {setting.batch} episodes at a time"
    yield _TASK_COLUMNS, rows, title
    if timed:
        decodes, total = episodes["decodes"].sum(), episodes["seconds"].sum()
        shares = []
        for phase in PHASES:
            seconds = episodes[f"seconds.{phase}"].sum()
            if seconds:
                shares.append((phase, f"{1000 * seconds / decodes:.2f}", f"{seconds / total:.0%}"))
        yield ("phase", "ms per decode", "share"), shares, "time by phase"


def suite_table(results: Sequence[Result]) -> pd.DataFrame:
    """Return the page's table of settings, pooled over tasks.

    If the tasks have several difficulty groups, further columns have the unweighted mean of the groups.
    """
    frame = summary_frame(results)
    if any(";" in row.difficulty for row in results):
        macro = summary_frame(results, MACRO)
        for name in ("success", *SPEEDS.values()):
            frame[f"{name}, by difficulty"] = macro.get(name, MISSING)
    return frame


def task_table(results: Sequence[Result]) -> pd.DataFrame:
    """Return the page's table of successes and speeds per episode, by task and setting.

    Tasks are rows and settings are columns, unless there are more settings than tasks.
    """
    cells: dict[str, dict[str, str]] = {}
    for row in results:
        cell, speed = f"{row.measures.successes}/{row.episodes}", row.measures.episode_speedup.value
        if not row.is_baseline and is_number(speed):
            cell += f" · {speed:.2f}×"
        cells.setdefault(row.label, {})[row.task] = cell
    table = pd.DataFrame(cells).sort_index().fillna(MISSING).rename_axis("task")
    return (table.T.rename_axis("setting") if len(table.columns) > len(table) else table).reset_index()


def repriced_summary(priced: Sequence[Priced]) -> pd.DataFrame:
    """Return a table of speeds to print: one row per setting.

    Two columns hold the measured speeds. Two more columns per machine hold the estimated speeds. If the machine's
    profile was computed instead of measured, a third column holds the speeds under further assumptions about the time
    of the vision encoder, see `ENCODERS`.
    """
    rows: dict[str, dict[str, str]] = {}
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
    return pd.DataFrame(rows.values())


def explained(label: str, method: str = "") -> str:
    """Explain the label of a setting, word by word. Empty if none of its words is in the glossary.

    Args:
        label: The setting's label, such as `spec_vla chain`.
        method: The setting's method, such as `spec_vla`. Empty: the label's first word.
    """
    method = method or re.split(r"[ ,]", label)[0]
    family = max((name for name in METHODS if method == name or method.startswith(f"{name}_")), key=len, default="")
    rest = f"{method.removeprefix(family)} {label.removeprefix(method)}" if family else f"{method} {label}"
    words = [text for word, text in WORDS.items() if word in re.split(r"[\W_]+", rest)]
    return "; ".join(filter(None, (METHODS.get(family, ""), *words)))


def explanations(settings: Iterable[Setting]) -> dict[str, str]:
    """Explain a table's settings, and the table's column *tokens unverified*.

    Returns:
        A dictionary from label or heading to explanation. Settings whose labels have no known word are left out.
    """
    found = {}
    for one in settings:
        if text := explained(one.label, one.settings["method"]):
            found[one.label] = text
    return found | {"tokens unverified": UNVERIFIED}


def with_code(text: str) -> markupsafe.Markup:
    """Return a text as HTML. Words in backticks become <code> elements. Templates use this function as a filter."""
    return markupsafe.Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(markupsafe.escape(text))))
