"""The protocol of a target: every decoding method runs on a policy that implements it.

Shapes: B batch (1 while decoding), P prompt tokens, T new tokens, S cached tokens, E width, V action tokens.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.spaces import ActionSpace, Observation


class Cache(Protocol):
    """The keys and values of forwarded tokens, in buffers of `capacity` slots.

    Slots 0 … length − 1 are valid. `forward` writes its new tokens behind them.
    """

    length: int
    capacity: int

    def compact(self, start: int, slots: Tensor) -> None:
        """Commits a path: moves the entries at `slots` (n,), increasing and from `start` on, to start, start + 1, … and
        sets the length behind them."""


class Target(Protocol):
    """A policy that decodes actions as tokens; without drafts every token takes one forward."""

    @property
    def actions(self) -> ActionSpace:
        """Action space with the policy's own normalisation."""

    @property
    def chunk(self) -> int:
        """H, control steps it was trained to decode at once."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras whose images `encode` reads; no others are drawn."""

    @property
    def width(self) -> int:
        """E."""

    @property
    def max_prompt(self) -> int:
        """Largest P that `encode` returns."""

    @property
    def device(self) -> torch.device:
        """Device of the weights."""

    def encode(self, observation: Observation) -> Tensor:
        """The prompt's embeddings (1, P, E); P may differ from observation to observation. The state behind the
        prompt's last token predicts the chunk's first token."""

    def embed(self, tokens: Tensor) -> Tensor:
        """Action tokens (B, T) int64 -> (B, T, E)."""

    def new_cache(self, batch: int, capacity: int) -> Cache:
        """An empty cache for `capacity` tokens."""

    def forward(
        self, x: Tensor, positions: Tensor, cache: Any = None, seen: np.ndarray | Tensor | None = None
    ) -> Tensor:
        """Hidden states (B, T, E) of the new tokens x (B, T, E) at `positions` (T,), behind the cached ones. cache:
        from `new_cache`, or None.

        seen (T, T) bool says which of the new tokens each new token attends to; all attend to every cached one. None:
        the new tokens are causal. It is an array; on another device than a CPU it may be a tensor there.
        """

    def head(self, hidden: Tensor) -> Tensor:
        """hidden (..., E) -> logits over the action tokens (..., V)."""


@runtime_checkable
class EncodesMany(Protocol):
    """A target that encodes several observations faster than one after the other."""

    def encode_many(self, observations: Sequence[Observation]) -> Tensor:
        """The prompts (B, P, E) of B observations."""


class ReadableTarget(Target, Protocol):
    """A target whose prompt has named parts and whose layers have known shapes; drafters and the datastore read
    them."""

    @property
    def segments(self) -> Mapping[str, slice]:
        """Slice of the prompt by the name of its part."""

    @property
    def pooled_width(self) -> int:
        """F of `pooled`."""

    @property
    def heads(self) -> int:
        """Attention heads of a layer."""

    @property
    def feed_forward(self) -> int:
        """Hidden width of a layer's feed-forward part."""

    @property
    def dtype(self) -> torch.dtype:
        """Number format of the weights."""

    def pooled(self, prompt: Tensor) -> Tensor:
        """prompt (B, P, E) -> (B, F): the prompt as one vector, the input of the early drafter."""


class ParallelTarget(Target, Protocol):
    """A target that was trained to decode all N tokens of a chunk at once, and only so."""

    @property
    def parallel(self) -> bool:
        """True."""

    def parallel_pass(self, prompt: Tensor, cache: Any = None) -> Tensor:
        """prompt (B, P, E) -> hidden states (B, N, E) of the chunk's tokens, in one forward. cache: an empty one with
        room for P + N tokens."""
