"""What the decode loop needs of a target, and nothing else: implement it, and every method runs on your policy.

Shapes: B batch (1 while decoding), P prompt tokens, T new tokens, S cached tokens, E width, V action tokens.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from kerv_cli.spaces import ActionSpace, Observation


class Cache(Protocol):
    """The keys and values of what was forwarded, in buffers of one size.

    Slots 0 … length − 1 are valid. `forward` writes its new tokens behind them.
    """

    length: int
    capacity: int

    def compact(self, start: int, slots: Tensor) -> None:
        """Commit a path: move the entries at `slots` (n,), increasing and from `start` on, to start, start + 1, …;
        all others behind `start` are dropped."""


class Target(Protocol):
    """A policy that emits actions as tokens, one trunk forward per token when nothing is drafted.

    actions: its action space, with its own normalisation. chunk: H, control steps it was trained to decode at once.
    cameras: names of the images that `encode` reads; none are drawn otherwise. width: E. max_prompt: the longest prompt
    that `encode` returns.
    """

    @property
    def actions(self) -> ActionSpace: ...
    @property
    def chunk(self) -> int: ...
    @property
    def cameras(self) -> tuple[str, ...]: ...
    @property
    def width(self) -> int: ...
    @property
    def max_prompt(self) -> int: ...
    @property
    def device(self) -> torch.device: ...

    def encode(self, observation: Observation) -> Tensor:
        """The prompt's embeddings (1, P, E); P may differ from observation to observation. The state behind the
        prompt's last token predicts the chunk's first token."""

    def embed(self, tokens: Tensor) -> Tensor:
        """Action tokens (B, T) int64 -> (B, T, E)."""

    def new_cache(self, batch: int, capacity: int) -> Cache:
        """An empty cache for `capacity` tokens."""

    def forward(self, x: Tensor, positions: Tensor, cache: Any = None, seen: np.ndarray | None = None) -> Tensor:
        """Hidden states (B, T, E) of the new tokens x (B, T, E) at `positions` (T,), behind what the cache holds: one
        that `new_cache` gave, or None.

        seen (T, T) bool says which of the new tokens each new token sees; all of them see everything that is cached.
        None: each sees itself and the new ones before it.
        """

    def head(self, hidden: Tensor) -> Tensor:
        """(..., E) -> logits over the action tokens (..., V)."""


class ReadableTarget(Target, Protocol):
    """What drafters and the datastore know of a target besides: the prompt's parts, and the layers' shapes.

    segments: where the prompt's parts lie, by name. pooled_width: F. heads, feed_forward: of a layer. dtype: of the
    weights.
    """

    @property
    def segments(self) -> Mapping[str, slice]: ...
    @property
    def pooled_width(self) -> int: ...
    @property
    def heads(self) -> int: ...
    @property
    def feed_forward(self) -> int: ...
    @property
    def dtype(self) -> torch.dtype: ...

    def pooled(self, prompt: Tensor) -> Tensor:
        """prompt (B, P, E) -> (B, F): the prompt as one vector, which the early drafter reads."""
