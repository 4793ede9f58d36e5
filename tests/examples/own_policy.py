"""Example: plug in a policy that has no cache. It stands for any model that can be called with embeddings, positions
and a mask; the cache stores what was forwarded and every forward computes all of it anew. Slow, but every method runs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from kerv_cli.base.spaces import ActionSpace, Observation
from kerv_cli.targets import TargetPart
from kerv_cli.targets.checkpoint import TargetDescription, load_state, save_module, target_fields
from kerv_cli.targets.settings import BuildTargetSettings
from kerv_cli.worlds.metaworld.spec import SPEC


class Remembered:
    """What was forwarded: embeddings (B, capacity, E), positions and who sees whom."""

    def __init__(self, batch: int, capacity: int, width: int) -> None:
        self.x, self.positions = torch.zeros(batch, capacity, width), torch.zeros(capacity, dtype=torch.long)
        self.seen, self.length, self.capacity = np.zeros((capacity, capacity), dtype=bool), 0, capacity

    def compact(self, start: int, slots: Tensor) -> None:
        self.length = start + len(slots)
        self.x[:, start : self.length], self.positions[start : self.length] = self.x[:, slots], self.positions[slots]
        self.seen[start : self.length] = np.tri(self.capacity, dtype=bool)[start : self.length]


class OwnPolicy(nn.Module):
    """The `Target` protocol around a model. Here: one layer of attention with random weights."""

    cameras, max_prompt, device, chunk, width = (), 16, torch.device("cpu"), 1, 32
    table: Tensor
    rows: Tensor
    turn: Tensor

    def __init__(self, actions: ActionSpace = SPEC.actions) -> None:
        super().__init__()
        random, shape = torch.Generator().manual_seed(0), (actions.tokens, self.width)
        self.actions = actions
        for name, size in {"table": shape, "rows": shape, "turn": shape[1:]}.items():
            self.register_buffer(name, torch.randn(size, generator=random))

    def model(self, x: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """x (B, T, E), positions (T,), mask (T, T) bool -> (B, T, E). Yours instead."""
        placed = x + torch.outer(positions.float(), self.turn).sin()
        return torch.nn.functional.scaled_dot_product_attention(placed, placed, x, attn_mask=mask, scale=0.05) + x

    def encode(self, observation: Observation) -> Tensor:
        felt = torch.tensor([float(np.sum(observation.proprioception)), *map(len, observation.instruction.split())])
        return torch.outer(felt[: self.max_prompt] + 1, self.turn).cos()[None]

    def embed(self, tokens: Tensor) -> Tensor:
        return self.table[tokens]

    def new_cache(self, batch: int, capacity: int) -> Remembered:
        return Remembered(batch, capacity, self.width)

    def forward(
        self, x: Tensor, positions: Tensor, cache: Remembered | None = None, seen: np.ndarray | None = None
    ) -> Tensor:
        cache = cache or self.new_cache(len(x), x.shape[1])
        start, stop = cache.length, cache.length + x.shape[1]
        cache.x[:, start:stop], cache.positions[start:stop], cache.length = x, positions, stop
        cache.seen[start:stop, :start] = True  # every new token sees all that was committed
        cache.seen[start:stop, start:stop] = np.tri(stop - start, dtype=bool) if seen is None else seen
        mask = torch.from_numpy(cache.seen[:stop, :stop])
        return self.model(cache.x[:, :stop], cache.positions[:stop], mask)[:, start:]

    def head(self, hidden: Tensor) -> Tensor:
        return hidden @ self.rows.T


def write(settings: BuildTargetSettings, folder: Path) -> dict[str, Any]:
    """`kerv build target target=own`: here random weights; yours are those in `settings.checkpoint`."""
    policy = OwnPolicy()
    fields = target_fields("own", {"chunk": policy.chunk}, SPEC.name, policy.actions, SPEC.observation)
    save_module(folder, "target", policy, fields)
    return {"action tokens": policy.actions.tokens}


@TargetPart("own", importer=write)
def build(folder: Path, description: TargetDescription, device: str, dtype: torch.dtype) -> OwnPolicy:
    """What every command calls that decodes."""
    policy = OwnPolicy(description.actions)
    load_state(policy, folder, "target")
    return policy
