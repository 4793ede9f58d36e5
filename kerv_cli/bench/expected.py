"""Compute what a decode costs on average, from a profile and from how often draft tokens are accepted.

A decode is a prefill, then rounds of a draft and a verification. `engine.cost` gives the costs of these steps. How
a method drafts comes from the caller or from a published table. Nothing is run, and this module needs no torch.
"""

from __future__ import annotations

import bisect
import csv
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from kerv_cli.base.files import read_json
from kerv_cli.base.paths import shipped_dir
from kerv_cli.base.registry import DRAFTING
from kerv_cli.engine.cost import Profile

_TOP = 8  # children of a node, and kept nodes of a level, in EAGLE-2's tree
_STEPS = 2**20  # probabilities that a search distinguishes


@dataclass(frozen=True)
class Drafts:
    """How a method drafts, and which share of its decodes runs unverified.

    Attributes:
        depth: Largest number of tokens in a drafted chain, or of levels in a tree. 0 if the method uses no drafter.
        nodes: Largest number of nodes of a drafted tree. 0 if the drafter drafts chains.
        source: What drafts once per decode, instead of the drafter or in addition to it: `early` or `retrieval`. Empty
            if only the drafter drafts.
        in_prefill: Whether the prefill verifies the draft of `source`.
        retrieved: Share of the verified decodes in which `source` drafts instead of the drafter.
        skipped: Share of the decodes that execute the draft of `source` unverified.
    """

    depth: int = 0
    nodes: int = 0
    source: str = ""
    in_prefill: bool = False
    retrieved: float = 0.0
    skipped: float = 0.0


class Means(NamedTuple):
    """Mean seconds and counts of a verified decode, or of its remaining rounds.

    Attributes:
        seconds: Mean seconds.
        forwards: Mean number of forwards of the target's trunk.
        accepted: Mean number of accepted draft tokens.
        verifications: Mean number of forwards that verify a draft.
    """

    seconds: float = 0.0
    forwards: float = 0.0
    accepted: float = 0.0
    verifications: float = 0.0

    def mixed(self, other: Means, share: float) -> Means:
        """Return the mean of two cases: `other` has the probability `share`, and these means have 1 − `share`."""
        return Means(*((1 - share) * x + share * y for x, y in zip(self, other, strict=True)))


@dataclass(frozen=True)
class Decodes:
    """Computes the mean cost of a method's decodes from a latency profile.

    Attributes:
        profile: Seconds of every kind of forward and draft.
        tokens: N, number of tokens in a chunk.
        drafts: How the method drafts.
    """

    profile: Profile
    tokens: int
    drafts: Drafts

    def seconds(self, acceptance: Sequence[float]) -> float:
        """Return the mean seconds of a decode. Unverified decodes count with their share `drafts.skipped`.

        Args:
            acceptance: Probability that the first, second, … token of a draft is accepted; see `verified`.
        """
        share = self.drafts.skipped
        unverified = self._source + self._cost("encode", 1) if share else 0.0
        seconds = self.verified(acceptance).seconds if share < 1 else 0.0
        return (1 - share) * seconds + share * unverified

    def speed(self, acceptance: Sequence[float]) -> float:
        """Return the speed against autoregressive decoding. 2.0 means half the seconds per decode.

        Args:
            acceptance: Probability that the first, second, … token of a draft is accepted; see `verified`.
        """
        return self.profile.decode(self.tokens) / self.seconds(acceptance)

    def verified(self, acceptance: Sequence[float]) -> Means:
        """Return the expected seconds, forwards, accepted tokens and verifications of one verified decode.

        Args:
            acceptance: Probability that the first, second, … token of a draft is accepted, if all tokens before it
                were accepted. The last number holds for all further tokens.
        """
        size = (self.tokens - 1) * self.drafts.in_prefill
        after = [Means()] * (self.tokens + 1)
        for start in range(self.tokens - 1, 0, -1):
            after[start] = self._round(start, acceptance, after)
        prefill = self._forward("prefill", self.profile.prompt + size, size, 0, acceptance, after)
        return prefill._replace(seconds=self._cost("encode", 1) + self._source + prefill.seconds)

    def acceptance_for(self, forwards: float) -> float:
        """Return the smallest acceptance probability at which a verified decode takes `forwards` forwards or fewer.

        The probability is the same for every draft token. It is 1 if no smaller probability is enough.

        Args:
            forwards: Mean number of forwards of the target's trunk per decode.
        """
        return _least(lambda chance: self.verified([chance]).forwards <= forwards)

    def break_even(self) -> Means | None:
        """Find the acceptance probability of draft tokens at which a verified decode takes as long as an AR decode.

        Returns:
            The verified decode's mean seconds and counts at this probability. None if the verified decode is slower
            than an autoregressive (AR) decode even at probability 1.
        """
        limit = self.profile.decode(self.tokens)
        if self.verified([1.0]).seconds > limit:
            return None
        return self.verified([_least(lambda chance: self.verified([chance]).seconds <= limit)])

    @functools.cached_property
    def _cost(self) -> Callable[[str, int], float]:
        """`Profile.seconds` with a cache, because a search asks for the same costs many times."""
        return functools.cache(self.profile.seconds)

    @property
    def _source(self) -> float:
        return self._cost(self.drafts.source, 1) if self.drafts.source else 0.0

    def _round(self, start: int, acceptance: Sequence[float], after: Sequence[Means]) -> Means:
        """Return the means of the rest of a decode, which begins with a round after `start` committed tokens.

        `after[i]` holds the means of the rest after i committed tokens, for every i above `start`.
        """
        drafts, most = self.drafts, self.tokens - start - 1
        if drafts.retrieved == 1:
            return self._forward("verify", 1 + most, most, start, acceptance, after)
        if not (depth := min(drafts.depth, most)):
            return self._forward("verify", 1, 0, start, acceptance, after)
        nodes = min(drafts.nodes, _TOP + (depth - 1) * _TOP**2) if drafts.nodes else depth
        kind = "tree" if drafts.nodes and not self.profile.lacks(["tree"]) else DRAFTING
        own = self._forward("verify", 1 + nodes, depth, start, acceptance, after)
        own = own._replace(seconds=self._cost(kind, depth if kind == "tree" else nodes) + own.seconds)
        if not drafts.retrieved:
            return own
        searched = self._forward("verify", 1 + most, most, start, acceptance, after)
        return own.mixed(searched, drafts.retrieved)

    def _forward(
        self, kind: str, rows: int, depth: int, start: int, acceptance: Sequence[float], after: Sequence[Means]
    ) -> Means:
        """Return the means of the rest of a decode, which begins with a forward that verifies `depth` draft tokens.

        The forward has `rows` tokens. `_round` explains `start` and `after`.
        """
        prompt, reached, feeds = self.profile.prompt * (start == 0), 1.0, self.drafts.depth > 0
        seconds, forwards, taken, verifications = self._cost(kind, rows), 1.0, 0.0, float(depth > 0)
        for accepted in range(depth + 1):
            chance = acceptance[min(accepted, len(acceptance) - 1)] if accepted < depth else 0.0
            ends, reached = reached * (1 - chance), reached * chance
            stop = start + accepted + 1
            fed = feeds and stop < self.tokens  # the drafter reads the target's states
            feed = self._cost("feed", prompt + accepted + (start > 0)) if fed else 0.0
            later = after[stop]
            seconds += ends * (feed + later.seconds)
            forwards += ends * later.forwards
            taken += ends * (accepted + later.accepted)
            verifications += ends * later.verifications
        return Means(seconds, forwards, taken, verifications)


def _least(enough: Callable[[float], bool]) -> float:
    """Return the smallest probability for which `enough` is true. 1 if it is true for no probability.

    If `enough` is true for a probability, it must be true for all larger ones.
    """
    return bisect.bisect_left(range(_STEPS), True, key=lambda step: enough(step / _STEPS)) / _STEPS


TABLES = {"papers": 4, "papers_libero": 7, "main": 16}
"""The published tables in results/tables, each with N, the number of tokens per chunk in the table's decodes."""

_SOURCES = {"merged": "early", "early": "early", "retrieval": "retrieval"}
_DRAFTERS = ("drafter", "hybrid")


@dataclass(frozen=True)
class Recorded:
    """How a method decoded with one setting of a published table.

    Attributes:
        table: Name of the table.
        label: Label (name) of the setting.
        method: Name of the setting's method.
        tokens: N, number of tokens in a chunk.
        drafts: How the setting drafted.
        forwards: Mean number of forwards of the target's trunk per verified decode.
        speed: Measured speed against AR, per control step.
    """

    table: str
    label: str
    method: str
    tokens: int
    drafts: Drafts
    forwards: float
    speed: float


@functools.cache
def recorded(table: str) -> list[Recorded]:
    """Return the settings of a published table, AR first.

    Settings that emit all tokens of a chunk in one pass (`parallel`) are left out. Empty if the installed package does
    not contain the table.

    Args:
        table: One of TABLES.
    """
    folder = shipped_dir().parent / "tables"
    if not (folder / f"{table}.json").is_file():
        return []
    settings = read_json(folder / f"{table}.json")["labels"]
    found, rows = [], {}
    with (folder / f"{table}.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            if row["averaging"].startswith("micro"):  # over all tasks
                rows[row["label"]] = row
    for label, row in rows.items():
        chosen = settings[label]["settings"]
        if chosen["skip"]["kind"] == "parallel":
            continue
        drafts = _drafts(chosen, float(row["skip_rate"] or 0), float(row["retrieval_share"] or 0))
        verified, forwards = 1 - drafts.skipped, 0.0
        if verified:
            per_step, of_ar = float(row["forwards_per_step"]), float(rows[row["baseline"]]["forwards_per_step"])
            forwards = TABLES[table] * per_step / of_ar / verified
        found.append(Recorded(table, label, chosen["method"], TABLES[table], drafts, forwards, float(row["speedup"])))
    return found


def _drafts(settings: Mapping[str, Any], skipped: float, retrieved: float) -> Drafts:
    """Return how a setting drafts.

    Args:
        settings: Rollout settings, as nested dictionaries.
        skipped: Share of the setting's decodes that ran unverified.
        retrieved: Share of the setting's decodes that retrieved a draft, also unverified ones.
    """
    proposer, before = settings["proposer"], settings["prefill_draft"]["kind"]
    hybrid = proposer["kind"] == "hybrid"
    source = "retrieval" if hybrid else _SOURCES.get(before, "")
    searched = (retrieved - skipped) / (1 - skipped) if hybrid and skipped < 1 else 0.0
    return Drafts(
        depth=proposer["depth"] if proposer["kind"] in _DRAFTERS else 0,
        nodes=proposer["nodes"] if proposer.get("shape") == "tree" else 0,
        source=source,
        in_prefill=bool(source) and not hybrid,
        retrieved=max(searched, 0.0),
        skipped=skipped,
    )
