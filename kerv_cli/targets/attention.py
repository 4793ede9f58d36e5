"""The key/value cache of a trunk, attention and its masks, rotary position embeddings, and CUDA graphs of a forward.

A slot of the cache holds the keys and values of one token.

Shapes: B batch, T new tokens, S cached tokens, A attention heads, C channels of a head. In a cache, A counts only the
heads of keys and values.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from kerv_cli.engine.draft import upload
from kerv_cli.engine.protocol import Seen


class Cache:
    """The keys and values of all tokens that a trunk has processed, for every layer.

    Args:
        heads: A, number of heads.
        channels: C, channels of a head.
        like: Tensor whose device and number format the cache gets.

    Attributes:
        fixed: Whether every forward attends to all slots, and a mask hides the unused ones. All shapes are then fixed,
            as CUDA graphs require.
        buffer: (layers, 2, B, A, slots, C) keys and values. A fixed cache has a spare slot after its capacity.
        layers: (2, B, A, slots, C) per layer, views of the buffer.
        length: Number of cached tokens. They are in the first slots.
        copied: Number of first slots whose copies are in the memory that `copies` returns. Only the first `length`
            copies are valid.
    """

    fixed = False

    def __init__(self, layers: int, batch: int, heads: int, capacity: int, channels: int, like: Tensor) -> None:
        slots = capacity + self.fixed  # a spare slot, for the unused rows of a CUDA graph
        self.buffer = like.new_zeros((layers, 2, batch, heads, slots, channels))
        self.layers = list(self.buffer)  # (2, B, A, slots, C): keys, values
        self.capacity = capacity
        self.length = self.copied = 0
        self._copies: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def copies(self, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
        """Return the memory in which compiled programs keep copies of keys and values, in panels of `width` numbers.

        Returns:
            The buffer, the keys (layers, B · A, panels, C, width), the values (layers, B · A, panels, slots, width),
                and how many leading slots are filled.
        """
        if self._copies is None:
            layers, _, batch, heads, slots, channels = self.buffer.shape
            self._copies = (
                self.buffer.numpy(),
                np.empty((layers, batch * heads, -(-slots // width), channels, width), np.float32),
                np.empty((layers, batch * heads, -(-channels // width), slots, width), np.float32),
            )
        return *self._copies, min(self.copied, self.length)

    def compact(self, start: int, slots: Tensor) -> None:
        """Move the tokens of an accepted path to the slots start, start + 1, …, and drop the rest of the draft tree.

        Args:
            slots: (n,) slots of the kept tokens in increasing order, none before `start`.
        """
        n = slots.shape[0]
        if self._copies is not None:
            buffer = self._copies[0]  # numpy is faster for so few numbers
            buffer[..., start : start + n, :] = buffer.take(slots.numpy(), -2)
        else:
            self.buffer[..., start : start + n, :] = self.buffer.index_select(-2, slots)
        self.length, self.copied = start + n, min(self.copied, start)

    def next_slots(self, tokens: int) -> slice:
        self.copied = min(self.copied, self.length)
        return slice(self.length, self.length + tokens)


Slots = slice | Tensor | None  # that a forward writes to; indices (T,) if the cache has fixed shapes
Rotation = tuple[Tensor, Tensor]  # cosines and sines at the positions of T tokens


def attend(q: Tensor, k: Tensor, v: Tensor, cache: Tensor | None, slots: Slots, mask: Tensor | None) -> Tensor:
    """Return the attention's output (B, T, A · C) for T new tokens, and write their keys and values to the cache.

    Args:
        q: (B, A, T, C) queries of A heads.
        k: (B, A, T, C) keys.
        v: (B, A, T, C) values.
        cache: (2, B, A, slots, C) keys and values of this layer. None if there are no earlier tokens.
        mask: Result of `attention_mask`. If None, attention is causal.
    """
    causal = mask is None and q.shape[2] > 1
    if cache is not None and isinstance(slots, Tensor):
        cache[0].index_copy_(2, slots, k)
        cache[1].index_copy_(2, slots, v)
        k, v = cache
    elif cache is not None and isinstance(slots, slice):
        cache[0][:, :, slots] = k
        cache[1][:, :, slots] = v
        if slots.start:
            k, v = cache[:, :, :, : slots.stop]
    attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, is_causal=causal)
    return attended.transpose(1, 2).flatten(2)


def attention_mask(seen: Seen, tokens: int, cache: Cache | None, like: Tensor) -> Tensor | None:
    """Return the additive attention mask of new tokens: 0 for visible tokens, -inf for hidden tokens.

    Args:
        seen: (T, M) bool, which of the last M tokens each new token attends to. The last M tokens are the M − T newest
            cached tokens, then the T new tokens. Each new token also attends to all earlier cached tokens. If None,
            attention is causal. If it is a tensor, it must be on the device of `like`.
        tokens: T, number of new tokens.
        like: Tensor whose device and number format the mask gets.

    Returns:
        The mask (T, S + T) for S cached tokens, or (T, all slots) for a cache of fixed shapes. None if not needed.
    """
    cached, fixed = (cache.length, cache.fixed) if cache is not None else (0, False)
    stop = cached + tokens
    slots = cache.buffer.shape[-2] if cache is not None and fixed else stop
    if not isinstance(seen, Tensor):
        plain = (tokens == 1 or not cached) if seen is None else (tokens == 1 and seen.all())
        if plain and not fixed:
            return None
        seen = upload(np.tri(tokens, dtype=bool) if seen is None else seen, like.device)
    mask = like.new_zeros(tokens, slots)
    mask[:, stop - seen.shape[1] : stop].masked_fill_(~seen, -torch.inf)
    mask[:, stop:] = -torch.inf
    return mask


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Apply rotary position embedding.

    Args:
        x: (B, T, heads, C) queries or keys.
        cos: (T, 1, C) cosines of the positions.
        sin: (T, 1, C) sines. In the first half of the channels their sign is reversed.
    """
    return torch.addcmul(x * cos, x.roll(x.shape[-1] // 2, -1), sin)


SIZES = (1, 2, 4, 8, 16, 32, 64, 128)  # numbers of tokens for which graphs are captured, at the first forward of so few
_WARM_UP = 3  # runs before a capture, in which libraries choose kernels and allocate workspaces

# what a CUDA graph captures: `LayerStack.forwarded`
Compute = Callable[[Tensor, Tensor, Cache, Tensor, Tensor], Tensor]


class CapturedCache(Cache):
    """A key/value cache of fixed shapes, with CUDA graphs that run a forward through all layers in one launch.

    A graph takes a fixed number of tokens, its size. A forward of T tokens runs in the smallest graph that is large
    enough. The keys and values of unused tokens go to the spare slot, which no other token attends to. A forward of
    more than 128 tokens, such as a long prompt, runs without a graph, because capturing one would add to the episode's
    time. The batch size is 1. On a CPU the same computation runs without graphs, for tests.

    Attributes:
        head: Function that maps hidden states to logits. If set, the graphs also compute `predicted`.
        predicted: (1, T) the most probable next token after each token of the last forward of at most 128 tokens.
        steps: The graphs, by number of tokens. Empty before the first forward of at most 128 tokens.
    """

    fixed = True
    head: Callable[[Tensor], Tensor] | None = None
    predicted: Tensor | None = None

    def __init__(self, layers: int, heads: int, capacity: int, channels: int, like: Tensor) -> None:
        super().__init__(layers, 1, heads, capacity, channels, like)
        self.steps: dict[int, _Step] = {}

    def run(self, compute: Compute, x: Tensor, positions: Tensor, seen: Seen) -> Tensor:
        """Return the result (1, T, E) of `compute`, and set `predicted`.

        Args:
            x: (1, T, width) input of the first layer.
            positions: (T,) rotary positions.
            seen: (T, M) bool over the last M tokens, as in `attention_mask`. If None, attention is causal.
        """
        tokens = x.shape[1]
        # all at once, at the first forward of any size: later a capture would count in an episode's time
        self.steps = self.steps or {size: _Step(compute, self, size, x.shape[2]) for size in SIZES}
        if tokens > SIZES[-1]:
            slots = torch.arange(self.length, self.length + tokens, device=x.device)
            mask = attention_mask(seen, tokens, self, x)
            assert mask is not None
            self.predicted = None
            return compute(x, positions, self, slots, mask)
        hidden, self.predicted = self.steps[1 << (tokens - 1).bit_length()].run(x, positions, seen)
        return hidden


class _Step:
    """One graph. Four small copies fill its inputs. It computes slots and mask itself.

    Attributes:
        span: The number of cached tokens, of new tokens T, and of columns M of `seen` that are in use.
    """

    def __init__(self, compute: Compute, cache: CapturedCache, size: int, width: int) -> None:
        self.compute, self.cache = compute, cache
        like, slots = cache.buffer, cache.buffer.shape[-2]
        integers: dict[str, Any] = {"dtype": torch.long, "device": like.device}
        self.x, self.positions = like.new_zeros((1, size, width)), torch.zeros(size, **integers)
        self.seen = torch.zeros((size, slots), dtype=torch.bool, device=like.device)
        self.causal = torch.ones((size, size), dtype=torch.bool, device=like.device).tril_()
        self.span = torch.zeros(3, **integers)
        self.row, self.slot = torch.arange(size, **integers), torch.arange(slots, **integers)
        self.graph: torch.cuda.CUDAGraph | None = None
        if not like.is_cuda:
            return
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UP):
                self._compute()
        torch.cuda.current_stream().wait_stream(stream)
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph):
            self.out = self._compute()

    def _compute(self) -> tuple[Tensor, Tensor | None]:
        start, tokens, last = self.span.unbind()
        spare, stop, used = self.slot.shape[0] - 1, start + tokens, self.row < tokens
        column = self.slot - (stop - last)  # of `seen`; tokens before these are visible
        visible = self.seen[:, column.clamp(0, spare)] | (column < 0)
        # an unused row sees the spare slot only; if it saw nothing it would be NaN, which would spread to all others
        visible = torch.where(used[:, None], visible & (self.slot < stop), self.slot == spare)
        mask = torch.zeros_like(visible, dtype=self.x.dtype).masked_fill_(~visible, -torch.inf)
        slots = torch.where(used, start + self.row, spare)
        hidden, head = self.compute(self.x, self.positions, self.cache, slots, mask), self.cache.head
        return hidden, head(hidden).argmax(-1) if head is not None else None

    def run(self, x: Tensor, positions: Tensor, seen: Seen) -> tuple[Tensor, Tensor | None]:
        tokens = x.shape[1]
        if not isinstance(seen, Tensor):
            seen = self.causal[:tokens, :tokens] if seen is None else upload(seen, x.device)
        self.x[:, :tokens].copy_(x)
        self.positions[:tokens].copy_(positions)
        self.seen[:tokens, : seen.shape[1]].copy_(seen)
        self.span.copy_(upload([self.cache.length, tokens, seen.shape[1]], x.device))
        if self.graph is not None:
            self.graph.replay()
        hidden, predicted = self.out if self.graph is not None else self._compute()
        # copies: callers keep them, and the next forward in this graph overwrites the originals
        return hidden[:, :tokens].clone(), predicted[:, :tokens].clone() if predicted is not None else None
