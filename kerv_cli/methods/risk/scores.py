"""Scores of a draft before anything is verified, larger = safer (docs/methods.md §4.6): what a gate may look at. The
learned one is a small network that expects a draft's loss (ours); its files are an artifact."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.base.registry import NoSettings, find
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.proposer import DraftsChunks
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.engine.transfer import upload
from kerv_cli.methods.artifacts import Request, Weights, WeightsDescription
from kerv_cli.methods.context import Context
from kerv_cli.methods.early.drafter import EarlyProposer
from kerv_cli.methods.merged.proposer import MergedProposer
from kerv_cli.methods.retrieval.datastore import RetrievalProposer
from kerv_cli.targets.compact.packed import load_packed

HIDDEN = 64
FLOOR = -50.0  # scores below, −inf among them, are read as this
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
        early = [source for source in of_merged if isinstance(source, EarlyProposer)]
        self.early = early[0] if early else EarlyProposer(context.artifact("early"), context.target)


class Odds(_OfEarly):
    """score=odds: log of the early drafter's estimate that the whole draft is accepted."""

    def of(self, draft: Draft) -> float:
        """Logarithm of the estimate, nats, at most 0."""
        return math.log(max(self.early.drafted(draft.chunk).odds, LEAST_ODDS))


class Entropy(_OfEarly):
    """score=entropy: negative mean entropy of the early drafter's tokens, nats."""

    def of(self, draft: Draft) -> float:
        """Negative mean entropy, nats."""
        return -self.early.drafted(draft.chunk).entropy


class Familiarity(_OfEarly):
    """score=familiarity: negative mean square of the early drafter's standardised features, how far the observation is
    from what the drafter was trained on, in standard deviations. It does not look at the draft."""

    def of(self, draft: Draft) -> float:
        """Negative mean square, at most 0."""
        return -float(self.early.distance(draft.chunk))


class Agreement:
    """Negative mean absolute difference to another source's draft, normalised action units; strict DoFs that differ
    count as 1."""

    def __init__(self, other: DraftsChunks) -> None:
        self.other = other

    def of(self, draft: Draft) -> float:
        """Negative mean difference; −∞ without a whole draft of the other source."""
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
        self.retrieval = RetrievalProposer.of_nearest(context)

    def of(self, draft: Draft) -> float:
        """Cosine of the best stored observation."""
        return float(self.retrieval.neighbours(draft.chunk).similarity[0])


class Steadiness:
    """score=steadiness: negative kinematic variability of the draft itself, its mean absolute change from action to
    action, the last executed one included, over the moving DoFs; normalised action units. KERV's and HeiSD's premise is
    that steady motion is predictable."""

    def __init__(self, settings: Any, context: Context) -> None:
        """Reads nothing but the draft."""

    def of(self, draft: Draft) -> float:
        """Negative mean change from action to action."""
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
        """Negative expected loss, −1 to 0."""
        values = [score.of(draft) for score in self.inputs]
        return -self.model.expected_loss(self.target.pooled(draft.chunk.prompt), values)


def agreement_hold(settings: Any, context: Context) -> Score:
    """score=agreement_hold."""
    return Agreement(find("proposer", "hold").built(NoSettings("hold"), context))


def agreement_retrieval(settings: Any, context: Context) -> Score:
    """score=agreement_retrieval."""
    return Agreement(RetrievalProposer.of_nearest(context))


class LearnedScore(nn.Module):
    """(pooled prompt (F,), s other scores) -> the expected loss in [0, 1]; two layers.

    inputs: names of the scores. features: F.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, inputs: Sequence[str], features: int, hidden: int = HIDDEN) -> None:
        super().__init__()
        self.inputs, self.features = tuple(inputs), features
        self.register_buffer("mean", torch.zeros(features + len(self.inputs)))
        self.register_buffer("scale", torch.ones(features + len(self.inputs)))
        self.enter = nn.Linear(features + len(self.inputs), hidden)
        self.leave = nn.Linear(hidden, 1)

    def standardise(self, x: Tensor) -> None:
        """Takes mean and spread from training inputs (n, F + s)."""
        self.mean.copy_(x.mean(0))
        self.scale.copy_(1.0 / x.std(0).clamp_min(1e-3))

    def forward(self, x: Tensor) -> Tensor:
        """(B, F + s) -> logits of the loss (B,)."""
        hidden = F.silu(self.enter(((x - self.mean) * self.scale).clamp(-5, 5)))
        logits: Tensor = self.leave(hidden)[:, 0]
        return logits

    @torch.inference_mode()
    def expected_loss(self, features: Tensor, scores: Sequence[float]) -> float:
        """features (1, F) and the values of `inputs` -> the expected loss in [0, 1]."""
        values = upload(np.asarray([scores], dtype=np.float32), features.device).clamp_min(FLOOR)
        return float(self(torch.cat([features.float(), values], 1)).sigmoid())


@dataclass(frozen=True, kw_only=True)
class ScoreDescription(WeightsDescription):
    """A learned score's JSON. source: the proposer of its drafts, and that artifact's hash. made_from: artifacts that
    drafts and inputs read, kind -> hash; absent from older scores."""

    inputs: list[str]
    features: int
    source: str
    source_sha256: str
    made_from: dict[str, str] = field(default_factory=dict)


class ScoreArtifact(Weights[ScoreDescription]):
    """The learned score's files."""

    kind, noun = "score", "learned score"
    again = "run 'kerv train score'"
    schema = ScoreDescription

    def sources(self, description: ScoreDescription) -> Mapping[str, str]:
        """See `Artifact.sources`; an older score names its source alone, the early drafter."""
        digest = description.source_sha256
        return description.made_from or ({description.source: digest} if digest else {})

    def load(self, place: Path, request: Request) -> LearnedScore:
        """The network, in float32 on the target's device."""
        description = self.checked(place, request.description)
        model = LearnedScore(description.inputs, description.features)
        return load_packed(model, place, self.kind, request.target.device, torch.float32)
