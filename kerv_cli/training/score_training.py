"""Training the learned score on a recording of drafts and losses (docs/methods.md §4.6)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.provenance import provenance
from kerv_cli.base.settings import TrainScoreSettings
from kerv_cli.engine.loss import BAD, auc
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.risk.recording import FEATURES, RiskRecording
from kerv_cli.methods.risk.scores import FLOOR, LearnedScore, ScoreArtifact

Metrics = dict[str, float]


class ScoreRun:
    """`kerv train score`: call `train`, which writes.

    Raises:
        CheckpointError: no recording, one without features, or without one of the inputs.
    """

    def __init__(self, settings: TrainScoreSettings) -> None:
        self.settings = settings
        self.artifacts = Artifacts(settings.results, settings.policy)
        self.folder = self.artifacts.place("score")
        self.recording: RiskRecording = self.artifacts.load("risk")
        self.source = next(iter(self.recording.manifest.sources))
        missing = [name for name in settings.inputs if name not in self.recording.manifest.scores]
        if missing:
            raise CheckpointError(
                f"score {missing[0]} was not recorded: run 'kerv calibrate risk scores=[…,{missing[0]}]'"
            )
        if FEATURES not in self.recording.manifest.files:
            raise CheckpointError("the recording has no features: run 'kerv calibrate risk features=true'")
        self.features = np.load(self.artifacts.place("risk") / FEATURES)

    def plan(self) -> str:
        """One line for --plan."""
        s = self.settings
        return f"{self.folder}: loss of {self.source} from the prompt and {', '.join(s.inputs)}, {s.steps} steps"

    def train(self, on_step: Callable[[int, int], None]) -> Metrics:
        """Trains on a random share of the episodes and writes -> measures on the others. They do not certify a level of
        the score: that takes a recording of other episodes, with score=learned."""
        s, drafts = self.settings, self.recording.losses(self.source)
        x, y, held_out = self._inputs(), torch.tensor(drafts.losses).float(), self._held_out(drafts.episodes)
        torch.manual_seed(s.seed)
        model = LearnedScore(s.inputs, self.features.shape[1])
        model.standardise(x[~held_out])
        optimiser = torch.optim.AdamW(model.parameters(), lr=s.lr, weight_decay=s.weight_decay)
        for step in range(s.steps):
            optimiser.zero_grad()
            F.binary_cross_entropy_with_logits(model(x[~held_out]), y[~held_out]).backward()
            optimiser.step()
            on_step(step + 1, s.steps)
        with torch.no_grad():
            expected = model(x[held_out]).sigmoid().numpy()
        bad = y[held_out].numpy() > BAD
        metrics = {
            "auc": auc(-expected, bad),
            "loss_of_all": float(y[held_out].mean()),
            **{f"auc.{name}": auc(drafts.scores[name][held_out.numpy()], bad) for name in s.inputs},
        }
        metrics = {name: value for name, value in metrics.items() if math.isfinite(value)}  # no AUC without bad drafts
        origin = {"command": "kerv train score", "settings": asdict(s), "metrics": metrics, **provenance("cpu")}
        manifest = self.recording.manifest
        ScoreArtifact().save(
            self.folder,
            model,
            manifest.target,
            origin,
            inputs=s.inputs,
            features=model.features,
            source=self.source,
            source_sha256=manifest.sources[self.source],
            made_from=manifest.read_by(self.source, s.inputs),
        )
        return metrics

    def _inputs(self) -> Tensor:
        """(n, F + s): features, then the inputs' scores."""
        drafts = self.recording.losses(self.source)
        scores = np.stack([drafts.scores[name] for name in self.settings.inputs], 1)
        both = [self.features.astype(np.float32), np.maximum(scores, FLOOR).astype(np.float32)]
        return torch.from_numpy(np.concatenate(both, 1))

    def _held_out(self, episodes: np.ndarray) -> Tensor:
        """(n,) bool: a random share of the episodes."""
        count = int(episodes.max()) + 1
        chosen = np.random.default_rng(self.settings.seed).permutation(count)[: round(count * self.settings.held_out)]
        return torch.from_numpy(np.isin(episodes, chosen))
