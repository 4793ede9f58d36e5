"""Packed weights: a second form of a frozen float32 policy's weights for speed on a CPU, made by `pack`.

They are the same numbers in other layouts (oneDNN's blocked one, which halves the time of 30 tokens; input-major for a
single token), with linear factors folded together: a norm's gain or a temperature into the weights behind it. At these
widths half of a one-token forward is the overhead of calls, the other half reading the weights: so a layer has as few
calls and copies as possible.

Packed weights are not part of the module's state: copying, pickling, moving, loading weights or training drops them,
and the module computes without them.
"""

from __future__ import annotations

import math
import platform
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.checkpoint import load_state
from kerv_cli.targets.compact.features import hand_features, saturating_columns, scene_features

if TYPE_CHECKING:
    from kerv_cli.targets.compact.target import CompactTarget, Inputs
    from kerv_cli.targets.compact.trunk import Cache, Layer, LayerStack
    from kerv_cli.targets.compact.vision import VisionEncoder

M = TypeVar("M", bound=nn.Module)

BLOCKED_FROM = 600_000  # multiplications below which a plain product beats oneDNN's call overhead of 15 µs (measured)
EXPLICIT = range(24, 513)  # query tokens for which three plain calls beat the fused attention of a CPU (measured)
Affine = tuple[Tensor, Tensor]  # bias (O,), weight (I, O)


def has_blocked_layouts() -> bool:
    """Whether this build of torch carries oneDNN's fused operators."""
    names = ("_linear_pointwise", "_convolution_pointwise", "_reorder_linear_weight", "_reorder_convolution_weight")
    return torch.backends.mkldnn.is_available() and all(hasattr(torch.ops.mkldnn, name) for name in names)


@lru_cache(maxsize=1)
def is_intel() -> bool:
    """Whether the CPU is Intel's. On others MKL, with which torch is built, multiplies one row slowly: the products of
    one token of `small` take 1.7 ms on an AMD EPYC, with numpy's OpenBLAS 0.8 ms (measured)."""
    described = Path("/proc/cpuinfo")
    text = described.read_text(encoding="utf-8", errors="replace") if described.exists() else platform.processor()
    return "Intel" in text


def row_product(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """x (I,), weight (I, O) -> (O,). torch's profiler does not see it; the bench times it here."""
    return np.dot(x, weight)


def wants_gradient(x: Tensor) -> bool:
    """Whether x needs gradients, which packed weights do not have: then the modules compute."""
    return x.requires_grad and torch.is_grad_enabled()


class Packed:
    """Base of packed weights. Copies and pickles as None, because oneDNN's layouts can be neither copied nor
    pickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(None), ()


class Packable(nn.Module):
    """A module that can have packed weights. Moving it, loading weights, unfreezing or training it drops them. After
    writing weights in another way (`parameter.data`, a part's own `load_state_dict`) call `pack` again."""

    packed: Any = None

    def pack_weights(self) -> Packed | None:
        """Packed weights of this module, which is frozen on a CPU; None where they would not be faster."""
        raise NotImplementedError

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self.packed = None
        return super()._apply(fn, recurse)

    def _load_from_state_dict(self, *arguments: Any, **keywords: Any) -> None:
        self.packed = None
        super()._load_from_state_dict(*arguments, **keywords)

    def train(self, mode: bool = True) -> Self:
        """As `nn.Module.train`; training mode drops the packed weights."""
        if mode:
            self.packed = None
        return super().train(mode)

    def requires_grad_(self, requires_grad: bool = True) -> Self:
        """As `nn.Module.requires_grad_`; unfreezing drops the packed weights of all parts."""
        for part in self.modules():
            if requires_grad and isinstance(part, Packable):
                part.packed = None
        return super().requires_grad_(requires_grad)


def pack(module: nn.Module) -> None:
    """Prepares a module whose weights are final: stores linear weights on a CPU input-major (shapes unchanged) and,
    where all parameters are frozen and of one number format on a CPU, packs the weights of the parts that support it.

    One token times an output-major matrix is twice as slow (measured: 192 × 1024, 69 µs against 36 µs).
    """
    parameters = list(module.parameters())
    for part in module.modules():
        if isinstance(part, nn.Linear) and part.weight.device.type == "cpu" and part.weight.dtype == torch.float32:
            part.weight.data = part.weight.data.t().contiguous().t()
    if all(p.device.type == "cpu" and p.dtype == parameters[0].dtype and not p.requires_grad for p in parameters):
        with torch.no_grad():
            for part in module.modules():
                if isinstance(part, Packable):
                    part.packed = part.pack_weights()


def load_packed(module: M, folder: Path, kind: str, device: str | torch.device, dtype: torch.dtype) -> M:
    """The module with the folder's weights, on its device, frozen and packed for inference.

    Raises:
        CheckpointError: as `load_state`.
    """
    load_state(module, folder, kind)
    module = module.to(device=device, dtype=dtype).eval().requires_grad_(False)
    pack(module)
    return module


class FastLinear:
    """x (n, I) -> (n, O) with a weight (O, I): input-major for a few rows, oneDNN's blocks for many."""

    def __init__(self, weight: Tensor) -> None:
        self.input_major = weight.t().contiguous()
        self.weight = self.input_major.t()
        self.nothing = weight.new_zeros(1)
        self.array = None if is_intel() else self.input_major.numpy()
        self.rows = -(-BLOCKED_FROM // weight.numel())
        self.blocked: Tensor | None = None
        if has_blocked_layouts():
            self.blocked = torch.ops.mkldnn._reorder_linear_weight(weight.contiguous(), 32)

    def __call__(self, x: Tensor) -> Tensor:
        if self.blocked is not None and x.shape[0] >= self.rows:
            return torch.ops.mkldnn._linear_pointwise(x, self.blocked, None, "none", [], "")
        return torch.mm(x, self.input_major)

    def added_to(self, other: Tensor, x: Tensor) -> Tensor:
        """other (n, O) + the product."""
        if self.blocked is not None and x.shape[0] >= self.rows:
            return torch.ops.mkldnn._linear_pointwise.binary(x, other, self.blocked, None, "add")
        return torch.addmm(other, x, self.input_major)

    def of_vector(self, x: Tensor, scale: float) -> Tensor:
        """x (I,) -> scale · the product (O,)."""
        if self.array is not None:
            product = row_product(x.numpy(), self.array)
            product *= scale
            return torch.from_numpy(product)
        return torch.addmv(self.nothing, self.weight, x, beta=0, alpha=scale)

    def added_to_vector(self, other: Tensor, x: Tensor) -> Tensor:
        """other (O,) + the product of x (I,)."""
        if self.array is not None:
            return torch.from_numpy(row_product(x.numpy(), self.array)).add_(other)
        return torch.addmv(other, self.weight, x)


class RowNorm:
    """x / √(Σ x² + E ε): RMSNorm without its gain and √E, which are folded into the next weight."""

    def __init__(self, norm: nn.RMSNorm) -> None:
        self.width_eps = norm.weight.shape[0] * (norm.eps or 0.0)
        self.floor = torch.tensor(math.sqrt(self.width_eps))

    def __call__(self, x: Tensor) -> Tensor:
        return x / torch.hypot(torch.linalg.vector_norm(x, 2, -1, True), self.floor)

    def of_vector(self, x: Tensor) -> float:
        """The factor for a single row (E,)."""
        return 1.0 / math.sqrt(float(torch.dot(x, x)) + self.width_eps)


def gain_of(norm: nn.RMSNorm) -> Tensor:
    """The factor (E,) that `RowNorm` leaves out: gain · √E."""
    return norm.weight * norm.weight.shape[0] ** 0.5


@lru_cache(maxsize=128)
def causal_mask(tokens: int) -> Tensor:
    """Additive causal mask (T, T)."""
    with torch.inference_mode(False):
        return torch.full((tokens, tokens), -torch.inf).triu(1)


class PackedLayer:
    """Packed weights of a decoder layer. The two halves that RoPE rotates lie side by side and are rotated in place as
    complex numbers; keys and values are written together; the product adds the residual."""

    def __init__(self, layer: Layer) -> None:
        self.heads, self.channels = layer.heads, layer.channels
        width = self.width = layer.heads * layer.channels
        self.scale = layer.channels**-0.5
        self.norm = RowNorm(layer.attention_norm)
        qkv = layer.qkv.weight * gain_of(layer.attention_norm)
        pairs = torch.arange(self.channels).view(2, -1).t().flatten()
        qk = qkv[: 2 * width].view(2 * self.heads, self.channels, width)[:, pairs].reshape(2 * width, width)
        self.qkv = FastLinear(torch.cat([qk, qkv[2 * width :]]))
        self.out = FastLinear(layer.out.weight)
        self.gate_up = FastLinear(layer.gate_up.weight * gain_of(layer.feed_norm))
        self.down = FastLinear(layer.down.weight)

    def __call__(self, x: Tensor, turn: Tensor, cache: Tensor | None, start: int, mask: Tensor | None) -> Tensor:
        """x (B, T, E); turn (T, 3 A C / 2); cache (2, B, A, capacity, C), valid up to `start`; mask (T, start + T)."""
        batch, tokens, width = x.shape
        if batch * tokens == 1:
            return self.step(x, turn, cache, start, mask)
        rows = x.reshape(-1, width)
        qkv = self.qkv(self.norm(rows))
        qkv.view(torch.complex64).view(batch, tokens, -1).mul_(turn)
        attended = self.attend(qkv.view(batch, tokens, 3, self.heads, self.channels), cache, start, mask)
        rows = self.out.added_to(rows, attended)
        gate, up = self.gate_up(self.norm(rows)).chunk(2, -1)
        return self.down.added_to(rows, F.silu(gate).mul_(up)).view(batch, tokens, width)

    def attend(self, qkv: Tensor, cache: Tensor | None, start: int, mask: Tensor | None) -> Tensor:
        """Attention of rotated qkv (B, T, 3, A, C) -> (B T, E)."""
        batch, tokens = qkv.shape[:2]
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        if cache is not None:
            cache.narrow(3, start, tokens).copy_(qkv[:, :, 1:].permute(2, 0, 3, 1, 4))
            k, v = cache.narrow(3, 0, start + tokens)
        if batch == 1 and tokens in EXPLICIT:
            if mask is None:
                mask = causal_mask(tokens)
            scores = torch.baddbmm(mask, q[0], k[0].transpose(1, 2), alpha=self.scale)
            return torch.bmm(scores.softmax(-1), v[0]).transpose(0, 1).reshape(tokens, self.width)
        causal = mask is None and tokens > 1
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, is_causal=causal)
        return attended.transpose(1, 2).reshape(batch * tokens, self.width)

    def step(self, x: Tensor, turn: Tensor, cache: Tensor | None, start: int, mask: Tensor | None) -> Tensor:
        """As `__call__` for one token of one sequence, as a vector."""
        row = x.reshape(self.width)
        qkv = self.qkv.of_vector(row, self.norm.of_vector(row))
        qkv.view(torch.complex64).mul_(turn.view(-1))
        q, k, v = heads = qkv.view(3, 1, self.heads, 1, self.channels)
        if cache is not None:
            cache.narrow(3, start, 1).copy_(heads[1:])
            k, v = cache.narrow(3, 0, start + 1)
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        row = self.out.added_to_vector(row, attended.view(self.width))
        gate, up = self.gate_up.of_vector(row, self.norm.of_vector(row)).view(2, -1)
        return self.down.added_to_vector(row, F.silu(gate).mul_(up)).view(1, 1, self.width)


class PackedLayers(Packed):
    """Packed weights of a stack's layers and its final norm. Keys in its caches have neighbouring channel pairs."""

    def __init__(self, stack: LayerStack) -> None:
        cos, sin = stack.rotary.cos, stack.rotary.sin
        half = cos.shape[-1] // 2
        turn = torch.complex(cos[:, :half], sin[:, half:])
        # unit complex numbers for [q, k, v], 1 for v; rows of floats are gathered faster
        turns = torch.cat([turn.repeat(1, 2 * stack.heads), torch.ones_like(turn).repeat(1, stack.heads)], -1)
        self.turns = torch.view_as_real(turns).flatten(1)
        self.layers = [PackedLayer(layer) for layer in stack.layers]  # type: ignore[arg-type]
        self.rows, self.gain = RowNorm(stack.norm), gain_of(stack.norm)

    def __call__(self, x: Tensor, positions: Tensor, cache: Cache | None, mask: Tensor | None) -> Tensor:
        """As `LayerStack.run_layers`; mask: from `attention_mask`."""
        turn = self.turns.index_select(0, positions).view(torch.complex64)
        start = cache.length if cache is not None else 0
        for i, layer in enumerate(self.layers):
            x = layer(x, turn, cache.layers[i] if cache is not None else None, start, mask)
        return x

    def norm(self, x: Tensor) -> Tensor:
        """The final RMSNorm with its gain."""
        return self.rows(x).mul_(self.gain)


class FastConv:
    """A convolution on channels-last maps of one fixed size, with a blocked weight and a fused function `pointwise`."""

    def __init__(self, conv: nn.Conv2d, size: int, weight: Tensor | None = None, bias: Tensor | None = None) -> None:
        weight = conv.weight if weight is None else weight
        self.bias = conv.bias if bias is None else bias
        self.geometry = (list(conv.padding), list(conv.stride), list(conv.dilation), conv.groups)
        self.weight = torch.ops.mkldnn._reorder_convolution_weight(
            weight.contiguous(memory_format=torch.channels_last), *self.geometry, [1, conv.in_channels, size, size]
        )

    def __call__(self, x: Tensor, pointwise: str = "none") -> Tensor:
        return torch.ops.mkldnn._convolution_pointwise(x, self.weight, self.bias, *self.geometry, pointwise, [], "")

    def added_to(self, other: Tensor, x: Tensor) -> Tensor:
        """other += the convolution of x, in place -> other."""
        return torch.ops.mkldnn._convolution_pointwise_.binary(
            other, x, self.weight, self.bias, *self.geometry, "add", 1.0, None, [], None
        )


class PackedStage:
    """Packed weights of a strided convolution and the residual block behind it."""

    def __init__(self, stage: nn.Sequential, size: int, weight: Tensor | None = None) -> None:
        entry: Any = stage[0]
        residual: Any = stage[1]
        self.entry, self.norm = FastConv(entry, size, weight), residual.norm
        self.first, self.second = (FastConv(c, size // entry.stride[0]) for c in (residual.first, residual.second))

    def __call__(self, x: Tensor) -> Tensor:
        x = self.entry(x)
        return self.second.added_to(x, self.first(self.norm(x), "relu"))


class PackedVision(Packed):
    """Packed weights of `VisionEncoder.forward` for one frame; heat maps are summed from coarse to fine.

    Softmax is taken to the base 2, which the temperature absorbs: 2^x is a fast vector loop where MKL's e^x is not
    (measured on an AMD CPU, 48 × 48 × 32 numbers: 12 µs against 48 µs).
    """

    def __init__(self, vision: VisionEncoder) -> None:
        height = vision.columns.shape[0]
        self.size = 2 * height
        entry: Any = vision.fine[0]
        self.fine = PackedStage(vision.fine, self.size, entry.weight / 255)
        self.middle = PackedStage(vision.middle, self.size // 2)
        self.coarse = PackedStage(vision.coarse, self.size // 4)
        self.patch = FastConv(vision.patch, self.size // 8)
        self.grid_position = vision.grid_position
        sharp = vision.temperature * math.log2(math.e)
        self.heat_fine = FastConv(vision.heat_fine, height, *scaled(vision.heat_fine, sharp))
        self.heat_middle, self.heat_coarse = (
            (bias[None], weight.flatten(1).t().contiguous())
            for weight, bias in (scaled(vision.heat_middle, sharp), scaled(vision.heat_coarse, sharp))
        )
        column, row = vision.columns.repeat(height), vision.columns.repeat_interleave(height)
        self.moments = torch.stack([torch.ones_like(column), column, row])

    def __call__(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """images (1, 3, size, size) uint8 -> tokens (1, grid², E), points (1, 2K)."""
        # the mean cannot move into the bias: the border is padded with zeros behind the subtraction
        pixels = images.contiguous(memory_format=torch.channels_last).float().sub_(127.5)
        fine = self.fine(pixels)
        middle = self.middle(fine)
        coarse = self.coarse(middle)
        heat = cells(self.heat_fine(fine))
        half = torch.addmm(self.heat_middle[0], cells(middle), self.heat_middle[1])
        quarter = torch.addmm(self.heat_coarse[0], cells(coarse), self.heat_coarse[1])
        add_upsampled(half, quarter, self.size // 4)
        add_upsampled(heat, half, self.size // 2)
        tokens = (cells(self.patch(coarse)) + self.grid_position)[None]
        weight = heat.sub_(heat.amax(0)).exp2_()
        total, columns, rows = self.moments @ weight
        return tokens, torch.cat([columns / total, rows / total])[None]


def scaled(conv: nn.Conv2d, factor: Tensor) -> tuple[Tensor, Tensor]:
    """Weight and bias whose outputs (C,) are multiplied by `factor` (C,)."""
    assert conv.bias is not None
    return conv.weight * factor[:, None, None, None], conv.bias * factor


def cells(maps: Tensor) -> Tensor:
    """(1, C, h, w) channels-last -> (h w, C), a view."""
    return maps.permute(0, 2, 3, 1).view(-1, maps.shape[1])


def add_upsampled(heat: Tensor, coarse: Tensor, size: int) -> None:
    """heat (s², K) += coarse (s² / 4, K), each cell for its four, in place."""
    half = size // 2
    wide = coarse.view(half, half, 1, -1).expand(-1, -1, 2, -1).reshape(half, 1, -1)
    heat.view(half, 2, -1).add_(wide)


def affine(function: Callable[[Tensor], Tensor], inputs: int) -> Affine:
    """Bias (O,) and weight (I, O) of an affine function (1, I) -> (1, O), found by evaluating it in float64."""
    offset = function(torch.zeros(1, inputs, dtype=torch.float64))
    weight = function(torch.eye(inputs, dtype=torch.float64)) - offset
    return offset[0].float(), weight.float()


def affine_layers(net: nn.Sequential) -> list[Affine]:
    """Bias and input-major weight of each linear layer."""
    return [(part.bias, part.weight.t().contiguous()) for part in net if isinstance(part, nn.Linear)]


def perceptron(x: Tensor, layers: list[Affine]) -> Tensor:
    """x (1, I) through linear layers with SiLU between them -> (1, O)."""
    for bias, weight in layers[:-1]:
        x = torch.addmm(bias, x, weight)
        F.silu(x, inplace=True)
    return torch.addmm(layers[-1][0], x, layers[-1][1])


class PackedPrompt(Packed):
    """Packed weights of `CompactTarget.encode_batch` for one observation of a vision policy. All affine steps of the
    scene features are folded into one matrix product, whose last columns saturate."""

    def __init__(self, target: CompactTarget) -> None:
        centre, space = target.centre.double(), target.observation
        felt, places = len(space.proprioception), len(space.places)
        self.encoders, self.words, self.size = target.encoders, target.word_embedding, target.settings.image_size
        self.tokens, self.places = target.settings.scene_tokens, places
        self.hand = affine(lambda x: hand_features(x, centre), felt)
        bias, weight = affine(
            lambda x: scene_features(x[:, :felt], x[:, felt:].unflatten(1, (places, 3)), centre, saturate=lambda v: v),
            felt + 3 * places,
        )
        saturating = saturating_columns(space)
        order = [column for column in range(len(bias)) if column not in saturating] + saturating
        self.straight = len(bias) - len(saturating)
        self.lines = bias[order], weight[:, order].contiguous()
        nets = (target.scene, target.proprioception, target.locate)
        self.scene, self.proprioception, self.locate = map(affine_layers, nets)
        self.scene[0] = (self.scene[0][0], self.scene[0][1][order].contiguous())
        bias, weight = self.locate[-1]
        self.locate[-1] = (bias * 0.1 + target.centre.repeat(places), weight * 0.1)

    def __call__(self, inputs: Inputs) -> tuple[Tensor, Tensor]:
        """As `CompactTarget.encode_batch`, for one observation."""
        words, felt = self.words(inputs.words), inputs.proprioception
        hand = torch.addmm(self.hand[0], felt, self.hand[1])
        tokens, points = self.see(inputs.images)
        places = perceptron(torch.cat([*points, hand, words.mean(1)], -1), self.locate)
        features = torch.addmm(self.lines[0], torch.cat([felt, places], -1), self.lines[1])
        features[:, self.straight :].tanh_()
        scene = perceptron(features, self.scene).view(1, self.tokens, -1)
        prompt = torch.cat([*tokens, words, scene, perceptron(hand, self.proprioception)[None]], 1)
        return prompt, places.view(1, self.places, 3)

    def see(self, images: Tensor | None) -> tuple[list[Tensor], list[Tensor]]:
        """Tokens (1, grid², E) and points (1, 2K) of every view."""
        assert images is not None
        seen = [encoder(view) for encoder, view in zip(self.encoders, images.split(self.size, -1), strict=True)]
        return [tokens for tokens, _ in seen], [points for _, points in seen]
