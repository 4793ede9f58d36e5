"""The Llama-style trunk: RMSNorm, RoPE, SwiGLU, tree attention over a key/value cache.

Shapes: B batch, T new tokens, S cached tokens, E width of inputs and outputs, A heads, C = width / A channels of a
head. The width inside the layers is larger than E only in an enlarged target (`targets/grown.py`).

There are two implementations, whose results are equal up to rounding:

- On CUDA a captured graph replays a forward. For this the cache has fixed shapes: every forward attends to all slots,
  and a mask hides the unused ones.
- On a CPU a frozen stack is compiled (`program.py`).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.engine.draft import upload
from kerv_cli.engine.protocol import Seen
from kerv_cli.targets.attention import Cache, CapturedCache, Rotation, Slots, attend, attention_mask, rotate
from kerv_cli.targets.compact.program import Compilable, Program

POSITIONS, BASE = 1024, 10_000.0  # of the rotary embedding: number of positions, base of the frequencies


class Rotary(nn.Module):
    """Tables of the rotary position embedding in half-split layout: channel i rotates with channel i + C/2."""

    cos: Tensor
    sin: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        frequencies = BASE ** (-torch.arange(0, channels, 2, dtype=torch.float32) / channels)
        angles = torch.arange(POSITIONS, dtype=torch.float32)[:, None] * frequencies
        self.register_buffer("cos", torch.cat([angles.cos(), angles.cos()], -1), persistent=False)
        # the sign of the swapped half is folded into the table: x·cos + swap(x)·sin
        self.register_buffer("sin", torch.cat([-angles.sin(), angles.sin()], -1), persistent=False)

    def forward(self, positions: Tensor | slice) -> Rotation:
        return self.cos[positions][:, None], self.sin[positions][:, None]


class Layer(nn.Module):
    """One pre-norm decoder layer. One matrix gives q, k and v. Another matrix gives both halves of the SwiGLU."""

    def __init__(self, width: int, heads: int, feed_forward: int) -> None:
        super().__init__()
        self.heads = heads
        self.attention_norm = nn.RMSNorm(width, eps=1e-5)
        self.qkv = nn.Linear(width, 3 * width, bias=False)
        self.out = nn.Linear(width, width, bias=False)
        self.feed_norm = nn.RMSNorm(width, eps=1e-5)
        self.gate_up = nn.Linear(width, 2 * feed_forward, bias=False)
        self.down = nn.Linear(feed_forward, width, bias=False)

    def forward(
        self, x: Tensor, rotary: Rotation, cache: Tensor | None = None, slots: Slots = None, mask: Tensor | None = None
    ) -> Tensor:
        """Compute the output (B, T, width) of the layer.

        Args:
            x: (B, T, width) input: a tensor, or its stand-in `Recorded` while a program is recorded.
            rotary: Cosines and sines, (T, 1, C) each.
            cache: (2, B, A, capacity, C) keys and values of this layer's A heads. None if there are no earlier tokens.
        """
        qkv = self.qkv(self.attention_norm(x))
        if isinstance(qkv, Tensor):
            qk, v = qkv.unflatten(-1, (3 * self.heads, -1)).split([2 * self.heads, self.heads], 2)
            q, k = rotate(qk, *rotary).transpose(1, 2).chunk(2, 1)
            x = x + self.out(attend(q, k, v.transpose(1, 2), cache, slots, mask))
        else:
            x = x + self.out(qkv.attend(self.heads, *rotary))
        gate, up = self.gate_up(self.feed_norm(x)).chunk(2, -1)
        return x + self.down(F.silu(gate) * up)


class LayerStack(Compilable):
    """Base class of the trunk and the drafter: an input step, decoder layers and, usually, a final norm.

    Attributes:
        inputs: Number of input tensors (B, T, E).
        width: Width inside the layers.
        outer: E, width of inputs and outputs.
        depth: Number of layers.
        padding: Number of tokens that are appended to a prompt, hidden by the mask, and dropped after the prefill. The
            prefill then costs as much as for a longer prompt (`targets/grown.py`).
    """

    inputs = 1
    padding = 0

    def __init__(self, width: int, layers: int, heads: int, feed_forward: int, final_norm: bool = True) -> None:
        super().__init__()
        self.width, self.outer, self.heads, self.depth = width, width, heads, layers
        self.rotary = Rotary(width // heads)
        self.layers = nn.ModuleList(Layer(width, heads, feed_forward) for _ in range(layers))
        self.norm = nn.RMSNorm(width, eps=1e-5) if final_norm else nn.Identity()

    @property
    def weight(self) -> Tensor:
        return next(self.parameters())

    def enter(self, *inputs: Tensor) -> Tensor:
        """Combine the inputs, (B, T, E) each, into one tensor (B, T, E)."""
        return inputs[0]

    def begin(self, *inputs: Tensor) -> Tensor:
        x, rest = self.enter(*inputs), self.width - self.outer
        return x if not rest else torch.cat([x, x[..., :1].expand(*x.shape[:-1], rest) * 0.0], -1)

    def finish(self, x: Tensor) -> Tensor:
        return self.norm(x if self.width == self.outer else x[..., : self.outer])

    def new_cache(self, batch: int, capacity: int, fixed: bool | None = None) -> Cache:
        """Return an empty cache. If `fixed` and of batch size 1, it is for CUDA graphs. None: fixed on CUDA only."""
        like = self.weight
        if self.compiled is not None:
            like = like.float()
        sizes = self.heads, capacity + self.padding, self.width // self.heads
        if batch == 1 and (like.is_cuda if fixed is None else fixed):
            return CapturedCache(self.depth, *sizes, like)
        return Cache(self.depth, batch, *sizes, like)

    def new_program(self) -> Program:
        return Program(self.recorded, *[(1, 1, self.outer)] * self.inputs)

    def run(self, inputs: Sequence[Tensor], positions: Tensor, cache: Cache | None, seen: Seen) -> Tensor:
        """Run all layers over T new tokens, and return their hidden states (B, T, E).

        Args:
            inputs: Tensors (B, T, E), as `enter` takes them.
            positions: (T,) rotary positions of the new tokens.
            cache: Keys and values of earlier tokens. This forward appends the new ones.
            seen: (T, M) bool, which of the last M tokens, old or new, each new token attends to. If None, attention is
                causal.
        """
        tokens, padding = inputs[0].shape[1], 0 if cache is not None and cache.length else self.padding
        if padding:
            inputs = [F.pad(x, (0, 0, 0, padding)) for x in inputs]
            positions = F.pad(positions, (0, padding))
            if seen is not None:  # padding sees every token, and no other token sees it
                seen = seen if isinstance(seen, Tensor) else upload(seen, positions.device)
                seen = F.pad(F.pad(seen, (0, padding)), (0, 0, 0, padding), value=True)
        x = inputs[0]
        if isinstance(cache, CapturedCache):
            hidden = cache.run(self.forwarded, self.begin(*inputs), positions, seen)
        elif self.runs_compiled(x):
            hidden = self.compiled(*inputs, positions=positions, cache=cache, seen=seen)[0].view(x.shape).to(x.dtype)
        else:
            mask = attention_mask(seen, x.shape[1], cache, x)
            slots = cache.next_slots(x.shape[1]) if cache is not None else None
            hidden = self.forwarded(self.begin(*inputs), positions, cache, slots, mask)
        if cache is not None:
            cache.length += tokens  # the next forward overwrites the padding
        return hidden[:, :tokens]

    def recorded(self, *inputs: Tensor) -> Tensor:
        """Record the layers' operations on one token, to compile them. Inputs and result are `Recorded` (1, 1, E)."""
        return self.forwarded(self.begin(*inputs), slice(None), None, None, None)

    def forwarded(
        self, x: Tensor, positions: Tensor | slice, cache: Cache | None, slots: Slots, mask: Tensor | None
    ) -> Tensor:
        """Return the hidden states (B, T, E) for x (B, T, width), computed by torch."""
        rotary = self.rotary(positions)
        for i, layer in enumerate(self.layers):
            x = layer(x, rotary, cache.layers[i] if cache is not None else None, slots, mask)
        return self.finish(x)


class Trunk(LayerStack):
    """The target's decoder layers. Their output, the hidden states, is read by the head and the drafter."""

    def __init__(self, width: int, layers: int, heads: int, feed_forward: int) -> None:
        super().__init__(width, layers, heads, feed_forward)
        for name, parameter in self.named_parameters():
            if parameter.dim() == 2:
                nn.init.normal_(parameter, std=0.02)
                if name.endswith(("out.weight", "down.weight")):
                    parameter.data /= (2 * layers) ** 0.5

    def forward(self, x: Tensor, positions: Tensor, cache: Cache | None = None, seen: Seen = None) -> Tensor:
        return self.run((x,), positions, cache, seen)
