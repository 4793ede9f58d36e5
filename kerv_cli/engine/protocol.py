"""The interface of a target: the policy that every decoding method runs on.

Shapes: B sequences in the batch (1 while decoding), P prompt tokens, T new tokens, E width, V action tokens.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

from kerv_cli.base.spaces import ActionSpace, Observation

if TYPE_CHECKING:
    import numpy as np
    import torch
    from torch import Tensor, nn

# attention mask (T, M) bool, or None if attention is causal; entry [i, j] says whether new token i attends to token j
# of the last M tokens, which are M − T cached ones and the T new ones; a target on a GPU may get a tensor
Seen: TypeAlias = "np.ndarray | Tensor | None"


class Cache(Protocol):
    """Keys and values of the tokens that the target has processed, one token per slot.

    Slots 0 … length − 1 of `capacity` are filled. `Target.forward` fills the next slots and raises `length`.
    """

    length: int
    capacity: int

    def compact(self, start: int, slots: Tensor) -> None:
        """Keep the accepted draft tokens and remove the rejected ones.

        The contents of the n `slots` move to the slots start … start + n − 1, and `length` becomes start + n.

        Args:
            start: First slot after the prompt and the committed tokens, which stay where they are.
            slots: Slots (n,) of the tokens to keep, increasing, none below `start`.
        """


class Target(Protocol):
    """A policy that decodes actions as tokens and verifies drafts.

    Attributes:
        actions: Action space: the DoFs, their limits, and the normalisation that the policy was trained with.
        chunk: Number H of control steps in a chunk, as in the policy's training.
        width: Width E of the embeddings and hidden states.
        max_prompt: Largest prompt length P, in tokens, that `encode` can return.
    """

    actions: ActionSpace
    chunk: int
    width: int
    max_prompt: int

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras whose images `encode` reads. No other camera is rendered."""

    @property
    def device(self) -> torch.device:
        """Device of the weights."""

    def encode(self, observation: Observation) -> Tensor:
        """Return the prompt's embeddings (1, P, E) for an observation. P may differ between observations.

        The hidden state of the prompt's last token predicts the chunk's first token.
        """

    def embed(self, tokens: Tensor) -> Tensor:
        """Return the embeddings (B, T, E) of action tokens (B, T) int64."""

    def new_cache(self, batch: int, capacity: int) -> Cache:
        """Return an empty cache for `batch` sequences of up to `capacity` tokens."""

    def forward(self, x: Tensor, positions: Tensor, cache: Any = None, seen: Seen = None) -> Tensor:
        """Process T new tokens that follow the cached ones, and return their hidden states (B, T, E).

        Args:
            x: Embeddings of the new tokens (B, T, E).
            positions: Position of each new token in the sequence (T,), for the positional encoding.
            cache: From `new_cache`. The new tokens attend to all cached tokens and are added to the cache. None if
                there are no earlier tokens.
            seen: Attention mask (T, T) bool: entry [i, j] says whether new token i attends to new token j. None if
                attention is causal.
        """

    def head(self, hidden: Tensor) -> Tensor:
        """Return the logits (..., V) over the action tokens for hidden states (..., E)."""


@runtime_checkable
class EncodesMany(Protocol):
    """A target that encodes several observations together, faster than one after the other."""

    def encode_many(self, observations: Sequence[Observation]) -> Tensor:
        """Return the prompts' embeddings (B, P, E) for B observations."""


@runtime_checkable
class ContinuesGreedily(Protocol):
    """A target that can decode several tokens autoregressively in a single, faster call."""

    def continue_greedily(self, token: int, count: int, cache: Any, end: int | None = None) -> list[int] | None:
        """Decode `count` tokens greedily. Afterwards the cache holds the same tokens as after `count` single forwards.

        Args:
            token: The last committed token. It is not in the cache yet.
            end: Token after which to stop. If None, all `count` tokens are decoded.

        Returns:
            The decoded tokens. None if the target, as it was loaded, cannot decode them in one call.
        """


@runtime_checkable
class PredictsTokens(Protocol):
    """A target that predicts the next tokens in one call, faster than with `embed`, `forward` and `head`."""

    def predict(self, tokens: Tensor, positions: Tensor, cache: Any, seen: Seen) -> tuple[Tensor, Tensor]:
        """Process T new tokens, as `Target.forward` does.

        Args:
            tokens: The new tokens (T,) int64.

        Returns:
            The most probable token after each new token, (T,) int64, and the hidden states (1, T, E) of the new tokens.
        """


@runtime_checkable
class JoinsDrafters(Protocol):
    """A target that can be compiled together with a drafter, and can enlarge a drafter as it was enlarged itself."""

    def join(self, function: Callable[..., Any], *shapes: tuple[int, ...], repeats: bool = False) -> Any:
        """Compile a function that calls modules of the target and of a compiled drafter.

        Return the compiled function. None if the target is not compiled.

        Args:
            function: Takes one float32 tensor per entry of `shapes`. The first dimension of each is 1, the batch size.
            repeats: Whether the program can run several times in one call. The outputs of each run are the inputs of
                the next, to decode or draft several tokens.
        """

    def enlarge(self, drafter: nn.Module) -> None:
        """Enlarge a drafter in place, if this target was enlarged together with its drafters (docs/methods.md §0.2)."""


class ReadableTarget(Target, Protocol):
    """A target that also describes its prompt and the shape of its layers, for drafters and the datastore.

    Attributes:
        segments: Map from the name of each part of the prompt, such as `vision`, to the positions of its tokens.
        pooled_width: Length F of the vectors that `pooled` returns.
        heads: Number of attention heads in each layer.
        feed_forward: Hidden width of each layer's feed-forward network.
    """

    segments: Mapping[str, slice]
    pooled_width: int
    heads: int
    feed_forward: int

    @property
    def layers(self) -> nn.ModuleList:
        """The decoder layers. Every forward reads all their matrices."""

    @property
    def dtype(self) -> torch.dtype:
        """Floating-point type of the weights."""

    def pooled(self, prompt: Tensor) -> Tensor:
        """Summarise each prompt (B, P, E) in one vector (B, F), which the early drafter reads before the prefill."""


class ParallelTarget(Target, Protocol):
    """A target that decodes all N tokens of a chunk at once. It cannot decode token by token.

    Attributes:
        parallel: Always True.
    """

    parallel: bool

    def parallel_pass(self, prompt: Tensor, cache: Any = None) -> Tensor:
        """Return the hidden states (B, N, E) that predict the chunk's N tokens, from one forward.

        Args:
            prompt: Embeddings of the prompts (B, P, E).
            cache: An empty cache with room for P + N tokens. If None, no cache is used.
        """
