"""Write the sentences that say what a study shows. No other module of kerv writes such a sentence.

A sentence says *faster*, *slower* or *loses less than* only if a 95 % interval shows it. If the baseline succeeds in
less than the share `SOLVED` of its episodes, no setting is recommended.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import pandas as pd

from kerv_cli.base.durations import count
from kerv_cli.report.matched import SOLVED
from kerv_cli.report.measures import MICRO, Row
from kerv_cli.report.statistics import MOST_PAIRS
from kerv_cli.report.tables import is_baseline, is_number, rows_of


@dataclass(frozen=True)
class Choice:
    """Which setting to take, for one task or for all tasks together.

    Attributes:
        where: The task, or `all tasks`.
        pairs: Number of pairs of the setting with the most pairs.
        baseline_success: Success rate of the baseline.
        front: Settings that no other setting beats in both speed and success, the fastest first.
        chosen: Fastest setting that is shown to lose less success than the bound. Empty if there is none.
        loss_at_most: Upper bound on the chosen setting's loss of success, in points, at 95 % confidence. NaN if no
            setting is chosen.
        candidate: Fastest setting that more pairs would show to lose less than the bound, if the rates stay the same.
            Empty if there is none, or if a setting is chosen.
        candidate_pairs: About how many pairs in all the candidate needs. NaN without a candidate.
        tested: Number of settings that are tested for their loss of success: those that are faster than the baseline or
            were not timed.
        episode_speedup: Speed per episode of the chosen setting against the baseline. NaN if it was not timed.
        episode_speedup_low: Lower end of its 95 % interval.
        episode_speedup_high: Upper end of its 95 % interval.
        runs: Number of runs that this interval covers.
    """

    where: str
    pairs: int
    baseline_success: float
    front: tuple[str, ...]
    chosen: str
    loss_at_most: float
    candidate: str
    candidate_pairs: float
    tested: int
    episode_speedup: float
    episode_speedup_low: float
    episode_speedup_high: float
    runs: int

    @property
    def is_shown(self) -> bool:
        """Whether a setting is shown both to be faster and to lose less success than the bound."""
        return bool(self.chosen) and self.episode_speedup_low > 1

    @property
    def is_unsolved(self) -> bool:
        """Whether the baseline's success rate is too low for a recommendation."""
        return self.baseline_success < SOLVED

    def as_dict(self) -> Row:
        """Return all fields by name, as JSON values. `front` becomes one text, joined by semicolons."""
        return {**asdict(self), "front": ";".join(self.front)}


def question(table: pd.DataFrame, loss: float) -> str:
    """Return the question that the study's verdict answers. Empty if nothing is compared.

    Args:
        table: The study's table.
        loss: Largest acceptable loss of success, in points.
    """
    baselines = table.loc[table["pairs"] > 0, "baseline"].unique()
    if len(baselines) > 1:
        return "Which settings succeed less or more often than the baseline under the same stress and clock?"
    if not (table["label"] != table["baseline"]).any() or not len(baselines):
        return ""
    return f"Which setting is faster than the baseline {baselines[0]} and loses less than {loss:g} points of success?"


def sentence(choice: Choice, loss: float, baseline: str) -> str:
    """Return the choice for all tasks in one sentence.

    Args:
        choice: The choice.
        loss: Largest acceptable loss of success, in points.
        baseline: Label of the baseline.
    """
    if choice.is_unsolved:
        return unsolved(baseline, choice.baseline_success)
    bound = f"loses less than {loss:g} points of success against {baseline}"
    if choice.chosen:
        return f"{choice.chosen} {bound} (95 % confidence, {choice.pairs} pairs){_speed(choice)}"
    if not choice.tested:
        return f"no setting is shown to be faster per episode than {baseline} ({choice.pairs} pairs)"
    return f"{count(choice.pairs, 'pair')} cannot show a setting that is faster and {bound}; {_missing(choice)}"


def unsolved(baseline: str, success: float) -> str:
    """Return the sentence that a baseline succeeds too rarely, so that no setting is recommended.

    Args:
        baseline: Label of the baseline.
        success: Its success rate, from 0 to 1.
    """
    return (
        f"{baseline} does not solve these tasks ({100 * success:.0f} % of its episodes succeed), so no setting is "
        "recommended"
    )


def short_sentence(choice: Choice) -> str:
    """Return the choice for one task in a few words."""
    if choice.is_unsolved:
        return f"{choice.where}: the baseline does not solve it ({100 * choice.baseline_success:.0f} %)"
    if choice.chosen:
        return f"{choice.where}: {choice.chosen}" + ("" if choice.is_shown else ", not shown to be faster")
    if not choice.tested:
        return f"{choice.where}: no setting is shown to be faster ({choice.pairs} pairs)"
    return f"{choice.where}: open after {choice.pairs} pairs; {_missing(choice)}"


def _speed(choice: Choice) -> str:
    """Return the clause that says how fast the chosen setting is."""
    if not is_number(choice.episode_speedup):
        return "; its speed was not measured"
    shown = "and is faster" if choice.is_shown else "but is not shown to be faster"
    runs = f"of {choice.runs} runs" if choice.runs > 2 else "of this run"
    interval = f"({choice.episode_speedup_low:.2f}–{choice.episode_speedup_high:.2f} {runs})"
    return f" {shown}: {choice.episode_speedup:.2f} {interval} times as fast per episode on this machine"


def _missing(choice: Choice) -> str:
    """Return the clause that says about how many more pairs would show that a setting is good enough to be chosen.

    It names that setting. If more pairs would not help, it says so.
    """
    if not choice.candidate:
        return "at these rates, more pairs would not show one either"
    more = max(1, math.ceil(choice.candidate_pairs - choice.pairs))
    number = f"about {more}" if more <= MOST_PAIRS else f"more than {MOST_PAIRS:,}"
    return f"at these rates, {number} more pairs would show it for {choice.candidate}"


def under_conditions(rows: Sequence[Row], baseline: str) -> str:
    """Say which settings succeed less or more often than the baseline under the same stress and clock.

    Args:
        rows: The study's rows, pooled over tasks.
        baseline: Name of the baseline's method.
    """
    compared = [row for row in rows if row["pairs"] and not is_baseline(row)]
    solved = [row for row in compared if (row["both"] + row["only_baseline"]) / row["pairs"] >= SOLVED]
    less = [str(row["label"]) for row in solved if row["difference_high"] < 0]
    more = [str(row["label"]) for row in solved if row["difference_low"] > 0]
    text = (
        f"under the same conditions, with 95 % confidence each, less successful than {baseline}: "
        f"{'; '.join(less) or 'no setting'}. More successful: {'; '.join(more) or 'no setting'}"
    )
    unsolved = dict.fromkeys(str(row["baseline"]) for row in compared if row not in solved)
    return text + (f". These do not solve the tasks, nothing is compared: {'; '.join(unsolved)}" if unsolved else "")


def caution(table: pd.DataFrame) -> str:
    """Return one line that the reader should know before reading the numbers. Empty if there is nothing to say.

    It names policies that are given the positions of object and goal, and settings that verify nothing.
    """
    rows = rows_of(table, MICRO)
    privileged = sorted({str(row["policy.target"]) for row in rows if "privileged" in str(row["observation"])})
    unverified = [
        str(row["label"]) for row in rows if is_number(row["unverified_share"]) and row["unverified_share"] == 1
    ]
    clauses = [f"{', '.join(privileged)}: is given the positions of object and goal"] if privileged else []
    if unverified:
        clauses.append(f"{', '.join(unverified)}: nothing is verified")
    return "; ".join(clauses)
