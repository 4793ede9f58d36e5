"""Packed weights: a second form of a frozen float32 policy's weights for speed on a CPU, made by `pack`.

They are the same numbers in other layouts (oneDNN's blocked one halves the time of 30 tokens; one token goes through
numpy), with linear factors folded together: a norm's gain or a temperature into the weights behind it.
At these widths half of a one-token forward was the overhead of calls, the other half reading the weights: so a layer
has as few calls and copies as possible.

Packed weights are not part of the module's state: copying, pickling, moving, loading weights or training drops them,
and the module computes without them. A vision encoder's are a graph of ONNX Runtime (`vision_graph.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.attention import Cache
from kerv_cli.targets.checkpoint import load_state
from kerv_cli.targets.compact.features import hand_features, saturating_columns, scene_features
from kerv_cli.targets.compact.kernels import (
    FastLinear,
    RowNorm,
    gain_of,
    row_product,
    with_pairs,
)
from kerv_cli.targets.compact.packable import Packable, Packed
from kerv_cli.targets.compact.packed_bfloat16 import BlockedLayers, multiplies_bfloat16
from kerv_cli.targets.compact.target import CompactTarget, Inputs
from kerv_cli.targets.compact.trunk import Layer, LayerStack, PackedStack
from kerv_cli.targets.compact.vision import VisionEncoder

M = TypeVar("M", bound=nn.Module)

EXPLICIT = range(24, 513)  # query tokens for which three plain calls beat the fused attention of a CPU (measured)
Affine = tuple[Tensor, Tensor]  # bias (O,), weight (I, O)


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
                    part.packed = packed_weights(part)


def load_packed(module: M, folder: Path, kind: str, device: str | torch.device, dtype: torch.dtype) -> M:
    """The module with the folder's weights, on its device, frozen and packed for inference.

    Raises:
        CheckpointError: as `load_state`.
    """
    load_state(module, folder, kind)
    module = module.to(device=device, dtype=dtype).eval().requires_grad_(False)
    pack(module)
    return module


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
        self.width = layer.heads * layer.channels
        self.scale = layer.channels**-0.5
        self.norm = RowNorm(layer.attention_norm)
        qkv = layer.qkv.weight * gain_of(layer.attention_norm)
        self.qkv = FastLinear(with_pairs(qkv, self.channels))
        self.out = FastLinear(layer.out.weight)
        self.gate_up = FastLinear(layer.gate_up.weight * gain_of(layer.feed_norm))
        self.down = FastLinear(layer.down.weight)

    def __call__(self, x: Tensor, turn: Tensor, cache: Tensor | None, start: int, mask: Tensor | None) -> Tensor:
        """x (B, T, E); turn (T, 3 A C / 2); cache (2, B, A, capacity, C), valid up to `start`; mask (T, start + T)."""
        batch, tokens, width = x.shape
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


class PackedLayers(PackedStack):
    """Packed weights of a stack's layers and its final norm. Keys in its caches have neighbouring channel pairs."""

    def __init__(self, stack: LayerStack) -> None:
        cos, sin = stack.rotary.cos, stack.rotary.sin
        half = cos.shape[-1] // 2
        turn = torch.complex(cos[:, :half], sin[:, half:])
        # unit complex numbers for [q, k, v], 1 for v; rows of floats are gathered faster
        turns = torch.cat([turn.repeat(1, 2 * stack.heads), torch.ones_like(turn).repeat(1, stack.heads)], -1)
        self.turns = torch.view_as_real(turns).flatten(1)
        self.layers = [PackedLayer(layer) for layer in stack.layers]  # type: ignore[arg-type]
        self.rows, self.gain, self.heads = RowNorm(stack.norm), gain_of(stack.norm), stack.heads
        self.width_eps = np.float32(self.rows.width_eps)
        self.turns_of_qk: np.ndarray = self.turns[:, : 2 * stack.width].contiguous().numpy().view(np.complex64)

    def __call__(self, x: Tensor, positions: Tensor, cache: Cache | None, mask: Tensor | None) -> Tensor:
        """All layers: x (B, T, E) -> hidden states (B, T, E), before the norm."""
        if cache is not None and x.shape[0] * x.shape[1] == 1:
            return self.step(x.view(-1), int(positions), cache, mask).view(1, 1, -1)
        turn = self.turns.index_select(0, positions).view(torch.complex64)
        start = cache.length if cache is not None else 0
        for i, layer in enumerate(self.layers):
            x = layer(x, turn, cache.layers[i] if cache is not None else None, start, mask)
        return x

    def norm(self, x: Tensor) -> Tensor:
        """The final RMSNorm with its gain."""
        if x.shape[0] * x.shape[1] == 1:
            row = self.normed(x.view(-1).numpy())
            row *= self.gain.numpy()
            return torch.from_numpy(row).view(1, 1, -1)
        return self.rows(x).mul_(self.gain)

    def step(self, x: Tensor, position: int, cache: Cache, mask: Tensor | None) -> Tensor:
        """`__call__` for one token of one sequence, in numpy: x (E,) -> (E,); mask (1, S + 1).

        A token of `small` is 64 products and norms of a few microseconds each; a call of torch costs four, one of numpy
        less than one (measured on an AMD EPYC: 0.85 ms with torch, 0.41 ms here, of which the products are 0.22).
        """
        width, stop = x.shape[0], cache.length + 1
        channels = width // self.heads
        scale = np.float32(channels**-0.5)
        keys, values = (cache.buffer[:, i, 0].numpy() for i in range(2))  # (layers, A, slots, C)
        row, turn, unseen = x.numpy().copy(), self.turns_of_qk[position], None if mask is None else mask.numpy()
        with np.errstate(over="ignore"):  # e^-g of SiLU may be infinite
            for layer, k, v in zip(self.layers, keys, values, strict=True):
                qkv = row_product(layer.qkv.array, self.normed(row))
                qk: np.ndarray = qkv[: 2 * width].view(np.complex64)
                qk *= turn
                q, k[:, stop - 1], v[:, stop - 1] = qkv.reshape(3, self.heads, channels)
                weights = np.matmul(k[:, :stop], q[:, :, None])[:, :, 0]
                weights *= scale
                if unseen is not None:
                    weights += unseen
                weights -= weights.max(1, keepdims=True)
                np.exp(weights, out=weights)
                weights /= weights.sum(1, keepdims=True)
                attended = np.matmul(weights[:, None], v[:, :stop])
                row += row_product(layer.out.array, attended.reshape(width))
                gate, up = row_product(layer.gate_up.array, self.normed(row)).reshape(2, -1)
                gate /= np.exp(-gate) + np.float32(1)
                gate *= up
                row += row_product(layer.down.array, gate)
        return torch.from_numpy(row)

    def normed(self, row: np.ndarray) -> np.ndarray:
        """row (E,) -> its RMSNorm without the gain and √E, as `RowNorm`."""
        return row * (np.float32(1) / np.sqrt(np.dot(row, row) + self.width_eps))


def affine(function: Callable[[Tensor], Tensor], inputs: int) -> Affine:
    """Bias (O,) and weight (I, O) of an affine function (1, I) -> (1, O), found by evaluating it in float64."""
    offset = function(torch.zeros(1, inputs, dtype=torch.float64))
    weight = function(torch.eye(inputs, dtype=torch.float64)) - offset
    return offset[0].float(), weight.float()


def affine_scene(p: int, places: int, centre: Tensor) -> Affine:
    """`scene_features` before it saturates, of p numbers of proprioception and K places in a row (1, p + 3 K)."""
    return affine(
        lambda x: scene_features(x[:, :p], x[:, p:].unflatten(1, (places, 3)), centre, saturate=lambda v: v),
        p + 3 * places,
    )


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
        p, places = len(space.proprioception), len(space.places)
        self.encoders, self.words, self.size = target.encoders, target.word_embedding, target.settings.image_size
        self.tokens, self.places = target.settings.scene_tokens, places
        self.hand = affine(lambda x: hand_features(x, centre), p)
        bias, weight = affine_scene(p, places, centre)
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
        """One observation -> prompt embeddings (1, P, E) and positions of the places (1, K, 3), metres."""
        words, proprioception = self.words(inputs.words), inputs.proprioception
        hand = torch.addmm(self.hand[0], proprioception, self.hand[1])
        tokens, points = self.see(inputs.images)
        places = perceptron(torch.cat([*points, hand, words.mean(1)], -1), self.locate)
        features = torch.addmm(self.lines[0], torch.cat([proprioception, places], -1), self.lines[1])
        features[:, self.straight :].tanh_()
        scene = perceptron(features, self.scene).view(1, self.tokens, -1)
        prompt = torch.cat([*tokens, words, scene, perceptron(hand, self.proprioception)[None]], 1)
        return prompt, places.view(1, self.places, 3)

    def see(self, images: Tensor | None) -> tuple[list[Tensor], list[Tensor]]:
        """Tokens (1, grid², E) and points (1, 2K) of every view."""
        assert images is not None
        views = [encoder(view) for encoder, view in zip(self.encoders, images.split(self.size, -1), strict=True)]
        return [tokens for tokens, _ in views], [points for _, points in views]


def packed_weights(part: Packable) -> Packed | None:
    """Packed weights of a frozen part on a CPU, by its type; None where they would not be faster."""
    if isinstance(part, LayerStack):
        if part.norm.weight.dtype == torch.float32:
            return PackedLayers(part)
        if part.norm.weight.dtype == torch.bfloat16 and multiplies_bfloat16():
            return BlockedLayers(part.rotary, part.layers, part.norm)  # type: ignore[arg-type]
        return None
    if isinstance(part, VisionEncoder):
        from kerv_cli.targets.compact.vision_graph import PackedVision  # ONNX Runtime, which a GPU does not need

        return PackedVision(part) if part.columns.dtype == torch.float32 else None
    if isinstance(part, CompactTarget):
        return PackedPrompt(part) if part.cameras and part.dtype == torch.float32 else None
    return part.pack_weights()
