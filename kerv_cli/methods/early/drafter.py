"""Train early drafters (docs/methods.md §5, ours). `network.py` drafts with them.

torch is imported only where a tensor is made, so that a plan can check drafters without it.

Shapes: F features of a pooled prompt, N tokens of a chunk, V bins, which are the possible tokens.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from kerv_cli.base.registry import NoSettings
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.methods.context import Context
from kerv_cli.methods.drafters import Decodes, Metrics, TrainableDrafter
from kerv_cli.methods.early import EarlySettings
from kerv_cli.worlds.demos.files import DemoEpisode

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from kerv_cli.methods.early.network import EarlyProposer


@dataclass(frozen=True)
class EarlyExamples(Decodes):
    """The n training examples of an early drafter: pooled prompts, and the target's tokens."""

    features: Tensor  # (n, F) float16, pooled prompts


class EarlyDrafter(TrainableDrafter):
    """Early drafters. They learn the target's greedy tokens, with labels spread over neighbouring bins."""

    kind, noun = "early", "early drafter"
    settings = EarlySettings

    def network(self, settings: Any, target: Any) -> nn.Module:
        from kerv_cli.methods.early.network import EarlyNetwork

        return EarlyNetwork(settings, target.actions, target.chunk, target.pooled_width)

    @classmethod
    def proposer(cls, settings: NoSettings, context: Context) -> EarlyProposer:
        from kerv_cli.methods.early.network import EarlyProposer

        return EarlyProposer(context.artifact(cls.kind), context.target)

    def decoded(
        self, target: Any, episode: DemoEpisode, steps: np.ndarray, space: ObservationSpace, columns: dict[str, Tensor]
    ) -> Decodes:
        import torch

        from kerv_cli.engine.decoder import greedy
        from kerv_cli.targets.observations import observations_of, prompts_of

        prompts = list(prompts_of(target, observations_of(target, episode, steps, space)))
        features = torch.cat([target.pooled(prompt).half().cpu() for prompt in prompts])
        tokens = torch.cat([greedy(target, prompt)[0].cpu() for prompt in prompts])
        return EarlyExamples(features=features, tokens=tokens, **columns)

    def prepare(self, network: Any, examples: Any) -> None:
        network.standardise(examples.features)

    def loss(self, network: Any, target: Any, batch: Any, step: int, settings: Any) -> tuple[Tensor, Metrics]:
        from kerv_cli.targets.losses import token_loss, within_chunk

        labels = _labels(target.actions, settings.train.label_sigma, target.device)
        tokens, end = batch.tokens.to(target.device), target.actions.end
        logits = network(batch.features.to(target.device).float())
        loss = token_loss(logits, tokens, labels, None if end is None else within_chunk(tokens, end))
        return loss, {"token_loss": float(loss.detach())}

    def validate(self, network: Any, target: Any, held_out: Any, settings: Any) -> Metrics:
        """Score: mean number of tokens accepted at radius 0, plus that at radius 9 (see `measure`)."""
        import torch

        batches = held_out.features.split(256)
        logits = torch.cat([network(batch.to(target.device).float()).cpu() for batch in batches])
        strict = torch.from_numpy(target.actions.strict_tokens(logits.shape[1]))
        metrics = measure(logits, held_out, strict, target.actions.end)
        return {"score": metrics["accepted_r9"] + metrics["accepted_strict"], **metrics}


@functools.lru_cache(maxsize=1)
def _labels(actions: ActionSpace, sigma: float, device: torch.device) -> Tensor:
    from kerv_cli.targets.losses import labels_of

    return labels_of(actions, sigma).to(device)


def measure(logits: Tensor, examples: Decodes, strict: Tensor, end: int | None = None) -> Metrics:
    """Estimate how many draft tokens would be accepted, at the acceptance radii 0, 3 and 9.

    A draft is accepted up to its first token that is not within the radius of the target's greedy token. This
    approximates relaxed acceptance, in which the target's later tokens depend on the accepted draft tokens.

    Args:
        logits: (n, N, V) of the drafter.
        strict: (N,) bool, tokens that must equal the target's.
        end: The token that ends a chunk. Tokens after it are not counted. None if chunks have no such token.

    Returns:
        For each radius the mean number of accepted tokens and the share of fully accepted drafts. Also the token
        accuracy. In each mean, perturbed episodes together weigh as much as all other episodes together.
    """
    import torch

    from kerv_cli.methods.early.network import choose
    from kerv_cli.targets.losses import within_chunk

    kinds = [mask for mask in (examples.perturbed, ~examples.perturbed) if mask.any()]

    def balanced(values: Tensor) -> float:
        return float(torch.stack([values.float()[mask].mean() for mask in kinds]).mean())

    metrics: Metrics = {}
    counted = within_chunk(examples.tokens, end)
    sizes = counted.sum(1)
    for name, r in {"strict": 0, "r3": 3, "r9": 9}.items():
        right = (choose(logits, r, strict)[0] - examples.tokens).abs() <= torch.where(strict, 0, r)
        accepted = (right & counted).long().cumprod(1).sum(1)
        metrics[f"accepted_{name}"] = balanced(accepted)
        metrics[f"whole_{name}"] = balanced(accepted == sizes)
    right = (logits.argmax(-1) == examples.tokens) & counted
    metrics["token_accuracy"] = balanced(right.sum(1) / sizes)
    return metrics
