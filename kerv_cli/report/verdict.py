"""Decide which setting of a study to take, and write the sentences that say what the study shows.

A sentence says *faster*, *slower* or *loses less than* only if a 95 % interval shows it (docs/methods.md §7). If the
baseline's success rate is below `SOLVED`, no setting is recommended.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from kerv_cli.base.durations import count
from kerv_cli.report import statistics as stats
from kerv_cli.report.measures import Result, is_number
from kerv_cli.report.tables import SOLVED, passing, safety

POINTS = 100.0


@dataclass(frozen=True)
class Choice:
    """Which setting to take."""

    pairs: int  # number of pairs of the setting with the most pairs
    baseline_success: float  # success rate of the baseline
    # label of the fastest setting whose loss of success is shown to be acceptable; empty: no setting
    chosen: str = ""
    # without a choice: label of the fastest setting that more pairs at these rates would choose; empty: no setting
    candidate: str = ""
    # about how many pairs in all would let the candidate be chosen. NaN without a candidate.
    candidate_pairs: float = math.nan
    tested: int = 0  # number of settings whose loss of success is tested
    untimed: tuple[str, ...] = ()  # settings that are not tested, because others were timed and they were not
    # speed per episode of the chosen setting, or else of the candidate
    episode_speedup: stats.Estimate = stats.NO_ESTIMATE
    runs: int = 0  # number of runs (commands) from which the interval of `episode_speedup` was computed

    @property
    def is_shown(self) -> bool:
        """Whether a setting is shown both to be faster and to lose less success than the reader accepts."""
        return bool(self.chosen) and self.episode_speedup.low > 1

    @property
    def is_unsolved(self) -> bool:
        return self.baseline_success < SOLVED


def choose(rows: Sequence[Result], loss: float) -> Choice:
    """Choose the fastest setting that is shown to lose less success than `loss`, in points.

    Settings are tested in a fixed order, the safest first, until one fails (`passing`).
    """
    success = next((row.measures.success.value for row in rows if row.is_baseline), math.nan)
    pairs = max((row.measures.pairs for row in rows if not row.is_baseline), default=0)
    choice = Choice(pairs, success)
    if choice.is_unsolved:
        return choice
    order = safest_first(rows)
    untimed = tuple(row.label for row in rows if row.is_compared and not is_number(row.speed) and row not in order)
    choice = replace(choice, tested=len(order), untimed=untimed)
    if passed := passing(order, loss / POINTS):
        best = _fastest(passed)
        choice = replace(choice, chosen=best.label)
    else:
        # a setting is tested only after all safer ones have passed, so it needs the most pairs of all of these
        each = (stats.pairs_to_settle(row.measures.counts, loss / POINTS) for row in order)
        needed = list(itertools.takewhile(math.isfinite, itertools.accumulate(each, max)))
        if not needed:
            return choice
        best = _fastest(order[: len(needed)])
        choice = replace(choice, candidate=best.label, candidate_pairs=needed[order.index(best)])
    return replace(choice, episode_speedup=best.measures.episode_speedup, runs=best.runs)


def safest_first(rows: Sequence[Result]) -> list[Result]:
    """Return the rows that the verdict tests, the safest first (`safety`). Equally safe ones keep the study's order.

    Settings that are not faster than the baseline are left out. So are settings without a measured speed, unless no
    setting has one: then success alone decides.
    """
    compared = [row for row in rows if row.is_compared]
    is_timed = any(is_number(row.speed) for row in compared)
    return sorted((row for row in compared if row.speed > 1 or not is_timed), key=safety)


def _fastest(rows: Sequence[Result]) -> Result:
    def speed(row: Result) -> tuple[bool, float]:
        found = row.measures.episode_speedup
        return (found.low > 1, found.value) if is_number(found.value) else (False, -math.inf)

    return max(reversed(rows), key=speed)


class Verdict(NamedTuple):
    """A study's answer."""

    sentence: str
    is_shown: bool = False  # whether a setting is shown both to be faster and to lose less success than is accepted
    # about how many episodes per task would let the sentence name a setting. 0 if it names one already, if more would
    # not help, or if more than ten times as many pairs as there are would be needed
    episodes: int = 0


def verdict_of(rows: Sequence[Result], loss: float) -> Verdict:
    """Return a study's answer, given its rows over all tasks. `loss` is in points."""
    baselines = {row.baseline for row in rows if row.is_compared}
    if not baselines:
        rates = ", ".join(f"{row.label} {POINTS * row.measures.success.value:.1f} %" for row in rows)
        return Verdict(f"success: {rates}.")
    if len(baselines) > 1:
        return Verdict(f"{under_conditions(rows)}.")
    found = choose(rows, loss)
    episodes = math.ceil(found.candidate_pairs / rows[0].tasks) if found.candidate_pairs <= 10 * found.pairs else 0
    return Verdict(f"{sentence(found, loss, rows[0].baseline)}.", found.is_shown, episodes)


def question(results: Sequence[Result], loss: float) -> str:
    baselines = {row.baseline for row in results if row.is_compared}
    if len(baselines) > 1:
        return "Which settings succeed less or more often than the baseline under the same stress and clock?"
    (baseline,) = baselines or [""]
    wanted = f"is faster than the baseline {baseline} and loses less than {loss:g} points of success"
    return f"Which setting {wanted}?" if baseline else ""


def sentence(choice: Choice, loss: float, baseline: str) -> str:
    if choice.is_unsolved:
        share = f"{100 * choice.baseline_success:.0f} %"
        return f"{baseline} does not solve these tasks ({share} of its episodes succeed), so no setting is recommended"
    bound = f"loses less than {loss:g} points of success against {baseline}"
    if choice.chosen:
        return f"{choice.chosen} {bound} (95 % confidence, {count(choice.pairs, 'pair')}){_speed(choice)}"
    pairs, untimed = count(choice.pairs, "pair"), ""
    if choice.untimed:
        untimed = f"; without a measured speed: {', '.join(choice.untimed)}"
    if not choice.tested:
        return f"no setting is shown to be faster per episode than {baseline} ({pairs}){untimed}"
    if not choice.candidate:
        return f"{pairs} cannot show a setting that is faster and {bound}; {_missing(choice)}"
    if is_number(choice.episode_speedup.value):
        named = f"the fastest setting that may keep the success is {choice.candidate}: {_factor(choice)}"
    else:
        named = f"no speed was measured; {choice.candidate} may keep the success"
    return f"{named}. {pairs} cannot show that it {bound}; {_missing(choice)}"


def order_of(by_speed: Sequence[tuple[str, stats.Estimate]]) -> str:
    """Return the settings as text, ordered by their speed per episode. `≈` joins two that are not shown to differ.

    Args:
        by_speed: The settings, the fastest first, each with its speed relative to the next slower setting.
    """
    text = ""
    for label, speed in by_speed[:-1]:
        text += f"{label} {'>' if speed.low > 1 else '≈'} "
    apart = " (≈: these episodes cannot tell the two apart)" if "≈" in text else ""
    return f"{text}{by_speed[-1][0]}{apart}" if by_speed else ""


def _speed(choice: Choice) -> str:
    if not is_number(choice.episode_speedup.value):
        return "; its speed was not measured"
    shown = "and is faster" if choice.is_shown else "but is not shown to be faster"
    return f" {shown}: {_factor(choice)}"


def _factor(choice: Choice) -> str:
    speed = choice.episode_speedup
    runs = f"of {choice.runs} runs" if choice.runs > 2 else "of this run"
    interval = f"({speed.low:.2f}–{speed.high:.2f} {runs})" if is_number(speed.low) else f"({runs})"
    return f"{speed.value:.2f} {interval} times as fast per episode on this machine"


def _missing(choice: Choice) -> str:
    if not choice.candidate:
        return "at these rates, more pairs would not show one either"
    more = max(1, math.ceil(choice.candidate_pairs - choice.pairs))
    number = f"about {more}" if more <= stats.MOST_PAIRS else f"more than {stats.MOST_PAIRS:,}"
    return f"at these rates, {number} more pairs would show it for {choice.candidate}"


def under_conditions(rows: Sequence[Result]) -> str:
    less, more = [], []
    failing: dict[str, None] = {}
    for row in rows:
        counts, difference = row.measures.counts, row.measures.difference
        if not row.is_compared:
            continue
        if (counts.both + counts.only_baseline) / row.measures.pairs < SOLVED:
            failing[row.baseline] = None
        elif difference.high < 0:
            less.append(f"{row.label} (than {row.baseline})")
        elif difference.low > 0:
            more.append(f"{row.label} (than {row.baseline})")
    text = (
        "under the same conditions, with 95 % confidence each, less successful than the baseline: "
        f"{'; '.join(less) or 'no setting'}. More successful: {'; '.join(more) or 'no setting'}"
    )
    return text + (f". These do not solve the tasks, nothing is compared: {'; '.join(failing)}" if failing else "")


def caution(results: Sequence[Result]) -> str:
    """Return what the reader should know before the numbers: privileged policies, and settings that verify nothing."""
    privileged, unverified = set(), []
    for row in results:
        if "privileged" in row.observation:
            privileged.add(str(row.settings["policy.target"]))
        if row.measures.unverified_share == 1:
            unverified.append(row.label)
    clauses = [f"{', '.join(sorted(privileged))}: is given the positions of object and goal"] if privileged else []
    if unverified:
        clauses.append(f"{', '.join(unverified)}: nothing is verified")
    return "; ".join(clauses)
