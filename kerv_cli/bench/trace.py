"""Price a trace, and say which length of drafted chains would have been the fastest. This needs no torch.

A trace says which drafts were made and accepted, in a file that any program can write (docs/trace.md).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from kerv_cli.base import manifests
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.limits import number
from kerv_cli.bench.expected import Decodes, Drafts
from kerv_cli.engine.cost import COUNTED, READ_PHASES, Work, prices, work_of
from kerv_cli.engine.record import PARALLEL
from kerv_cli.engine.tree import TokenTree
from kerv_cli.report.profiles import NamedProfile

MOST = 1_000_000  # of every count in a trace
MODES = ("forward", "skip", PARALLEL)
"""Modes of a round. `forward`: the target ran. `skip`: a draft was executed without a forward. `parallel`: one forward
gave all tokens."""
_RESAMPLES = 200
_SEED = 0

CANNOT = (
    "A trace holds only drafts that were made. It says nothing of longer chains, of trees and of other drafters. Of "
    "shorter chains it is assumed that their i-th token is accepted as often as the recorded i-th token was."
)


@dataclass(frozen=True)
class TracedRound:
    """A forward of the target, and the draft that it verified.

    The default values describe a forward without a draft that commits one token.

    Attributes:
        start: Number of tokens committed before this forward. 0 if this forward reads the prompt.
        parents: Index of each draft node's parent, or −1 if the node follows the last committed token. Empty if the
            parents are unknown, or if there is no draft.
        nodes: Number of draft nodes. Only needed if `parents` is empty.
        levels: Number of levels of a drafted tree. 0 for a chain, or if `parents` states the tree.
        accepted: Number of accepted draft tokens.
        committed: Number of committed tokens, the target's own token included.
        proposer: Name of the proposer that drafted: `none`, or a proposer of kerv with the same cost.
        mode: One of MODES.
    """

    start: int = 0
    parents: list[int] = field(default_factory=list)
    nodes: int = 0
    levels: int = 0
    accepted: int = 0
    committed: int = 1
    proposer: str = "none"
    mode: str = "forward"

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            CheckpointError: A count is impossible, a parent comes after its child, or the mode is unknown.
        """
        for name in ("start", "nodes", "levels", "accepted", "committed"):
            if not 0 <= getattr(self, name) <= MOST:
                raise CheckpointError(f"{name}={getattr(self, name)}: from 0 to {MOST}")
        if any(not -1 <= parent < node for node, parent in enumerate(self.parents)):
            raise CheckpointError(f"parents={self.parents}: each is the index of an earlier node, or -1")
        if self.accepted > self.drafted and self.mode == MODES[0]:
            raise CheckpointError(f"accepted={self.accepted} of {self.drafted} draft tokens")
        if self.mode not in MODES:
            raise CheckpointError(f"mode={self.mode}: one of {', '.join(MODES)}")

    @property
    def drafted(self) -> int:
        """Number of draft tokens."""
        return len(self.parents) or self.nodes

    @property
    def depth(self) -> int:
        """Number of levels of a drafted tree. 0 for a chain."""
        return self.levels or TokenTree.build(self.parents, self.parents).levels


@dataclass(frozen=True)
class TracedDecode:
    """One decode of a trace.

    Attributes:
        episode: Name of the episode.
        tokens: N, number of tokens of the chunk.
        rounds: The decode's rounds in order.
        setting: Name of the setting that decoded, such as a method's name.
        prompt: Number of prompt tokens. None if unknown.
        encoded: Whether the target's vision encoder ran.
        searched: Whether a datastore was searched although no round drafted with the result.
        seconds: Seconds by phase, as far as they are known: `propose`, `accept`, `rectify`, `other`.
    """

    episode: str
    tokens: int = number(1, 1, MOST)
    rounds: list[TracedRound] = field(default_factory=list)
    setting: str = ""
    prompt: int | None = number(None, 1, MOST)
    encoded: bool = True
    searched: bool = False
    seconds: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that there is a round.

        Raises:
            CheckpointError: There is no round.
        """
        if not self.rounds:
            raise CheckpointError("rounds: a decode has one at least")


def read_trace(path: Path) -> list[TracedDecode]:
    """Return the decodes of a trace.

    Raises:
        CheckpointError: The file is missing or empty, or a line is no decode. The message names the line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise CheckpointError(f"trace={path} cannot be read: {why}") from error
    decodes = []
    for number_, line in enumerate(lines, 1):
        if line.strip():
            try:
                value = json.loads(line)
            except ValueError as error:
                raise CheckpointError(f"{path}:{number_} is no JSON: see docs/trace.md") from error
            decodes.append(manifests.read(TracedDecode, value, f"{path}:{number_}", tolerant=True))
    if not decodes:
        raise CheckpointError(f"{path} has no decode: see docs/trace.md")
    return decodes


def grouped(decodes: Sequence[TracedDecode]) -> dict[tuple[str, int], list[TracedDecode]]:
    """Group decodes by their setting and N, the number of tokens per chunk. The keys are (setting, N)."""
    groups: dict[tuple[str, int], list[TracedDecode]] = {}
    for one in decodes:
        groups.setdefault((one.setting, one.tokens), []).append(one)
    return groups


def work_of_trace(decodes: Sequence[TracedDecode], tokens: int) -> Work:
    """Return what some decodes computed: their forwards, their drafts, and the seconds of all other phases.

    Args:
        decodes: The decodes, all of the same chunk length.
        tokens: N, number of tokens of a chunk.
    """
    columns, phases, rounds = {}, {}, list[TracedRound]()
    counts, searched = [], []
    for decode in decodes:
        rounds += decode.rounds
        counts.append(len(decode.rounds))
        searched.append(decode.searched)
    for name, attribute in zip(COUNTED, ("mode", "proposer", "start", "drafted", "accepted", "depth"), strict=True):
        columns[name] = np.array(list(map(attrgetter(attribute), rounds)))
    for name in READ_PHASES:
        phases[name] = np.array([decode.seconds.get(name, 0.0) for decode in decodes])
    phases["vision"] = np.array([decode.encoded for decode in decodes])
    return work_of(columns, np.array(counts), phases, np.array(searched), tokens)


def price(trace: Sequence[TracedDecode], costs: NamedProfile) -> Iterator[dict[str, Any]]:
    """Yield what the decodes of each setting of a trace cost.

    Yields:
        One dictionary for each setting and chunk length. It holds the numbers of episodes and decodes, the milliseconds
        per decode and per episode, and the speed against AR decodes of chunks of the same length at the same costs. The
        95 % interval of the speed comes from resampling episodes. It is NaN for a single episode.

    Raises:
        UsageError: The profile lacks a cost, or has costs for shorter chunks only.
    """
    for (name, tokens), decodes in grouped(trace).items():
        work = work_of_trace(decodes, tokens)
        costs.check(tokens, work.needs, name)
        of_decode, episode = prices(work, costs.profile), _numbers(decodes)
        seconds, counts = np.bincount(episode, of_decode), np.bincount(episode)
        alone = counts * costs.profile.decode(tokens)
        (speed,), _ = _resampled(len(counts), partial(_ratio, alone, seconds))
        row = {"setting": name, "tokens": tokens, "episodes": len(counts), "decodes": len(decodes)}
        row["ms_per_decode"] = 1e3 * float(seconds.sum()) / len(decodes)
        row["ms_per_episode"] = 1e3 * float(seconds.sum()) / len(counts)
        yield row | speed


def _ratio(one: np.ndarray, other: np.ndarray, chosen: np.ndarray) -> list[float]:
    return [float(one[chosen].sum() / other[chosen].sum())]


def _numbers(decodes: Sequence[TracedDecode]) -> np.ndarray:
    """Number the episodes from 0. Return the number of each decode's episode, (decodes,)."""
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(one.episode, len(numbers)) for one in decodes])


def _resampled(
    episodes: int, speeds_of: Callable[[np.ndarray], Sequence[float]]
) -> tuple[list[dict[str, float]], float]:
    """Return one or more speeds with intervals, which come from drawing the episodes many times with replacement.

    Args:
        episodes: Number of episodes.
        speeds_of: Function that takes the numbers of the drawn episodes, and returns one speed per choice.

    Returns:
        The speed of each choice over all episodes, with its 95 % interval. And the share of the draws in which the same
        choice is the fastest as over all episodes. Intervals and share are NaN if there is only one episode.
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
    for (name, tokens), decodes in grouped(trace).items():
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
    """Return the speed of each plan, if tokens are accepted as often as in the chosen episodes.

    `_counts` explains `tried` and `accepted`, (episodes, longest chain). `chosen` holds numbers of episodes.
    """
    chances = (accepted[chosen].sum(0) / np.maximum(tried[chosen].sum(0), 1)).tolist()
    return [plan.speed(chances) for plan in plans]


def _counts(decodes: Sequence[TracedDecode]) -> tuple[np.ndarray, np.ndarray]:
    """Count how often a draft token was tried, and how often accepted, by episode and position in the drafted chain.

    A token is tried if all tokens before it in its chain were accepted.

    Returns:
        Two arrays (episodes, longest chain): tried and accepted tokens. Empty if there is no chain.
    """
    chains = []
    for episode, decode in zip(_numbers(decodes), decodes, strict=True):
        for one in decode.rounds:
            if one.drafted and one.start and not one.depth and one.mode == "forward":
                chains += [(episode, one.drafted, one.accepted)]
    if not chains:
        return np.zeros((0, 0)), np.zeros((0, 0))
    numbers, drafted, taken = np.array(chains).T
    positions = np.arange(drafted.max())
    tried = np.zeros((numbers.max() + 1, len(positions)))
    accepted = np.zeros_like(tried)
    np.add.at(tried, numbers, (positions <= taken[:, None]) & (positions < drafted[:, None]))
    np.add.at(accepted, numbers, positions < taken[:, None])
    return tried, accepted
