"""The network of OpenVLA: two vision towers, a projector, and Llama-2, which is built from the compact target's trunk.

Weights without effect are left out: the last block of each tower (OpenVLA takes the output of the block before it),
each tower's final norm, and SigLIP's pooling head.

Shapes: B batch, h × w pixels of an image, n patches, W width of a tower.
"""

from __future__ import annotations

import re
from collections import OrderedDict
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.compact.trunk import Trunk
from kerv_cli.targets.openvla.config import Language, Shape, Tower

EPSILON = 1e-6  # of every layer norm
# part of a decoder layer -> the names, in published checkpoints, of the matrices whose rows it holds
LAYER = {
    "attention_norm": ["input_layernorm"],
    "qkv": ["self_attn.q_proj", "self_attn.k_proj", "self_attn.v_proj"],
    "out": ["self_attn.o_proj"],
    "feed_norm": ["post_attention_layernorm"],
    "gate_up": ["mlp.gate_proj", "mlp.up_proj"],
    "down": ["mlp.down_proj"],
}


def published(name: str) -> list[str]:
    """Return the names of the published tensors that, joined along their rows, make the model's tensor `name`."""
    match = re.fullmatch(r"(language_model\.model\.layers\.\d+)\.(\w+)\.weight", name)
    return [f"{match[1]}.{part}.weight" for part in LAYER[match[2]]] if match else [name]


class Llama(Trunk):
    """The language model without its head."""

    def __init__(self, language: Language) -> None:
        sizes = language.num_hidden_layers, language.num_attention_heads, language.intermediate_size
        super().__init__(language.hidden_size, *sizes)
        self.embed_tokens = nn.Embedding(language.vocab_size, language.hidden_size)
        for part in self.modules():
            if isinstance(part, nn.RMSNorm):
                part.eps = language.rms_norm_eps


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
        """Map normalised images (B, 3, h, w) to patch tokens (B, n, W). Other tokens get no position embeddings."""
        x = self.patch_embed(pixels).flatten(2).transpose(1, 2) + self.pos_embed
        if self.prefix:
            front = torch.cat([self.cls_token, self.reg_token], 1).expand(len(x), -1, -1)
            x = torch.cat([front, x], 1)
        for block in self.blocks:
            x = block(x)
        return x[:, self.prefix :]


class VisionBackbone(nn.Module):
    """Both vision towers. Images (B, 6, h, w) have three channels per tower. The towers' outputs are concatenated."""

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
    """All modules of OpenVLA. Tensors have their published names, except in the language model's layers (`LAYER`)."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        language = shape.language
        self.vision_backbone = VisionBackbone(shape)
        self.projector = projector(shape)
        head = nn.Linear(language.hidden_size, language.vocab_size, bias=False)
        self.language_model = named(model=Llama(language), lm_head=head)
