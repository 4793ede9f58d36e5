"""Price a trace, and say which length of drafted chains would have been the fastest. This needs no torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.bench.expected import Decodes, Drafts
from kerv_cli.bench.prices import Costs, check_tokens
from kerv_cli.engine.cost import prices
from kerv_cli.engine.trace import TracedDecode, grouped, work_of_trace

_RESAMPLES = 200
_SEED = 0

CANNOT = (
    "A trace holds only drafts that were made. It says nothing of longer chains, of trees and of other drafters. Of "
    "shorter chains it is assumed that their i-th token is accepted as often as the recorded i-th token was."
)


class Speed(NamedTuple):
    """A speed against AR, and the 95 % interval of resampled episodes. NaN: there is one episode."""

    speed: float
    low: float
    high: float

    def __str__(self) -> str:
        """Return it as text."""
        return f"{self.speed:.2f}" + ("" if np.isnan(self.low) else f" ({self.low:.2f}–{self.high:.2f})")


@dataclass(frozen=True)
class TracePrice:
    """What the decodes of a setting cost.

    Attributes:
        setting: Name of the setting.
        tokens: N, number of tokens of a chunk.
        decodes: Number of decodes.
        episodes: Number of episodes.
        seconds: Seconds of all decodes.
        speed: Against AR decodes of as many tokens at the same costs.
    """

    setting: str
    tokens: int
    decodes: int
    episodes: int
    seconds: float
    speed: Speed

    @property
    def document(self) -> dict[str, Any]:
        """Its figures, for JSON."""
        return {
            "setting": self.setting,
            "tokens": self.tokens,
            "episodes": self.episodes,
            "decodes": self.decodes,
            "ms_per_decode": 1e3 * self.seconds / self.decodes,
            "ms_per_episode": 1e3 * self.seconds / self.episodes,
            **self.speed._asdict(),
        }

    @property
    def cells(self) -> dict[str, object]:
        """Its figures, for a table."""
        values = self.document
        times = {f"ms per {name}": f"{values[f'ms_per_{name}']:.4g}" for name in ("decode", "episode")}
        counts = {name: values[name] for name in ("setting", "tokens", "episodes", "decodes")}
        return {**counts, **times, "speed against AR": self.speed}


def price(trace: Sequence[TracedDecode], costs: Costs) -> list[TracePrice]:
    """Return what each setting of a trace costs.

    Raises:
        UsageError: The profile lacks a cost, or has costs for shorter chunks only.
    """
    found = []
    for name, tokens, decodes in grouped(trace):
        check_tokens(costs.engine, costs.profile, tokens)
        work = work_of_trace(decodes, tokens)
        if lacks := costs.profile.lacks(work.needs):
            raise UsageError(f"on={costs.engine}: no cost of '{lacks[0]}', which setting '{name}' needs")
        of_decode, episode = prices(work, costs.profile), _numbers(decodes)
        seconds, counts = np.bincount(episode, of_decode), np.bincount(episode)
        alone = counts * costs.profile.decode(tokens)
        (speed,), _ = _resampled(len(counts), partial(_ratio, alone, seconds))
        found.append(TracePrice(name, tokens, len(decodes), len(counts), float(seconds.sum()), speed))
    return found


def _ratio(one: np.ndarray, other: np.ndarray, chosen: np.ndarray) -> list[float]:
    return [float(one[chosen].sum() / other[chosen].sum())]


def _numbers(decodes: Sequence[TracedDecode]) -> np.ndarray:
    """Return the number of each decode's episode, from 0, (decodes,)."""
    names = {name: index for index, name in enumerate(dict.fromkeys(one.episode for one in decodes))}
    return np.array([names[one.episode] for one in decodes])


def _resampled(episodes: int, speeds_of: Callable[[np.ndarray], Sequence[float]]) -> tuple[list[Speed], float]:
    """Return speeds with their intervals over episodes that are drawn with replacement.

    Args:
        episodes: Number of episodes.
        speeds_of: Numbers of episodes -> speeds.

    Returns:
        The speeds, and the share of the draws whose fastest one is the fastest of all episodes, too. NaN: one episode.
    """
    speeds = speeds_of(np.arange(episodes))
    if episodes < 2:
        return [Speed(one, np.nan, np.nan) for one in speeds], np.nan
    random = np.random.default_rng(_SEED)
    drawn = np.array([speeds_of(random.integers(episodes, size=episodes)) for _ in range(_RESAMPLES)])
    low, high = np.quantile(drawn, (0.025, 0.975), axis=0).tolist()
    same = float(np.mean(drawn.argmax(1) == np.argmax(speeds)))
    return [Speed(*one) for one in zip(speeds, low, high, strict=True)], same


@dataclass(frozen=True)
class Lengths:
    """How fast chains of each length would have been.

    Attributes:
        setting: Name of the setting.
        tokens: N, number of tokens of a chunk.
        speeds: Speed against AR by length, 0 (AR) … the longest recorded one.
        sure: Share of the resampled episodes in which the fastest length is the fastest, too.
    """

    setting: str
    tokens: int
    speeds: Sequence[Speed]
    sure: float

    @property
    def best(self) -> int:
        """The fastest length."""
        return int(np.argmax([one.speed for one in self.speeds]))

    @property
    def document(self) -> dict[str, Any]:
        """The lengths, for JSON."""
        speeds = [{"length": length, **one._asdict()} for length, one in enumerate(self.speeds)]
        return {"setting": self.setting, "tokens": self.tokens, "best": self.best, "sure": self.sure, "speeds": speeds}

    @property
    def cells(self) -> dict[str, object]:
        """The lengths, for a table."""
        each = ", ".join(f"{length}: {one.speed:.2f}" for length, one in enumerate(self.speeds) if length)
        sure = "–" if np.isnan(self.sure) else f"{100 * self.sure:.0f} %"
        about = {"setting": self.setting, "tokens": self.tokens, "fastest length": self.best}
        return {**about, "speed against AR": self.speeds[self.best], "fastest of resamples": sure, "by length": each}


def choose_length(trace: Sequence[TracedDecode], costs: Costs) -> list[Lengths]:
    """Return how fast chains of each length would have been, for each setting of a trace that drafts chains.

    A draft's i-th token is accepted with the share of recorded drafts that were at least i tokens long, accepted before
    it, and accepted there, too. Chains inside a prefill do not count.

    Raises:
        UsageError: The trace has no chain, or the profile lacks a cost.
    """
    found = []
    for name, tokens, decodes in grouped(trace):
        tried, accepted = _places(decodes)
        if not len(tried):
            continue
        check_tokens(costs.engine, costs.profile, tokens)
        if lacks := costs.profile.lacks(["draft", "feed", "verify"]):
            raise UsageError(f"on={costs.engine}: no cost of '{lacks[0]}'")
        plans = [Decodes(costs.profile, tokens, Drafts(length)) for length in range(tried.shape[1] + 1)]

        speeds = partial(_speeds, plans, tried, accepted)
        found.append(Lengths(name, tokens, *_resampled(len(tried), speeds)))
    if not found:
        raise UsageError("choose=draft: the trace has no drafted chain outside of a prefill")
    return found


def _speeds(plans: Sequence[Decodes], tried: np.ndarray, accepted: np.ndarray, chosen: np.ndarray) -> list[float]:
    """Return the speed of each plan with the acceptance of the chosen episodes."""
    chances = (accepted[chosen].sum(0) / np.maximum(tried[chosen].sum(0), 1)).tolist()
    return [plan.speed(chances) for plan in plans]


def _places(decodes: Sequence[TracedDecode]) -> tuple[np.ndarray, np.ndarray]:
    """Count, for every episode and every place of a drafted chain, how often it was tried and accepted.

    Returns:
        Two arrays (episodes, longest chain). Empty if there is no chain.
    """
    chains = [
        (number, one.drafted, one.accepted)
        for number, decode in zip(_numbers(decodes), decodes, strict=True)
        for one in decode.rounds
        if one.drafted and one.start and not one.depth and one.mode == "forward"
    ]
    if not chains:
        return np.zeros((0, 0)), np.zeros((0, 0))
    number, drafted, taken = np.array(chains).T
    places = np.arange(drafted.max())
    tried = (places <= taken[:, None]) & (places < drafted[:, None])
    counts = [np.zeros((number.max() + 1, len(places))) for _ in range(2)]
    for count, values in zip(counts, (tried, places < taken[:, None]), strict=True):
        np.add.at(count, number, values)
    return counts[0], counts[1]
