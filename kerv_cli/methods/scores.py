"""Scores of a draft before anything is verified, larger = safer (docs/methods.md §4.6): what a gate may look at."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from kerv_cli.base.registry import NoSettings, find
from kerv_cli.engine.chunk import Chunk, DraftsChunks
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.methods.learned_score import LearnedScore
from kerv_cli.methods.proposers import EarlyProposer, MergedProposer, RetrievalProposer

if TYPE_CHECKING:
    from kerv_cli.methods.build import Context

LEAST_ODDS = 1e-30


@dataclass(frozen=True)
class Draft:
    """A whole chunk that waits to be executed or verified. tokens: N of them, by `source`."""

    chunk: Chunk
    source: DraftsChunks
    tokens: tuple[int, ...]


class Score(Protocol):
    """One way to tell safe drafts from others."""

    def of(self, draft: Draft) -> float:
        """The score; −inf where it cannot be told."""


class _OfEarly:
    """Reads the method's own early drafter where it has one, so that nothing is drafted twice."""

    def __init__(self, settings: Any, context: Context) -> None:
        draft = context.built.get("prefill_draft")
        of_merged = draft.sources if isinstance(draft, MergedProposer) else [draft]
        own = [source for source in of_merged if isinstance(source, EarlyProposer)]
        self.early = own[0] if own else EarlyProposer(context.artifact("early"), context.target)


class Odds(_OfEarly):
    """score=odds: log of the early drafter's estimate that the whole draft is accepted."""

    def of(self, draft: Draft) -> float:
        """As `Score.of`; nats, at most 0."""
        return math.log(max(self.early.drafted(draft.chunk).odds, LEAST_ODDS))


class Entropy(_OfEarly):
    """score=entropy: negative mean entropy of the early drafter's tokens, nats."""

    def of(self, draft: Draft) -> float:
        """As `Score.of`."""
        return -self.early.drafted(draft.chunk).entropy


class Familiarity(_OfEarly):
    """score=familiarity: negative mean square of the early drafter's standardised features, how far the observation is
    from what the drafter was trained on, in standard deviations. It does not look at the draft."""

    def of(self, draft: Draft) -> float:
        """As `Score.of`."""
        return -float(self.early.distance(draft.chunk))


class Agreement:
    """Negative mean absolute difference to another source's draft, normalised action units; strict DoFs that differ
    count as 1."""

    def __init__(self, other: DraftsChunks) -> None:
        self.other = other

    def of(self, draft: Draft) -> float:
        """As `Score.of`."""
        chains = self.other.chains(draft.chunk, draft.chunk.size)
        if not chains or len(chains[0]) < len(draft.tokens):
            return -math.inf
        space, tokens, others = draft.chunk.space, np.array(draft.tokens), np.array(chains[0])
        off = np.abs(space.values_of(tokens) - space.values_of(others))
        strict = space.strict_tokens(len(tokens))
        off[strict] = tokens[strict] != others[strict]
        return -float(off.mean())


class Similarity:
    """score=similarity: cosine of the best stored observation (HeiSD's score)."""

    def __init__(self, settings: Any, context: Context) -> None:
        self.retrieval = _retrieval(context)

    def of(self, draft: Draft) -> float:
        """As `Score.of`."""
        return float(self.retrieval.neighbours(draft.chunk).similarity[0])


class Steadiness:
    """score=steadiness: negative kinematic variability of the draft itself, its mean absolute change from action to
    action, the last executed one included, over the moving DoFs; normalised action units. KERV's and HeiSD's premise is
    that steady motion is predictable."""

    def __init__(self, settings: Any, context: Context) -> None:
        """Reads nothing but the draft."""

    def of(self, draft: Draft) -> float:
        """As `Score.of`."""
        space, history = draft.chunk.space, draft.chunk.situation.history.values()
        values = space.values_of(np.array(draft.tokens)).reshape(-1, space.dofs)
        path = np.concatenate([history[-1:], values])
        if len(path) < 2:
            return -math.inf
        return -float(np.abs(np.diff(path, axis=0))[:, ~space.is_strict].mean())


class Learned:
    """score=learned: negative loss that a small network expects, from the pooled prompt and other scores (`kerv train
    score`)."""

    def __init__(self, settings: Any, context: Context) -> None:
        self.model: LearnedScore = context.artifact("score")
        self.target: ReadableTarget = context.target
        self.inputs = [find("score", name).built(NoSettings(name), context) for name in self.model.inputs]

    def of(self, draft: Draft) -> float:
        """As `Score.of`."""
        known = [score.of(draft) for score in self.inputs]
        return -self.model.expected_loss(self.target.pooled(draft.chunk.prompt), known)


def agreement_hold(settings: Any, context: Context) -> Score:
    """score=agreement_hold."""
    return Agreement(find("proposer", "hold").built(NoSettings("hold"), context))


def agreement_retrieval(settings: Any, context: Context) -> Score:
    """score=agreement_retrieval."""
    return Agreement(_retrieval(context))


def _retrieval(context: Context) -> RetrievalProposer:
    return RetrievalProposer(context.artifact("datastore"), context.target, 1, 1)
