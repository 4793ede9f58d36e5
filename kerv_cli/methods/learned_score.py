"""A learned score: a small network that expects a draft's loss (docs/methods.md §4.6, ours)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.transfer import upload
from kerv_cli.methods.artifacts import Artifact, MadeFor, MadeFrom, Request, artifact_folder
from kerv_cli.targets.checkpoint import Description, load_state, read_description, save_module

AGAIN = "run 'kerv train score'"
HIDDEN = 64
FLOOR = -50.0  # scores below, −inf among them, are read as this


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
        known = upload(np.asarray([scores], dtype=np.float32), features.device).clamp_min(FLOOR)
        return float(self(torch.cat([features.float(), known], 1)).sigmoid())


@dataclass(frozen=True)
class ScoreDescription(Description):
    """A learned score's JSON. target: hash of the weights whose prompts it reads. source: what drafted, by its hash.
    made_from: artifacts that drafts and inputs read, kind -> hash; absent from older scores."""

    inputs: list[str]
    features: int
    target: str
    source: str
    source_sha256: str
    chunk: int
    actions: ActionSpace
    provenance: dict[str, Any]
    made_from: dict[str, str] = field(default_factory=dict)

    @property
    def artifacts(self) -> dict[str, str]:
        """As `made_from`; an older score names what drafted alone, the early drafter."""
        return self.made_from or ({self.source: self.source_sha256} if self.source_sha256 else {})


def save_score(
    folder: Path,
    model: LearnedScore,
    made_for: MadeFor,
    source: tuple[str, str],
    made_from: Mapping[str, str],
    made: dict[str, Any],
) -> str:
    """Writes the score -> SHA-256 of its weights. source: name and hash of what drafted. made_from: kind -> hash."""
    described = {
        "inputs": list(model.inputs),
        "features": model.features,
        "target": made_for.sha256,
        "source": source[0],
        "source_sha256": source[1],
        "chunk": made_for.chunk,
        "actions": made_for.actions.as_dict(),
        "made_from": dict(made_from),
        "provenance": made,
    }
    return save_module(folder, "score", model, described)


def read_score(folder: Path, request: Request) -> ScoreDescription:
    """The description in `folder`; errors as `targets.checkpoint.read_description`, and for another target."""
    own = read_description(folder, "score", ScoreDescription)
    target = request.description
    MadeFor(own.target, own.actions, own.chunk).check_same(
        MadeFor(target.sha256, target.actions, target.chunk), f"the score in {folder}", "trained", AGAIN
    )
    return own


def _sources(folder: Path) -> MadeFrom:
    own = read_description(folder, "score", ScoreDescription)
    return MadeFrom(f"the score in {folder}", "trained", AGAIN, own.artifacts)


def _load(folder: Path, request: Request) -> LearnedScore:
    own = read_score(folder, request)
    model = LearnedScore(own.inputs, own.features)
    load_state(model, folder, "score")
    return model.eval()


ARTIFACT = Artifact(
    *("score", artifact_folder("score"), lambda folder, request: read_score(folder, request).sha256, _load, _sources)
)
