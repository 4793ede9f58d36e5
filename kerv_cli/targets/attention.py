"""The key/value cache of a trunk, attention and its masks, rotary position embeddings, and CUDA graphs of a forward.

A slot of the cache holds the keys and values of one token.

Shapes: B batch, T new tokens, S cached tokens, A attention heads, C channels of a head. In a cache, A counts only the
heads of keys and values.
"""

from __future__ import annotations

from collections.abc import Callable

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
        self._copies: tuple[np.ndarray, np.ndarray] | None = None

    def copies(self, width: int) -> tuple[np.ndarray, np.ndarray, int]:
        """Return the memory in which compiled programs keep copies of keys and values, in panels of `width` numbers.

        Returns:
            The keys (layers, B · A, panels, C, width), the values (layers, B · A, panels, slots, width), and how many
                leading slots are filled.
        """
        if self._copies is None:
            layers, _, batch, heads, slots, channels = self.buffer.shape
            self._copies = (
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

# what a CUDA graph captures: `LayerStack.run_layers`
Compute = Callable[[Tensor, Tensor, Cache, Tensor, Tensor], Tensor]


class CapturedCache(Cache):
    """A key/value cache of fixed shapes, with CUDA graphs that run a forward through all layers in one launch.

    A graph takes a fixed number of tokens, its size. A forward of T tokens runs in the smallest graph that is large
    enough. The unused tokens have zeros as input. Their keys and values go to the spare slot, which no other token
    attends to. A forward of more than 128 tokens, such as a long prompt, runs without a graph, because capturing one
    would add to the episode's time. The batch size is 1. On a CPU the same computation runs without graphs, for tests.

    Attributes:
        steps: The graphs, by number of tokens. Empty before the first forward of at most 128 tokens.
    """

    fixed = True

    def __init__(self, layers: int, heads: int, capacity: int, channels: int, like: Tensor) -> None:
        super().__init__(layers, 1, heads, capacity, channels, like)
        self.steps: dict[int, _Step] = {}

    def run(self, compute: Compute, x: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """Return the last layer's output (1, T, width), which the next forward in the same graph overwrites.

        Args:
            x: (1, T, width) input of the first layer.
            positions: (T,) rotary positions.
            mask: (T, slots) result of `attention_mask`.
        """
        tokens = x.shape[1]
        # all at once, at the first forward of any size: later a capture would count in an episode's time
        self.steps = self.steps or {size: _Step(compute, self, size, x.shape[2]) for size in SIZES}
        if tokens > SIZES[-1]:
            slots = torch.arange(self.length, self.length + tokens, device=x.device)
            return compute(x, positions, self, slots, mask)
        return self.steps[1 << (tokens - 1).bit_length()].run(x, positions, mask)


class _Step:
    def __init__(self, compute: Compute, cache: Cache, size: int, width: int) -> None:
        self.compute, self.cache = compute, cache
        like, slots = cache.buffer, cache.buffer.shape[-2]
        self.x = like.new_zeros((1, size, width))
        self.positions = torch.zeros(size, dtype=torch.long, device=like.device)
        self.index = torch.full((size,), slots - 1, dtype=torch.long, device=like.device)
        self.mask = like.new_full((size, slots), -torch.inf)
        self.mask[:, -1] = 0.0  # a row that attends to nothing would be NaN, which would spread to all others
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

    def _compute(self) -> Tensor:
        return self.compute(self.x, self.positions, self.cache, self.index, self.mask)

    def run(self, x: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        tokens, start = x.shape[1], self.cache.length
        self.x.zero_()[:, :tokens].copy_(x)
        self.positions[:tokens].copy_(positions)
        self.index.fill_(self.mask.shape[1] - 1)
        torch.arange(start, start + tokens, out=self.index[:tokens])
        self.mask[:, :-1] = -torch.inf
        self.mask[:tokens].copy_(mask)
        self.mask[tokens:, -1] = 0.0
        if self.graph is None:
            return self._compute()[:, :tokens]
        self.graph.replay()
        return self.out[:, :tokens]
