"""One CUDA graph per number of tokens: a forward over a cache of fixed shapes as a single launch.

A forward of T tokens runs in the graph of the next larger bucket. The rows behind T read zeros and write to the cache's
spare slot, which no other row attends to. On a device without graphs the same computation runs call by call: that is
how it is tested on a CPU.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from kerv_cli.targets.attention import Cache

_AT_ONCE = (1, 2, 4, 8, 16, 32, 64)  # buckets of verifications; those of prefills follow with the first ones
_WARM_UP = 3  # runs before a capture: libraries choose kernels and allocate workspaces


def bucket(tokens: int) -> int:
    """Tokens of the graph that runs a forward of `tokens`: powers of two up to 16, then multiples of 16."""
    if tokens <= 16:
        return 1 << (tokens - 1).bit_length()
    return -(-tokens // 16) * 16


Compute = Callable[[Tensor, Tensor, Cache, Tensor, Tensor], Tensor]
"""What a graph captures, `LayerStack.compute`: (x, positions, cache, slots, mask) -> output of the last layer."""


class CapturedCache(Cache):
    """A cache of fixed shapes. steps: bucket -> the graph that writes to it, from the first forward that runs in one;
    every forward over a cache is of one stack and of batch 1."""

    def __init__(self, layers: int, batch: int, heads: int, capacity: int, channels: int, like: Tensor) -> None:
        super().__init__(layers, batch, heads, capacity, channels, like, fixed=True)
        self.steps: dict[int, _Step] = {}

    def run(self, compute: Compute, x: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """The layers in a graph: x (1, T, E) at `positions` (T,), mask (T, slots) as `attention_mask` -> output of the
        last layer (1, T, E), valid until the next forward of the same bucket; the new tokens lie behind the cached
        ones."""
        if self.buffer.is_cuda and not self.steps:  # in the warm-up: a capture in the middle of an episode is timed
            self.steps = {size: _Step(compute, self, size, x.shape[2]) for size in _AT_ONCE if size <= self.capacity}
        size = bucket(x.shape[1])
        if size not in self.steps:
            self.steps[size] = _Step(compute, self, size, x.shape[2])
        return self.steps[size].run(x, positions, mask)


class _Step:
    """The buffers of one bucket, and its graph."""

    def __init__(self, compute: Compute, cache: Cache, size: int, width: int) -> None:
        self.compute, self.cache = compute, cache
        like, slots = cache.buffer, cache.buffer.shape[-2]
        self.x = like.new_zeros((1, size, width))
        self.positions = torch.zeros(size, dtype=torch.long, device=like.device)
        self.index = torch.full((size,), slots - 1, dtype=torch.long, device=like.device)
        self.mask = like.new_full((size, slots), -torch.inf)
        self.mask[:, -1] = 0.0  # a row that attends to nothing would be NaN, and so would its value for all others
        self.graph = self._captured() if like.is_cuda else None

    def _captured(self) -> torch.cuda.CUDAGraph:
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UP):
                self._compute()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self.out = self._compute()
        return graph

    def _compute(self) -> Tensor:
        return self.compute(self.x, self.positions, self.cache, self.index, self.mask)

    def run(self, x: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """Copies the inputs to the graph's buffers and replays it, see `CapturedCache.run`."""
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
