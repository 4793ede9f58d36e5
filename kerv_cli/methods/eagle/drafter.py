"""Train and load EAGLE-style drafters (docs/methods.md §2.2; EAGLE-2; Spec-VLA §3). `network.py` drafts with them.

torch is imported only where a tensor is made, so that a plan can check drafters without it.

Shapes: P prompt tokens, N tokens of a chunk, E width of the target.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import ObservationSpace
from kerv_cli.engine.protocol import JoinsDrafters, ReadableTarget
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.context import Context
from kerv_cli.methods.drafters import Decodes, Metrics, TrainableDrafter
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.worlds.demos.files import DemoEpisode

if TYPE_CHECKING:
    from torch import Tensor

    from kerv_cli.methods.eagle.network import DrafterProposer, EagleNetwork

VALIDATED = 60  # maximum number of held-out observations that a validation decodes


@dataclass(frozen=True)
class EagleExamples(Decodes):
    """The n training examples of an EAGLE-style drafter. Shorter prompts are padded with zeros.

    Attributes:
        lengths: (n,) int64, number of prompt tokens P.
        prompt: (n, longest prompt, E) float16, encoded prompts.
        hidden: (n, longest prompt + N − 1, E) float16, hidden states of the target's last layer.
    """

    lengths: Tensor
    prompt: Tensor
    hidden: Tensor


class EagleDrafter(TrainableDrafter):
    """EAGLE-style drafters, which are artifacts of the kind `drafter`. They work for chunks of any length."""

    kind = noun = "drafter"
    command = ("train", "drafter")
    settings = DrafterSettings
    any_chunk = True

    def network(self, settings: DrafterSettings, target: ReadableTarget) -> EagleNetwork:
        from kerv_cli.methods.eagle.network import EagleNetwork

        return EagleNetwork(settings, target.width, target.heads, target.feed_forward)

    def load(self, path: Path, artifacts: Artifacts) -> EagleNetwork:
        network: EagleNetwork = super().load(path, artifacts)
        if isinstance(artifacts.target, JoinsDrafters):
            artifacts.target.enlarge(network)
        return network

    @classmethod
    def proposer(cls, settings: Any, context: Context) -> DrafterProposer:
        from kerv_cli.methods.eagle.network import DrafterProposer

        tokens = context.target.actions.tokens
        if settings.shape == "tree" and settings.top_k > tokens:
            raise UsageError(f"proposer.top_k={settings.top_k}: the target has only {tokens} action tokens")
        top_k, nodes = (settings.top_k, settings.nodes) if settings.shape == "tree" else (1, settings.depth)
        return DrafterProposer(context.artifact(cls.kind), context.target, settings.depth, top_k, nodes)

    def decoded(
        self, target: Any, episode: DemoEpisode, steps: np.ndarray, space: ObservationSpace, columns: dict[str, Tensor]
    ) -> EagleExamples:
        import torch
        import torch.nn.functional as F

        from kerv_cli.engine.decoder import greedy
        from kerv_cli.targets.observations import observations_of, prompts_of

        lengths, kept = [], []
        for prompt in prompts_of(target, observations_of(target, episode, steps, space)):
            tokens, hidden = greedy(target, prompt)
            lengths += [prompt.shape[1]] * len(prompt)
            zeros = 0, 0, 0, target.max_prompt - prompt.shape[1]
            kept.append((tokens.cpu(), *(F.pad(x, zeros).half().cpu() for x in (prompt, hidden))))
        tokens, prompts, hidden = map(torch.cat, zip(*kept, strict=True))
        return EagleExamples(tokens, **columns, lengths=torch.tensor(lengths), prompt=prompts, hidden=hidden)

    def loss(
        self, network: EagleNetwork, target: Any, batch: EagleExamples, step: int, settings: Any
    ) -> tuple[Tensor, Metrics]:
        import torch

        losses: list[Tensor] = []
        metrics: Metrics = {}
        for length in batch.lengths.unique().tolist():
            rows = batch.where(batch.lengths == length)
            loss, measured = self.unrolled(network, target, rows, length, settings.drafter)
            losses.append(loss * len(rows) / len(batch))
            metrics |= measured
        return torch.stack(losses).sum(), metrics

    def unrolled(
        self, network: EagleNetwork, target: Any, rows: EagleExamples, length: int, settings: DrafterSettings
    ) -> tuple[Tensor, Metrics]:
        """Return the loss and the metrics to log, for B examples with prompts of one length.

        The first pass reads the target's hidden states. Later passes read the drafter's own predictions, as drafting
        does. A pass's loss is the weighted sum of the smooth L1 loss of the states and the cross-entropy of the
        drafter's token distribution with the target's. The result is the mean over passes.
        """
        import torch
        import torch.nn.functional as F

        device = target.device
        tokens = rows.tokens.to(device)
        prompt = rows.prompt[:, :length].to(device).float()
        hidden = rows.hidden[:, : length + tokens.shape[1] - 1].to(device).float()
        following = torch.cat([prompt[:, 1:], target.embed(tokens[:, :-1])], 1)
        positions = torch.arange(hidden.shape[1] - 1, device=device)
        total, metrics = hidden.new_zeros(()), {}
        # with an end token, only the positions before it are compared
        counted = (tokens[:, :-1] == target.actions.end).cumsum(1) == 0 if target.actions.code else None
        inputs = hidden[:, :-1]
        for number in range(settings.unroll):
            predicted = network(following, inputs, positions)
            guessed, states = predicted[:, length - 1 :], hidden[:, length:]  # of the chunk's tokens 1 to N − 1
            if counted is not None:
                guessed, states = guessed[counted], states[counted]
            teacher = target.head(states.to(target.dtype)).float()
            logits = target.head(guessed.to(target.dtype)).float()
            token_loss = -(teacher.softmax(-1) * F.log_softmax(logits, -1)).sum(-1).mean()
            state_loss = F.smooth_l1_loss(guessed, states)
            total = total + settings.state_weight * state_loss + settings.token_weight * token_loss
            metrics[f"token_loss_{number}"] = float(token_loss.detach())
            # after the first drafted position the next pass reads its own predictions, as in drafting
            inputs = torch.cat([inputs[:, :length], predicted[:, length - 1 : -1]], 1)
        return total / settings.unroll, metrics

    def validate(self, network: EagleNetwork, target: Any, held_out: EagleExamples, settings: Any) -> Metrics:
        import torch

        from kerv_cli.methods.eagle.network import acceptance_length

        chosen = torch.linspace(0, len(held_out) - 1, min(VALIDATED, len(held_out))).long().tolist()
        prompts = [held_out.prompt[i, : held_out.lengths[i]][None].to(target.device, target.dtype) for i in chosen]
        loaded = copy.deepcopy(network).to(target.dtype)
        strict, relaxed = (acceptance_length(target, loaded, prompts, r) for r in (0, 9))
        return {"score": relaxed + strict, "acceptance_length_strict": strict, "acceptance_length_r9": relaxed}
