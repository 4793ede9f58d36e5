"""The early drafter: network and proposer (docs/methods.md §5, ours).

Shapes: B prompts, F features of a pooled prompt, N tokens of a chunk, V bins, which are the possible tokens.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.draft import HOST, read, upload
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.engine.protocol import JoinsDrafters, ReadableTarget
from kerv_cli.methods.early import EarlySettings
from kerv_cli.targets.compact.program import Compilable, Program

# the drafter is sure of a chunk if it estimates at least this probability that all tokens are accepted; the estimate is
# too low: 89 % of such chunks were accepted whole (mt10-vision, radius 9)
SURE = 0.05


class Block(nn.Module):
    """Residual SwiGLU block with a norm before it. A plain MLP block with as many weights was worse."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.RMSNorm(width, eps=1e-5)
        self.gate_up = nn.Linear(width, 2 * width)
        self.down = nn.Linear(width, width)
        nn.init.zeros_(self.down.weight)

    def forward(self, x: Tensor) -> Tensor:
        gate, up = self.gate_up(self.norm(x)).chunk(2, -1)
        return x + self.down(F.silu(gate) * up)


class EarlyNetwork(Compilable):
    """A residual network from the pooled prompt to a few features per token. One head computes logits from them."""

    mean: Tensor  # (F,) mean of the training features
    scale: Tensor  # (F,) 1 / standard deviation of the training features
    strict: Tensor  # (N,) bool, tokens that must equal the target's, such as the gripper's
    compiled: Program | None

    def __init__(self, settings: EarlySettings, actions: ActionSpace, chunk: int, features: int) -> None:
        super().__init__()
        self.settings, self.actions, self.chunk = settings, actions, chunk
        self.tokens = actions.longest(chunk)
        # the prompt's features differ in size by orders of magnitude
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("scale", torch.ones(features))
        self.register_buffer("strict", torch.from_numpy(actions.strict_tokens(self.tokens)), persistent=False)
        self.enter = nn.Linear(features, settings.width)
        self.blocks = nn.ModuleList(Block(settings.width) for _ in range(settings.layers))
        self.norm = nn.RMSNorm(settings.width, eps=1e-5)
        self.spread = nn.Linear(settings.width, self.tokens * settings.rank)
        self.head = nn.Linear(settings.rank, actions.tokens)

    def new_program(self) -> Program:
        return Program(self.logits, (1, len(self.mean)))

    def standardise(self, features: Tensor) -> None:  # (n, F) training features
        self.mean.copy_(features.float().mean(0))
        self.scale.copy_(1.0 / features.float().std(0).clamp_min(1e-3))

    def forward(self, features: Tensor) -> Tensor:
        return self.compiled(features)[0] if self.compiled and self.runs_compiled(features) else self.logits(features)

    def logits(self, features: Tensor) -> Tensor:
        """Return the logits (B, N, V) for pooled prompts (B, F), by the PyTorch modules."""
        x = self.enter((features - self.mean) * self.scale)
        for block in self.blocks:
            x = block(x)
        return self.head(self.spread(self.norm(x)).unflatten(-1, (self.tokens, self.settings.rank)))

    @torch.inference_mode()
    def draft(self, features: Tensor, radius: int) -> Tensor:
        """Draft chunks for pooled prompts (B, F) and an acceptance radius in bins.

        Returns (B, N + 1) float64 on the device: the N tokens, then the estimated probability that all are accepted.
        """
        tokens, odds = choose(self(features.to(self.head.weight.dtype)), radius, self.strict)
        return torch.cat([tokens.double(), odds.double()[:, None]], -1)


def choose(logits: Tensor, radius: int, strict: Tensor) -> tuple[Tensor, Tensor]:
    """Choose the tokens that are most likely to be accepted, and estimate the probability that all are accepted.

    The chosen bin has the most probability within `radius` bins around it. Of about equally good bins, the one with
    more probability close by wins, because it is likely nearer to the target's token. For a strict token, the most
    probable bin is chosen. The estimate treats tokens as independent, so it is too low: use it only to compare chunks.

    Args:
        logits: (B, N, V).
        radius: Acceptance radius, in bins.
        strict: (N,) bool, whether the token must equal the target's, as the gripper's must.

    Returns:
        The tokens (B, N), and the estimates (B,).
    """
    probability = logits.float().softmax(-1)
    below = F.pad(probability, (radius + 1, radius)).cumsum(-1)  # one cumulative sum for both radii
    near, best = _between(below, radius, radius, logits.shape[-1]), logits.argmax(-1)
    tokens = best
    if radius:
        score = near + 0.1 * _between(below, radius, radius // 3, logits.shape[-1]) + 0.05 * probability
        tokens = torch.where(strict, best, score.argmax(-1))
    exact, within = (of.gather(-1, tokens[..., None])[..., 0] for of in (probability, near))
    return tokens, torch.where(strict, exact, within).prod(-1)


def _between(below: Tensor, pad: int, radius: int, bins: int) -> Tensor:
    return below[..., pad + radius + 1 :][..., :bins] - below[..., pad - radius :][..., :bins]


class EarlyProposer(ChainProposer):
    """Drafts chunks with the early drafter (docs/methods.md §5), once per observation."""

    name = "early"

    def __init__(self, early: EarlyNetwork, target: ReadableTarget) -> None:
        self.early, self.target = early, target
        self.compiled = self.compile()
        self._drafted: tuple[Chunk, list[int], float] | None = None  # the last chunk, its draft, and the estimate

    def compile(self) -> Program | None:
        """Return a compiled program that computes the result of `row` from a radius (1, 1) and a prompt.

        None if the drafter is not compiled, or if drafter and target cannot be compiled together.
        """
        early: Any = self.early
        target: Any = self.target

        def row(radius: Tensor, prompt: Tensor) -> Any:
            return early.logits(target.pooled(prompt)).choose(radius, early.strict)

        joins = isinstance(target, JoinsDrafters) and isinstance(getattr(early, "compiled", None), Program)
        return target.join(row, (1, 1), (1, target.max_prompt, target.width)) if joins else None

    def drafted(self, chunk: Chunk) -> tuple[list[int], float]:
        if self._drafted is None or self._drafted[0] is not chunk:
            numbers = read(self.row(chunk, max(chunk.limits, default=0)))[0]
            self._drafted = chunk, numbers[:-1].astype(np.int64).tolist(), float(numbers[-1])
        return self._drafted[1:]

    def row(self, chunk: Chunk, radius: int) -> Tensor:
        """Draft a chunk for an acceptance radius in bins: (N + 1,), the result of `EarlyNetwork.draft`."""
        if self.compiled is not None:
            return self.compiled(upload([[radius]], HOST), chunk.target.prompt)[0][0]
        return self.early.draft(self.target.pooled(chunk.target.prompt), radius)[0]

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        return [self.drafted(chunk)[0][len(chunk.tokens) : chunk.size][:depth]]

    def is_sure(self, chunk: Chunk) -> bool:
        return self.drafted(chunk)[1] >= SURE
