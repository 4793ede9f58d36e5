"""Price a trace, and say which length of drafted chains would have been the fastest. This needs no torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.bench.expected import Decodes, Drafts
from kerv_cli.bench.trace import TracedDecode, grouped, work_of_trace
from kerv_cli.engine.cost import prices
from kerv_cli.report.profiles import NamedProfile

_RESAMPLES = 200
_SEED = 0

CANNOT = (
    "A trace holds only drafts that were made. It says nothing of longer chains, of trees and of other drafters. Of "
    "shorter chains it is assumed that their i-th token is accepted as often as the recorded i-th token was."
)


def price(trace: Sequence[TracedDecode], costs: NamedProfile) -> list[dict[str, Any]]:
    """Return what the decodes of each setting of a trace cost.

    Returns:
        One dictionary for each setting and chunk length. It holds the numbers of episodes and decodes, the milliseconds
        per decode and per episode, and the speed against AR decodes of chunks of the same length at the same costs. The
        95 % interval of the speed comes from resampling episodes. It is NaN for a single episode.

    Raises:
        UsageError: The profile lacks a cost, or has costs for shorter chunks only.
    """
    found = []
    for name, tokens, decodes in grouped(trace):
        work = work_of_trace(decodes, tokens)
        costs.check(tokens, work.needs, name)
        of_decode, episode = prices(work, costs.profile), _numbers(decodes)
        seconds, counts = np.bincount(episode, of_decode), np.bincount(episode)
        alone = counts * costs.profile.decode(tokens)
        (speed,), _ = _resampled(len(counts), partial(_ratio, alone, seconds))
        row = {"setting": name, "tokens": tokens, "episodes": len(counts), "decodes": len(decodes)}
        row["ms_per_decode"] = 1e3 * float(seconds.sum()) / len(decodes)
        row["ms_per_episode"] = 1e3 * float(seconds.sum()) / len(counts)
        found.append(row | speed)
    return found


def _ratio(one: np.ndarray, other: np.ndarray, chosen: np.ndarray) -> list[float]:
    return [float(one[chosen].sum() / other[chosen].sum())]


def _numbers(decodes: Sequence[TracedDecode]) -> np.ndarray:
    """Return the number of each decode's episode, from 0, (decodes,)."""
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(one.episode, len(numbers)) for one in decodes])


def _resampled(
    episodes: int, speeds_of: Callable[[np.ndarray], Sequence[float]]
) -> tuple[list[dict[str, float]], float]:
    """Return speeds with their intervals over episodes that are drawn with replacement.

    Args:
        episodes: Number of episodes.
        speeds_of: Numbers of episodes -> speeds.

    Returns:
        The speeds with their 95 % intervals, and the share of the draws whose fastest one is the fastest of all
        episodes, too. Intervals and share are NaN if there is one episode.
    """
    speeds, same = speeds_of(np.arange(episodes)), np.nan
    low = high = [np.nan] * len(speeds)
    if episodes > 1:
        random = np.random.default_rng(_SEED)
        drawn = np.array([speeds_of(random.integers(episodes, size=episodes)) for _ in range(_RESAMPLES)])
        low, high = np.quantile(drawn, (0.025, 0.975), axis=0).tolist()
        same = float(np.mean(drawn.argmax(1) == np.argmax(speeds)))
    names = ("speed", "low", "high")
    return [dict(zip(names, one, strict=True)) for one in zip(speeds, low, high, strict=True)], same


def choose_length(trace: Sequence[TracedDecode], costs: NamedProfile) -> list[dict[str, Any]]:
    """Compute how fast drafted chains of each length would have been, for each setting that drafts chains.

    The probability that the i-th draft token is accepted is measured on the recorded drafts that had an i-th token and
    whose earlier tokens were all accepted. Chains that were verified in the same forward as the prompt do not count.

    Returns:
        One dictionary for each setting and chunk length. Its `best` is the fastest length of chains. Its `speeds` are
        the speeds against AR, for each length from 0 (AR) to the longest recorded one. `sure` tells how certain `best`
        is: the episodes are resampled many times, and `sure` is the share of resamples in which `best` is the fastest.

    Raises:
        UsageError: The trace has no chain, or the profile lacks a cost.
    """
    found = []
    for name, tokens, decodes in grouped(trace):
        tried, accepted = _counts(decodes)
        if not len(tried):
            continue
        costs.check(tokens, ["draft", "feed", "verify"], name)
        plans = [Decodes(costs.profile, tokens, Drafts(length)) for length in range(tried.shape[1] + 1)]
        speeds, sure = _resampled(len(tried), partial(_speeds, plans, tried, accepted))
        lengths = [{"length": length, **one} for length, one in enumerate(speeds)]
        best = max(lengths, key=itemgetter("speed"))["length"]
        found.append({"setting": name, "tokens": tokens, "best": best, "sure": sure, "speeds": lengths})
    if not found:
        raise UsageError("choose=draft: the trace has no drafted chain outside of a prefill")
    return found


def _speeds(plans: Sequence[Decodes], tried: np.ndarray, accepted: np.ndarray, chosen: np.ndarray) -> list[float]:
    """Return the speed of each plan with the acceptance of the chosen episodes."""
    chances = (accepted[chosen].sum(0) / np.maximum(tried[chosen].sum(0), 1)).tolist()
    return [plan.speed(chances) for plan in plans]


def _counts(decodes: Sequence[TracedDecode]) -> tuple[np.ndarray, np.ndarray]:
    """Count, for every episode and every position in a drafted chain, how often it was tried and accepted.

    Returns:
        Two arrays (episodes, longest chain). Empty if there is no chain.
    """
    chains = []
    for number, decode in zip(_numbers(decodes), decodes, strict=True):
        for one in decode.rounds:
            if one.drafted and one.start and not one.depth and one.mode == "forward":
                chains += [(number, one.drafted, one.accepted)]
    if not chains:
        return np.zeros((0, 0)), np.zeros((0, 0))
    numbers, drafted, taken = np.array(chains).T
    positions = np.arange(drafted.max())
    tried = np.zeros((numbers.max() + 1, len(positions)))
    accepted = np.zeros_like(tried)
    np.add.at(tried, numbers, (positions <= taken[:, None]) & (positions < drafted[:, None]))
    np.add.at(accepted, numbers, positions < taken[:, None])
    return tried, accepted
