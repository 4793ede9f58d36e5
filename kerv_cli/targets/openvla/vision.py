"""The two vision towers of OpenVLA, DINOv2 ViT-L/14 with registers and SigLIP So400m/14, and the projector after them.

Modules have the names that published checkpoints use. Weights without effect are left out: the last block of each tower
(OpenVLA takes the output of the last but one), the norm after it and SigLIP's pooling head.

Shapes: B images of h × w pixels, n patches, W width of a tower, E width of the language model.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.openvla.config import Shape, Tower

EPSILON = 1e-6  # of every layer norm


def named(**layers: nn.Module) -> nn.Sequential:
    """Return the layers in sequence. Each keyword names its layer, and so the layer's weights."""
    return nn.Sequential(OrderedDict(layers))


class Attention(nn.Module):
    """Self-attention with one projection for queries, keys and values."""

    def __init__(self, tower: Tower) -> None:
        super().__init__()
        self.heads = tower.heads
        self.qkv = nn.Linear(tower.width, 3 * tower.width)
        self.proj = nn.Linear(tower.width, tower.width)

    def forward(self, x: Tensor) -> Tensor:
        """Return the attention's output (B, n, W) for x (B, n, W)."""
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
        """Multiply each channel of x (B, n, W) by its factor."""
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
        """Return the block's output (B, n, W) for x (B, n, W)."""
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
        """Map normalised images (B, 3, h, w) to patch tokens (B, n, W).

        Position embeddings are added to patches only, not to the class token and the registers.
        """
        x = self.patch_embed(pixels).flatten(2).transpose(1, 2) + self.pos_embed
        if self.prefix:
            front = torch.cat([self.cls_token, self.reg_token], 1).expand(len(x), -1, -1)
            x = torch.cat([front, x], 1)
        for block in self.blocks:
            x = block(x)
        return x[:, self.prefix :]


class VisionBackbone(nn.Module):
    """Both vision towers. Their outputs are concatenated."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.featurizer, self.fused_featurizer = (VisionTower(tower) for tower in shape.towers)

    def forward(self, pixels: Tensor) -> Tensor:
        """Map images (B, 6, h, w), three channels for each tower, to patch tokens (B, n, sum of both widths)."""
        return torch.cat([self.featurizer(pixels[:, :3]), self.fused_featurizer(pixels[:, 3:])], -1)


def projector(shape: Shape) -> nn.Sequential:
    """Return the layers that map patch tokens (B, n, both towers' widths) to the language model's tokens (B, n, E)."""
    width, hidden = sum(tower.width for tower in shape.towers), shape.language.hidden_size
    first, second, third = nn.Linear(width, 4 * width), nn.Linear(4 * width, hidden), nn.Linear(hidden, hidden)
    return named(fc1=first, gelu1=nn.GELU(), fc2=second, gelu2=nn.GELU(), fc3=third)
