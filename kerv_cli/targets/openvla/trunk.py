"""The language model of OpenVLA: Llama-2 with tree attention over a key/value cache.

Modules have the names that published checkpoints use, so that their weights can be memory-mapped.

Shapes: B batch, T new tokens, S cached tokens, E width, A heads, K heads of keys and values, C channels of a head.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.attention import Cache, Slots, attend, attention_mask, rotate
from kerv_cli.targets.openvla.config import Language

Rotary = tuple[Tensor, Tensor]
"""Cosines and sines (T, C) of the rotary embedding."""


def rotation(positions: Tensor, channels: int, theta: float, dtype: torch.dtype) -> Rotary:
    """Return the cosines and sines of the rotary embedding in half-split layout. They are computed in float32.

    In the first half of the channels the sines have the reversed sign, as `attention.rotate` requires.

    Args:
        positions: (T,) rotary positions.
        channels: C, channels of a head.
        theta: Base of the frequencies.
        dtype: Number format of the result.
    """
    frequencies = theta ** (-torch.arange(0, channels, 2, device=positions.device, dtype=torch.float32) / channels)
    angles = positions[:, None].float() * frequencies
    cos, sin = angles.cos(), angles.sin()
    return torch.cat([cos, cos], -1).to(dtype), torch.cat([-sin, sin], -1).to(dtype)


class LlamaAttention(nn.Module):
    """Rotary self-attention. Several query heads may share a head of keys and values."""

    def __init__(self, language: Language) -> None:
        super().__init__()
        width, inner = language.hidden_size, language.key_value_heads * language.channels
        self.heads, self.shared = language.num_attention_heads, language.key_value_heads
        self.q_proj = nn.Linear(width, width, bias=False)
        self.k_proj = nn.Linear(width, inner, bias=False)
        self.v_proj = nn.Linear(width, inner, bias=False)
        self.o_proj = nn.Linear(width, width, bias=False)

    def forward(
        self, x: Tensor, rotary: Rotary, mask: Tensor | None, cache: Tensor | None = None, slots: Slots | None = None
    ) -> Tensor:
        """Return the attention's output (B, T, E).

        Args:
            x: (B, T, E) input.
            rotary: Cosines and sines of the tokens' positions.
            mask: Result of `attention_mask`. None: attention is causal.
            cache: (2, B, K, capacity, C) keys and values of this layer. None: there are no earlier tokens.
            slots: Slots of the cache that the new keys and values are written to.
        """
        q = rotate(self.q_proj(x).unflatten(-1, (self.heads, -1)).transpose(1, 2), *rotary)
        k = rotate(self.k_proj(x).unflatten(-1, (self.shared, -1)).transpose(1, 2), *rotary)
        v = self.v_proj(x).unflatten(-1, (self.shared, -1)).transpose(1, 2)
        return self.o_proj(attend(q, k, v, cache, slots, mask))


class LlamaPerceptron(nn.Module):
    """Feed-forward part of a layer (SwiGLU)."""

    def __init__(self, language: Language) -> None:
        super().__init__()
        width, hidden = language.hidden_size, language.intermediate_size
        self.gate_proj = nn.Linear(width, hidden, bias=False)
        self.up_proj = nn.Linear(width, hidden, bias=False)
        self.down_proj = nn.Linear(hidden, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return the output (B, T, E) for x (B, T, E)."""
        return self.down_proj(F.silu(self.gate_proj(x)) * self.up_proj(x))


class LlamaLayer(nn.Module):
    """One pre-norm decoder layer.

    Args:
        language: Shape of the language model.
        normed: Whether there is a norm before the attention. The first layer of a public EAGLE drafter has none.
    """

    def __init__(self, language: Language, normed: bool = True) -> None:
        super().__init__()
        width, epsilon = language.hidden_size, language.rms_norm_eps
        self.input_layernorm = nn.RMSNorm(width, eps=epsilon) if normed else nn.Identity()
        self.self_attn = LlamaAttention(language)
        self.post_attention_layernorm = nn.RMSNorm(width, eps=epsilon)
        self.mlp = LlamaPerceptron(language)

    def forward(
        self, x: Tensor, rotary: Rotary, mask: Tensor | None, cache: Tensor | None = None, slots: Slots | None = None
    ) -> Tensor:
        """Return the layer's output (B, T, E) for x (B, T, E). `LlamaAttention.forward` explains the arguments."""
        x = x + self.self_attn(self.input_layernorm(x), rotary, mask, cache, slots)
        return x + self.mlp(self.post_attention_layernorm(x))


def run_layers(
    layers: nn.ModuleList,
    language: Language,
    x: Tensor,
    positions: Tensor,
    cache: Cache | None,
    seen: np.ndarray | Tensor | None,
    mask: Tensor | None = None,
) -> Tensor:
    """Run all layers over T new tokens, and return the output (B, T, E) of the last layer.

    Args:
        layers: Layers of the class `LlamaLayer`.
        language: Shape of the language model.
        x: (B, T, E) embeddings of the new tokens.
        positions: (T,) rotary positions of the new tokens.
        cache: Keys and values of earlier tokens. This forward appends the new ones. None: no earlier tokens.
        seen: (T, M) bool, which of the last M tokens, old or new, each new token attends to. None: causal mask.
        mask: Additive mask to use instead of `seen`. None: the mask is made from `seen`.
    """
    rotary = rotation(positions, language.channels, language.rope_theta, x.dtype)
    mask = attention_mask(seen, x.shape[1], cache, x) if mask is None else mask
    slots = cache.next_slots(x.shape[1]) if cache is not None else None
    for i, layer in enumerate(layers):
        x = layer(x, rotary, mask, cache.layers[i] if cache is not None else None, slots)
    if cache is not None:
        cache.length += x.shape[1]
    return x


class LlamaModel(nn.Module):
    """The language model without its head: token embeddings, layers and final norm."""

    def __init__(self, language: Language) -> None:
        super().__init__()
        self.language = language
        self.embed_tokens = nn.Embedding(language.vocab_size, language.hidden_size)
        self.layers = nn.ModuleList(LlamaLayer(language) for _ in range(language.num_hidden_layers))
        self.norm = nn.RMSNorm(language.hidden_size, eps=language.rms_norm_eps)

    def forward(
        self, x: Tensor, positions: Tensor, cache: Cache | None = None, seen: np.ndarray | Tensor | None = None
    ) -> Tensor:
        """Return the hidden states (B, T, E) of embeddings x (B, T, E). `run_layers` explains the arguments."""
        return self.norm(run_layers(self.layers, self.language, x, positions, cache, seen))


class LanguageModel(nn.Module):
    """The language model with its head, which gives a logit for every id of the vocabulary."""

    def __init__(self, language: Language) -> None:
        super().__init__()
        self.model = LlamaModel(language)
        self.lm_head = nn.Linear(language.hidden_size, language.vocab_size, bias=False)


class Int8Linear(nn.Module):
    """A linear layer whose weights are int8 with a scale per output. It takes half the memory of bfloat16.

    The matrix multiplication is computed in the number format of the input.

    Attributes:
        weight: (outputs, inputs) int8.
        scale: (outputs,) factors of the weights.
    """

    weight: Tensor
    scale: Tensor

    def __init__(self, weight: Tensor, dtype: torch.dtype) -> None:
        """Round weights to int8. In each row, 127 stands for the row's largest absolute value.

        Args:
            weight: (outputs, inputs) floats.
            dtype: Number format of the scales.
        """
        super().__init__()
        scale = weight.float().abs().amax(1).clamp_min(1e-12) / 127
        self.register_buffer("weight", (weight.float() / scale[:, None]).round().to(torch.int8))
        self.register_buffer("scale", scale.to(dtype))

    def forward(self, x: Tensor) -> Tensor:
        """Map inputs (…, inputs) to outputs (…, outputs)."""
        return F.linear(x, self.weight.to(x.dtype)) * self.scale


def quantise(module: nn.Module) -> None:
    """Replace every linear layer inside a module by an `Int8Linear`."""
    for name, child in module.named_children():
        if isinstance(child, nn.Linear):
            setattr(module, name, Int8Linear(child.weight.data, child.weight.dtype))
        else:
            quantise(child)
