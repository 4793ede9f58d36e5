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

    Slots 0 … length − 1 are valid. `forward` writes its new tokens after them and raises `length`.
    """

    length: int
    capacity: int

    def compact(self, start: int, slots: Tensor) -> None:
        """Commit a path: move the entries at `slots` to start, start + 1, … and set `length` to start + n.

        Args:
            start: First slot after the committed tokens.
            slots: The path's slots (n,), increasing, none before `start`.
        """


class Target(Protocol):
    """A policy that decodes actions as tokens."""

    @property
    def actions(self) -> ActionSpace:
        """Action space with the policy's own normalisation."""

    @property
    def chunk(self) -> int:
        """H, the control steps that it was trained to decode at once."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras whose images `encode` reads. No others are drawn."""

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
        """Return the prompt's embeddings (1, P, E). P may differ between observations.

        The hidden state of the prompt's last token predicts the chunk's first token.
        """

    def embed(self, tokens: Tensor) -> Tensor:
        """Return the embeddings (B, T, E) of action tokens (B, T) int64."""

    def new_cache(self, batch: int, capacity: int) -> Cache:
        """Return an empty cache for `capacity` tokens."""

    def forward(
        self, x: Tensor, positions: Tensor, cache: Any = None, seen: np.ndarray | Tensor | None = None
    ) -> Tensor:
        """Return the hidden states (B, T, E) of new tokens after the cached ones.

        Args:
            x: Embeddings of the new tokens (B, T, E).
            positions: Their positions (T,).
            cache: From `new_cache`, or None. All new tokens attend to every cached one.
            seen: Which new tokens each new token attends to, (T, T) bool; None if they are causal. An array, or on a
                GPU also a tensor.
        """

    def head(self, hidden: Tensor) -> Tensor:
        """Return the logits over the action tokens (..., V) of hidden states (..., E)."""


@runtime_checkable
class EncodesMany(Protocol):
    """A target that encodes several observations faster together than one after the other."""

    def encode_many(self, observations: Sequence[Observation]) -> Tensor:
        """Return the prompts (B, P, E) of B observations."""


@runtime_checkable
class ContinuesGreedily(Protocol):
    """A target that can decode several tokens in one call."""

    def continue_greedily(self, token: int, count: int, cache: Any) -> list[int] | None:
        """Decode `count` tokens after `token`, and append to the cache what single forwards would.

        Returns:
            The tokens; None if the target, as it is loaded, must forward one token after the other.
        """


class ReadableTarget(Target, Protocol):
    """A target whose prompt has named parts and whose layers have known shapes, for drafters and the datastore."""

    @property
    def segments(self) -> Mapping[str, slice]:
        """Name of a part of the prompt -> its slice."""

    @property
    def pooled_width(self) -> int:
        """F of `pooled`."""

    @property
    def heads(self) -> int:
        """Number of attention heads of a layer."""

    @property
    def feed_forward(self) -> int:
        """Hidden width of a layer's feed-forward part."""

    @property
    def dtype(self) -> torch.dtype:
        """Number format of the weights."""

    def pooled(self, prompt: Tensor) -> Tensor:
        """Return the prompts (B, P, E) as one vector each, (B, F): the input of the early drafter."""


class ParallelTarget(Target, Protocol):
    """A target that decodes all N tokens of a chunk at once, and only so."""

    @property
    def parallel(self) -> bool:
        """True."""

    def parallel_pass(self, prompt: Tensor, cache: Any = None) -> Tensor:
        """Return the hidden states (B, N, E) of the chunk's tokens, in one forward.

        Args:
            prompt: (B, P, E).
            cache: An empty one with room for P + N tokens, or None.
        """
