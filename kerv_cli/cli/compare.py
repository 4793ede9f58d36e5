"""Compare two success counts (`kerv compare 17/20 14/20`), and say how many pairs a comparison needs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction

import typer

from kerv_cli.base.errors import UsageError
from kerv_cli.base.registry import NoSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, end_with_json, print_table


@command("compare", NoSettings, keys="")
def compare(names: list[str], as_json: AsJson = False) -> None:
    """Compare two success counts: the difference with its 95 % interval; no run is needed.

    NAME: two success counts, such as 17/20. If both sides ran the same seeds, lost=N and won=N say in how many
    pairs only the first and only the second succeeded.

    Examples:
        kerv compare 17/20 14/20
        kerv compare 17/20 14/20 lost=4 won=1
    """
    from kerv_cli.report.statistics import PairedCounts, difference, mcnemar, paired_difference, wilson

    words, given = _two(names, "success counts, as in kerv compare 17/20 14/20")
    (a, first_of), (b, second_of) = map(_counts, words)
    first, second, p = wilson(a, first_of), wilson(b, second_of), None
    if given:
        lost, won = int(given.get("lost", 0)), int(given.get("won", 0))
        is_whole = all(number.denominator == 1 for number in given.values())
        if not is_whole or first_of != second_of or a - lost + won != b or not 0 <= lost <= a:
            raise UsageError(
                f"{' '.join(names)}: the counts do not agree; {words[0]} less lost= plus won= is the second"
            )
        counts = PairedCounts(a - lost, lost, won, first_of - a - won)
        change, p = paired_difference(counts), mcnemar(counts)
    else:
        change = difference(first, second)
    if as_json:
        end_with_json({"first": first._asdict(), "second": second._asdict(), "difference": change._asdict(), "p": p})
    rows = []
    for word, rate in zip(words, (first, second), strict=True):
        rows.append((word, f"{rate.value:.1%}", f"{rate.low:.1%} to {rate.high:.1%}"))
    low, high = f"{100 * change.low:+.1f}", f"{100 * change.high:+.1f}"
    name = "difference, unpaired (Newcombe)" if p is None else "difference, paired (Newcombe)"
    rows.append((name, f"{100 * change.value:+.1f} points", f"{low} to {high}"))
    print_table(("", "success", "95 % interval"), rows)
    if p is not None:
        typer.echo(f"McNemar's exact test: p = {p:.2g}")
    if change.low <= 0 <= change.high:
        typer.echo(f"No difference is shown: anything from {low} to {high} points agrees with these counts.")
    elif p is not None and p >= 0.05:
        typer.echo("No difference is shown: the interval excludes 0, but the exact test does not confirm it.")
    else:
        way = "more" if change.value > 0 else "less"
        typer.echo(f"The second succeeds {way} often: the difference is between {low} and {high} points.")


@command("power", NoSettings, keys="")
def power(names: list[str], as_json: AsJson = False) -> None:
    """Say how many pairs of episodes show a difference of success with a probability of 80 %.

    NAME: the success rate that you have and the one that you want to tell from it, such as 0.90 or 18/20.
    lost=SHARE says in which share of pairs only the first succeeds; without it, both ends are shown.

    Examples:
        kerv power 0.90 0.95
        kerv power 18/20 0.95 lost=0.02
    """
    from kerv_cli.report.statistics import MOST_PAIRS, pairs_for_power

    words, given = _two(names, "success rates, as in kerv power 0.90 0.95")
    first, second = map(_number, words)
    if not (0 <= first <= 1 and 0 <= second <= 1) or first == second:
        raise UsageError(f"{' '.join(words)}: name two different success rates from 0 to 1, as in kerv power 0.90 0.95")
    gain = second - first
    least, most = max(Fraction(0), -gain), min(first, 1 - second)
    assumed = {"no more than they must": least, "as often as independent episodes": first * (1 - second)}
    if given:
        assumed = {"lost= as given": given["lost"]}
        if not least <= given["lost"] <= most:
            raise UsageError(f"lost= with these rates is a number from {float(least):.3g} to {float(most):.3g}")
    plans, rows, shown = [], [], []
    for name, loss in assumed.items():
        lost, won = float(loss), float(loss + gain)
        pairs = pairs_for_power(lost, won)
        plans.append({"assumption": name, "lost": lost, "won": won, "pairs": pairs})
        shown.append(f"{pairs}" if pairs <= MOST_PAIRS else f"more than {MOST_PAIRS:,}")
        rows.append((name, f"{lost:.1%}", f"{won:.1%}", shown[-1]))
    if as_json:
        end_with_json(plans)
    print_table(("in a pair, only one side succeeds", "only the first", "only the second", "pairs needed"), rows)
    needed = " to ".join(dict.fromkeys(shown))
    typer.echo(
        f"{needed} pairs on the same seeds show a change from {float(first):.1%} to {float(second):.1%} with a "
        "probability of 80 % (McNemar's exact test at 5 %), if only one side of a pair succeeds as often as assumed."
    )


def _two(names: list[str], what: str) -> tuple[list[str], Mapping[str, Fraction]]:
    """Split the arguments into two counts or rates, and the numbers given as `key=number`.

    Args:
        names: The arguments.
        what: What the user must name, such as `success counts`, for the error message.

    Raises:
        UsageError: There are not exactly two counts or rates, or a number cannot be read.
    """
    words, numbers = [], {}
    for word in names:
        key, equals, value = word.partition("=")
        if equals:
            numbers[key] = _number(value, f"{key}=")
        else:
            words.append(word)
    if len(words) != 2:
        raise UsageError(f"name two {what}")
    return words, numbers


def _number(text: str, key: str = "") -> Fraction:
    try:
        value = Fraction(text)
    except (ValueError, ZeroDivisionError):
        raise UsageError(f"{key}{text} is no number: write it as 0.90 or 18/20") from None
    return value


def _counts(text: str) -> tuple[int, int]:
    """Return successes and episodes of a text such as `17/20`.

    Raises:
        UsageError: The text has another form, or more successes than episodes.
    """
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if not found:
        raise UsageError(f"'{text}' is no success count such as 17/20; for runs: kerv runs compare")
    successes, episodes = map(int, found.groups())
    if not 0 < episodes >= successes:
        raise UsageError(f"{text}: successes come first, then episodes, as in 17/20")
    return successes, episodes
