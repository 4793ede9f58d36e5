"""The network of OpenVLA: two vision towers, a projector, and Llama-2 with tree attention over a key/value cache.

Modules have the names that published checkpoints use, so that their weights can be memory-mapped. Weights without
effect are left out: the last block of each tower (OpenVLA takes the output of the block before it), the final norm, and
SigLIP's pooling head.

Shapes: B batch, T new tokens, S cached tokens, E width of the language model, A heads, K heads of keys and values, C
channels of a head; h × w pixels of an image, n patches, W width of a tower.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.engine.protocol import Seen
from kerv_cli.targets.attention import Cache, Rotation, Slots, attend, attention_mask, rotate
from kerv_cli.targets.openvla.config import Language, Shape, Tower

EPSILON = 1e-6  # of every layer norm


def rotation(positions: Tensor, channels: int, theta: float, dtype: torch.dtype) -> Rotation:
    """Return the cosines and sines (T, C) at positions (T,) in half-split layout, computed in float32.

    In the first half of the channels the sines have the reversed sign, as `attention.rotate` requires.
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
        self, x: Tensor, rotary: Rotation, mask: Tensor | None, cache: Tensor | None = None, slots: Slots = None
    ) -> Tensor:
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
        return self.down_proj(F.silu(self.gate_proj(x)) * self.up_proj(x))


class LlamaLayer(nn.Module):
    """One pre-norm decoder layer."""

    def __init__(self, language: Language) -> None:
        super().__init__()
        width, epsilon = language.hidden_size, language.rms_norm_eps
        self.input_layernorm = nn.RMSNorm(width, eps=epsilon)
        self.self_attn = LlamaAttention(language)
        self.post_attention_layernorm = nn.RMSNorm(width, eps=epsilon)
        self.mlp = LlamaPerceptron(language)

    def forward(
        self, x: Tensor, rotary: Rotation, mask: Tensor | None, cache: Tensor | None = None, slots: Slots = None
    ) -> Tensor:
        """Return the layer's output (B, T, E) for x (B, T, E). `cache` (2, B, K, capacity, C) is this layer's."""
        x = x + self.self_attn(self.input_layernorm(x), rotary, mask, cache, slots)
        return x + self.mlp(self.post_attention_layernorm(x))


class LlamaModel(nn.Module):
    """The language model without its head: token embeddings, layers and final norm."""

    def __init__(self, language: Language) -> None:
        super().__init__()
        self.language = language
        self.embed_tokens = nn.Embedding(language.vocab_size, language.hidden_size)
        self.layers = nn.ModuleList(LlamaLayer(language) for _ in range(language.num_hidden_layers))
        self.norm = nn.RMSNorm(language.hidden_size, eps=language.rms_norm_eps)

    def forward(self, x: Tensor, positions: Tensor, cache: Cache | None = None, seen: Seen = None) -> Tensor:
        language, tokens = self.language, x.shape[1]
        mask = attention_mask(seen, tokens, cache, x)
        rotary = rotation(positions, language.channels, language.rope_theta, x.dtype)
        slots = cache.next_slots(tokens) if cache is not None else None
        for i, layer in enumerate(self.layers):
            x = layer(x, rotary, mask, cache.layers[i] if cache is not None else None, slots)
        if cache is not None:
            cache.length += tokens
        return self.norm(x)


class LanguageModel(nn.Module):
    """The language model with its head, which gives a logit for every id of the vocabulary."""

    def __init__(self, language: Language) -> None:
        super().__init__()
        self.model = LlamaModel(language)
        self.lm_head = nn.Linear(language.hidden_size, language.vocab_size, bias=False)


def named(**layers: nn.Module) -> nn.Sequential:
    return nn.Sequential(OrderedDict(layers))


class Attention(nn.Module):
    """Self-attention with one projection for queries, keys and values."""

    def __init__(self, tower: Tower) -> None:
        super().__init__()
        self.heads = tower.heads
        self.qkv = nn.Linear(tower.width, 3 * tower.width)
        self.proj = nn.Linear(tower.width, tower.width)

    def forward(self, x: Tensor) -> Tensor:
        batch, tokens, width = x.shape
        q, k, v = self.qkv(x).view(batch, tokens, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        attended = F.scaled_dot_product_attention(q, k, v)
        return self.proj(attended.transpose(1, 2).reshape(batch, tokens, width))


class LayerScale(nn.Module):
    """A learned factor per channel."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale_factor = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.scale_factor


class Block(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, tower: Tower) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(tower.width, eps=EPSILON)
        self.attn = Attention(tower)
        self.norm2 = nn.LayerNorm(tower.width, eps=EPSILON)
        # the exact GELU in both towers, as in timm; the SigLIP of transformers approximates it
        width, hidden = tower.width, tower.feed_forward
        self.mlp = named(fc1=nn.Linear(width, hidden), gelu=nn.GELU(), fc2=nn.Linear(hidden, width))
        scale = partial(LayerScale, tower.width) if tower.scaled else nn.Identity
        self.ls1, self.ls2 = scale(), scale()

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class VisionTower(nn.Module):
    """One vision tower, without its last block."""

    def __init__(self, tower: Tower) -> None:
        super().__init__()
        self.prefix = tower.prefix
        if tower.scaled:
            self.cls_token = nn.Parameter(torch.zeros(1, 1, tower.width))
            self.reg_token = nn.Parameter(torch.zeros(1, tower.registers, tower.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, tower.patches, tower.width))
        self.patch_embed = named(proj=nn.Conv2d(3, tower.width, tower.patch, stride=tower.patch))
        self.blocks = nn.ModuleList(Block(tower) for _ in range(tower.depth - 1))

    def forward(self, pixels: Tensor) -> Tensor:
        """Map normalised images (B, 3, h, w) to patch tokens (B, n, W). Only patches get position embeddings."""
        x = self.patch_embed(pixels).flatten(2).transpose(1, 2) + self.pos_embed
        if self.prefix:
            front = torch.cat([self.cls_token, self.reg_token], 1).expand(len(x), -1, -1)
            x = torch.cat([front, x], 1)
        for block in self.blocks:
            x = block(x)
        return x[:, self.prefix :]


class VisionBackbone(nn.Module):
    """Both vision towers. Images (B, 6, h, w) have three channels for each. Their outputs are concatenated."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.featurizer, self.fused_featurizer = (VisionTower(tower) for tower in shape.towers)

    def forward(self, pixels: Tensor) -> Tensor:
        return torch.cat([self.featurizer(pixels[:, :3]), self.fused_featurizer(pixels[:, 3:])], -1)


def projector(shape: Shape) -> nn.Sequential:
    width, hidden = sum(tower.width for tower in shape.towers), shape.language.hidden_size
    first, second, third = nn.Linear(width, 4 * width), nn.Linear(4 * width, hidden), nn.Linear(hidden, hidden)
    return named(fc1=first, gelu1=nn.GELU(), fc2=second, gelu2=nn.GELU(), fc3=third)


class OpenVLAModel(nn.Module):
    """All modules of an OpenVLA. They have the names that published checkpoints use."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.vision_backbone = VisionBackbone(shape)
        self.projector = projector(shape)
        self.language_model = LanguageModel(shape.language)
