"""CUDA graphs that replay a whole forward as one launch. For this the key/value cache has fixed shapes.

A graph takes a fixed number of tokens, called its bucket (1, 2, 4, 8, 16, 32, 48, …). A forward of T tokens runs in the
smallest bucket that holds them. The unused rows read zeros and write to a spare slot of the cache, which no other row
attends to. On a CPU the same computation runs without graphs, for tests.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from kerv_cli.targets.attention import Cache

_AT_ONCE = (1, 2, 4, 8, 16, 32, 64)  # buckets that are captured together with the first one
_WARM_UP = 3  # runs before a capture, in which libraries choose kernels and allocate workspaces


def bucket(tokens: int) -> int:
    """Return the rows of the smallest graph that holds so many tokens: a power of two to 16, then a multiple of 16."""
    if tokens <= 16:
        return 1 << (tokens - 1).bit_length()
    return -(-tokens // 16) * 16


Compute = Callable[[Tensor, Tensor, Cache, Tensor, Tensor], Tensor]
"""The function that a graph captures, `LayerStack.run_layers`."""


class CapturedCache(Cache):
    """A key/value cache of fixed shapes, with the CUDA graphs that write to it. It serves one stack, with batch size 1.

    Attributes:
        steps: Number of rows of a graph (its bucket) -> the graph. Empty before the first forward.
    """

    def __init__(self, layers: int, batch: int, heads: int, capacity: int, channels: int, like: Tensor) -> None:
        super().__init__(layers, batch, heads, capacity, channels, like, fixed=True)
        self.steps: dict[int, _Step] = {}

    def run(self, compute: Compute, x: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """Run the layers for T new tokens that follow the cached ones.

        Args:
            compute: The layers' computation, `LayerStack.run_layers`.
            x: (1, T, width) input of the first layer.
            positions: (T,) rotary positions.
            mask: (T, slots) result of `attention_mask`.

        Returns:
            Output of the last layer (1, T, width). The next forward in the same graph overwrites it.
        """
        # captured now, in the warm-up: later a capture would count in an episode's time
        if self.buffer.is_cuda and not self.steps:
            self.steps = {size: _Step(compute, self, size, x.shape[2]) for size in _AT_ONCE if size <= self.capacity}
        size = bucket(x.shape[1])
        if size not in self.steps:
            self.steps[size] = _Step(compute, self, size, x.shape[2])
        return self.steps[size].run(x, positions, mask)


class _Step:
    """A CUDA graph for a fixed number of tokens, with its input buffers."""

    def __init__(self, compute: Compute, cache: Cache, size: int, width: int) -> None:
        self.compute, self.cache = compute, cache
        like, slots = cache.buffer, cache.buffer.shape[-2]
        self.x = like.new_zeros((1, size, width))
        self.positions = torch.zeros(size, dtype=torch.long, device=like.device)
        self.index = torch.full((size,), slots - 1, dtype=torch.long, device=like.device)
        self.mask = like.new_full((size, slots), -torch.inf)
        self.mask[:, -1] = 0.0  # a row that attends to nothing would be NaN, which would spread to all others
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
        """Copy the inputs to the graph's buffers and replay the graph; arguments as `CapturedCache.run`."""
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
