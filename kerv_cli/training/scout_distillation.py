"""Training a scout on the frozen target's greedy decodes and on the positions that it estimates (docs/methods.md §5.1).

Nothing privileged is read: neither the expert's actions nor the simulator's positions, only what the target says of an
observation. The first `scene_steps` train the stem and its positions alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kerv_cli.engine.batched import greedy
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.methods.early.drafter import EarlyDrafter
from kerv_cli.methods.scout import ScoutSettings
from kerv_cli.methods.scout.drafter import Scout, ScoutArtifact, check_sees
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.losses import position_loss
from kerv_cli.targets.observations import BATCH, Observations, read_observations, split
from kerv_cli.training.early_distillation import Decodes, EarlyDistillation, columns_of, evenly, share_of
from kerv_cli.training.loop import Metrics
from kerv_cli.training.settings import TrainDrafterSettings
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress


@dataclass(frozen=True)
class ScoutSamples(Observations, Decodes):
    """What a scout learns from: observations, and what the target says of them."""

    places: Tensor  # (n, K, 3) float32, metres


@torch.inference_mode()
def teach_scout(
    target: CompactTarget, dataset: DemoDataset, settings: ScoutSettings, on_progress: OnProgress
) -> ScoutSamples:
    """The target's decodes and positions for about `settings.samples` observations, spread evenly over all episodes.

    Raises:
        CheckpointError: a demonstration's frames are not of the size that the target takes.
    """
    share = share_of(dataset, settings.samples, framed=True)
    parts: list[ScoutSamples] = []
    for index in range(len(dataset.episodes)):
        episode = dataset.load(index)
        chosen = evenly(np.arange(len(episode.frame_steps)), share)
        rows = read_observations(episode, target.settings, target.observation, target.words, chosen)
        columns = columns_of(episode, index, len(rows))
        tokens, places = [], []
        for indices in torch.arange(len(rows)).split(BATCH):
            prompt, located = target.encode_batch(rows.inputs(indices, target.device))
            tokens.append(greedy(target, prompt)[0].cpu())
            places.append(located.float().cpu())
        parts.append(ScoutSamples(**(vars(rows) | columns), tokens=torch.cat(tokens), places=torch.cat(places)))
        on_progress(index + 1, len(dataset.episodes))
    return ScoutSamples.joined(parts)


class ScoutDistillation(EarlyDistillation):
    """Loss and validation of one run: those of an early drafter, and the positions."""

    def drafter(self, module: Scout) -> EarlyDrafter:
        """The network behind the scout's eyes."""
        return module.drafter

    def outputs(self, module: Scout, samples: ScoutSamples, indices: Tensor) -> tuple[Tensor, ...]:
        """Logits (B, N, V) and positions (B, K, 3) for the samples at `indices` (B,)."""
        return module(samples.inputs(indices, self.device))

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """The token loss and the weighted position loss at `indices` (B,)."""
        labels = self.training.places[indices].to(self.device)
        if step < self.train.scene_steps:
            loss = position_loss(self.module.see(self.training.inputs(indices, self.device))[1], labels)
            return loss, {"position_loss": float(loss.detach())}
        logits, places = self.outputs(self.module, self.training, indices)
        token, position = self.token_loss(logits, indices), position_loss(places, labels)
        metrics = {"token_loss": float(token.detach()), "position_loss": float(position.detach())}
        return token + self.train.scene_weight * position, metrics

    def further_metrics(self, *outputs: Tensor) -> Metrics:
        """Median errors of the positions."""
        error = (outputs[0] - self.held_out.places).norm(dim=-1).median(0).values
        names = [place.name.replace(" ", "_") for place in self.module.observation.places]
        return {f"{name}_error_cm": 100 * float(e) for name, e in zip(names, error, strict=True)}


class ScoutTraining:
    """`kerv train drafter drafter=scout`, for a target that sees."""

    artifact = ScoutArtifact()

    def objective(
        self, target: ReadableTarget, dataset: DemoDataset, settings: TrainDrafterSettings, progress: OnProgress
    ) -> ScoutDistillation:
        """Decode the demonstrations with the target and make a fresh scout."""
        seeing = check_sees(target)
        samples = teach_scout(seeing, dataset, settings.drafter, progress)
        training, held_out = split(samples, settings.train.held_out)
        torch.manual_seed(settings.train.seed)
        scout = Scout.beside(settings.drafter, seeing).to(target.device)
        return ScoutDistillation(scout, training, held_out, settings.train)
