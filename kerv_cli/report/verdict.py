"""Write the sentences that say what a study shows. No other module of kerv writes such a sentence.

A sentence says *faster*, *slower* or *loses less than* only if a 95 % interval shows it. If the baseline succeeds in
less than the share `SOLVED` of its episodes, no setting is recommended.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from kerv_cli.base.durations import count
from kerv_cli.report.decide import POINTS, SOLVED, Choice, choose
from kerv_cli.report.results import Result, averaged, is_number
from kerv_cli.report.statistics import MOST_PAIRS, Estimate


def verdict_of(results: Sequence[Result], loss: float) -> tuple[str, bool]:
    """Return a study's answer as a sentence for the report.

    Args:
        results: The study's rows over all tasks.
        loss: Largest acceptable loss of success against the baseline, in points (percentage points).

    Returns:
        The sentence, and whether a setting is shown both to be faster and to lose less than `loss`.
    """
    rows = averaged(results)
    if not any(row.is_compared for row in rows):
        rates = ", ".join(f"{row.label} {POINTS * row.measures.success.value:.1f} %" for row in rows)
        return f"success: {rates}.", False
    if len(baselines_of(rows)) > 1:
        return f"{under_conditions(rows)}.", False
    found = choose("all tasks", rows, loss)
    return f"{sentence(found, loss, rows[0].baseline)}.", found.is_shown


def baselines_of(rows: Sequence[Result]) -> list[str]:
    """Return the labels of the settings that others are compared with, each once."""
    return list(dict.fromkeys(row.baseline for row in rows))


def question(results: Sequence[Result], loss: float) -> str:
    """Return the question that the study's verdict answers. Empty if nothing is compared.

    Args:
        results: The study's rows over all tasks.
        loss: Largest acceptable loss of success, in points.
    """
    baselines = baselines_of([row for row in results if row.measures.pairs])
    if len(baselines) > 1:
        return "Which settings succeed less or more often than the baseline under the same stress and clock?"
    if not baselines or all(row.is_baseline for row in results):
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
    pairs = count(choice.pairs, "pair")
    if not choice.candidate:
        return f"{pairs} cannot show a setting that is faster and {bound}; {_missing(choice)}"
    factor = f": {_factor(choice)}" if is_number(choice.episode_speedup.value) else ""
    fastest = f"the fastest setting that may keep the success is {choice.candidate}{factor}"
    return f"{fastest}. {pairs} cannot show that it {bound}; {_missing(choice)}"


def order_of(by_speed: Sequence[tuple[str, Estimate]]) -> str:
    """Return the settings in the order of their speed per episode, and which neighbours cannot be told apart.

    Args:
        by_speed: The settings, the fastest first, each with its speed against the next.
    """
    text = ""
    for label, speed in by_speed[:-1]:
        text += f"{label} {'>' if speed.low > 1 else '≈'} "
    apart = " (≈: these episodes cannot tell the two apart)" if "≈" in text else ""
    return f"{text}{by_speed[-1][0]}{apart}" if by_speed else ""


def episodes_to_settle(results: Sequence[Result], loss: float) -> int:
    """Return about how many episodes per task would let the verdict name a setting.

    0 if it names one already, or if more episodes would not help.

    Args:
        results: The study's rows over all tasks.
        loss: Largest acceptable loss of success, in points.
    """
    rows = averaged(results)
    if len(baselines_of(rows)) > 1:
        return 0
    pairs = choose("all tasks", rows, loss).candidate_pairs
    return math.ceil(pairs / rows[0].tasks) if pairs <= MOST_PAIRS else 0


def unsolved(baseline: str, success: float) -> str:
    """Return the sentence that a baseline succeeds too rarely, so that no setting is recommended.

    Args:
        baseline: Label of the baseline.
        success: Success rate of the baseline, from 0 to 1.
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
    if not is_number(choice.episode_speedup.value):
        return "; its speed was not measured"
    shown = "and is faster" if choice.is_shown else "but is not shown to be faster"
    return f" {shown}: {_factor(choice)}"


def _factor(choice: Choice) -> str:
    """Return the speed of the chosen setting, or of the candidate, with its interval."""
    speed = choice.episode_speedup
    runs = f"of {choice.runs} runs" if choice.runs > 2 else "of this run"
    interval = f"({speed.low:.2f}–{speed.high:.2f} {runs})" if is_number(speed.low) else f"({runs})"
    return f"{speed.value:.2f} {interval} times as fast per episode on this machine"


def _missing(choice: Choice) -> str:
    """Return the clause that says about how many more pairs would show that a setting is good enough to be chosen.

    It names that setting. If more pairs would not help, it says so.
    """
    if not choice.candidate:
        return "at these rates, more pairs would not show one either"
    more = max(1, math.ceil(choice.candidate_pairs - choice.pairs))
    number = f"about {more}" if more <= MOST_PAIRS else f"more than {MOST_PAIRS:,}"
    return f"at these rates, {number} more pairs would show it for {choice.candidate}"


def under_conditions(rows: Sequence[Result]) -> str:
    """Say which settings succeed less or more often than the baseline under the same stress and clock.

    Args:
        rows: The study's rows, pooled over tasks.
    """
    method = next(row.method for row in rows if row.is_baseline)
    less, more = [], []
    failing: dict[str, None] = {}
    for row in rows:
        counts, difference = row.measures.counts, row.measures.difference
        if not row.is_compared:
            continue
        if (counts.both + counts.only_baseline) / row.measures.pairs < SOLVED:
            failing[row.baseline] = None
        elif difference.high < 0:
            less.append(row.label)
        elif difference.low > 0:
            more.append(row.label)
    text = (
        f"under the same conditions, with 95 % confidence each, less successful than {method}: "
        f"{'; '.join(less) or 'no setting'}. More successful: {'; '.join(more) or 'no setting'}"
    )
    return text + (f". These do not solve the tasks, nothing is compared: {'; '.join(failing)}" if failing else "")


def caution(results: Sequence[Result]) -> str:
    """Return one line that the reader should know before reading the numbers. Empty if there is nothing to say.

    The line names policies that are given the positions of object and goal, and settings that verify nothing.
    """
    privileged, unverified = set(), []
    for row in averaged(results):
        if "privileged" in row.observation:
            privileged.add(str(row.settings["policy.target"]))
        if row.measures.unverified_share == 1:
            unverified.append(row.label)
    clauses = [f"{', '.join(sorted(privileged))}: is given the positions of object and goal"] if privileged else []
    if unverified:
        clauses.append(f"{', '.join(unverified)}: nothing is verified")
    return "; ".join(clauses)
