"""A target that is no transformer: it needs only `kerv_cli/engine/protocol.py`.

Its hidden state is a sum over all that is visible, weighted by position, so a wrong mask, position or cache entry
changes its tokens: the tests of the decode loop run on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.spaces import ActionSpace, Group, Observation

SEVEN = ActionSpace(
    names=("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper"),
    groups=(Group("position", 3), Group("rotation", 3), Group("gripper", 1)),
    strict=("gripper",),
    control_hz=5.0,
    low=(-1.0,) * 7,
    high=(1.0,) * 7,
)
"""OpenVLA's action space."""


@dataclass
class MockCache:
    """One entry (E,) per slot."""

    entries: Tensor  # (B, capacity, E)
    length: int = 0

    @property
    def capacity(self) -> int:
        return self.entries.shape[1]

    def compact(self, start: int, slots: Tensor) -> None:
        self.length = start + len(slots)
        self.entries[:, start : self.length] = self.entries[:, slots]


class MockTarget:
    """Random weights; a prompt of one token per word of the instruction, and one more."""

    cameras, max_prompt, device = (), 12, torch.device("cpu")

    def __init__(self, actions: ActionSpace = SEVEN, chunk: int = 2, width: int = 8, seed: int = 0) -> None:
        self.actions, self.chunk, self.width = actions, chunk, width
        random = torch.Generator().manual_seed(seed)
        self.table, self.out = (torch.randn(actions.tokens, width, generator=random).double() for _ in range(2))

    def encode(self, observation: Observation) -> Tensor:
        felt = float(np.sum(observation.proprioception))
        rows = [felt, *(felt + len(word) for word in observation.instruction.split())]
        return torch.outer(torch.tensor(rows).double(), torch.arange(1.0, self.width + 1).double()).sin()[None]

    def embed(self, tokens: Tensor) -> Tensor:
        return self.table[tokens]

    def new_cache(self, batch: int, capacity: int) -> MockCache:
        return MockCache(torch.zeros(batch, capacity, self.width).double())

    def forward(
        self, x: Tensor, positions: Tensor, cache: MockCache | None = None, seen: np.ndarray | None = None
    ) -> Tensor:
        tokens = x.shape[1]
        cache = cache or self.new_cache(len(x), tokens)
        start, cache.length = cache.length, cache.length + tokens
        cache.entries[:, start : cache.length] = x * torch.cos(positions[:, None] * torch.arange(1.0, self.width + 1))
        new = np.tri(tokens) if seen is None else seen
        visible = torch.from_numpy(np.concatenate([np.ones((tokens, start)), new], 1))
        return visible @ cache.entries[:, : cache.length]

    def head(self, hidden: Tensor) -> Tensor:
        return (3 * hidden).sin() @ self.out.T
