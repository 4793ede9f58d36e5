"""The vision tower of OpenVLA: DINOv2 ViT-L/14 with registers and SigLIP So400m/14, and the projector after both.

Modules are named as in the published checkpoints. The towers leave out what has no effect: the last block of each
(OpenVLA takes the output of the last but one), the norm after it and SigLIP's pooling head.

Shapes: B batch, n patches, W width of a tower, E width of the language model.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.openvla.config import Shape, Tower

EPSILON = 1e-6  # of every layer norm


class PatchEmbedding(nn.Module):
    """Embeds patches by a convolution."""

    def __init__(self, tower: Tower) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, tower.width, tower.patch, stride=tower.patch)

    def forward(self, pixels: Tensor) -> Tensor:
        """Map pixels (B, 3, h, w) to patches (B, n, W)."""
        return self.proj(pixels).flatten(2).transpose(1, 2)


class Attention(nn.Module):
    """Self-attention with one projection for queries, keys and values."""

    def __init__(self, tower: Tower) -> None:
        super().__init__()
        self.heads = tower.heads
        self.qkv = nn.Linear(tower.width, 3 * tower.width)
        self.proj = nn.Linear(tower.width, tower.width)

    def forward(self, x: Tensor) -> Tensor:
        """Map x (B, n, W) to (B, n, W)."""
        batch, tokens, width = x.shape
        q, k, v = self.qkv(x).view(batch, tokens, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        attended = F.scaled_dot_product_attention(q, k, v)
        return self.proj(attended.transpose(1, 2).reshape(batch, tokens, width))


class Perceptron(nn.Module):
    """Two layers with the exact GELU, in both towers (timm's SigLIP differs from transformers' in this)."""

    def __init__(self, tower: Tower) -> None:
        super().__init__()
        self.fc1 = nn.Linear(tower.width, tower.feed_forward)
        self.fc2 = nn.Linear(tower.feed_forward, tower.width)

    def forward(self, x: Tensor) -> Tensor:
        """Map x (B, n, W) to (B, n, W)."""
        return self.fc2(F.gelu(self.fc1(x)))


class LayerScale(nn.Module):
    """A learned factor per channel."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale_factor = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        """Scale x (B, n, W)."""
        return x * self.scale_factor


class Block(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, tower: Tower) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(tower.width, eps=EPSILON)
        self.attn = Attention(tower)
        self.norm2 = nn.LayerNorm(tower.width, eps=EPSILON)
        self.mlp = Perceptron(tower)
        self.ls1, self.ls2 = (LayerScale(tower.width) if tower.scaled else nn.Identity() for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        """Map x (B, n, W) to (B, n, W)."""
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class VisionTower(nn.Module):
    """One tower up to its last but one block."""

    def __init__(self, tower: Tower) -> None:
        super().__init__()
        self.prefix = tower.prefix
        if tower.scaled:
            self.cls_token = nn.Parameter(torch.zeros(1, 1, tower.width))
            self.reg_token = nn.Parameter(torch.zeros(1, tower.registers, tower.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, tower.patches, tower.width))
        self.patch_embed = PatchEmbedding(tower)
        self.blocks = nn.ModuleList(Block(tower) for _ in range(tower.depth - 1))

    def forward(self, pixels: Tensor) -> Tensor:
        """Map normalised pixels (B, 3, h, w) to patches (B, n, W). Only patches get positions."""
        x = self.patch_embed(pixels) + self.pos_embed
        if self.prefix:
            front = torch.cat([self.cls_token, self.reg_token], 1).expand(len(x), -1, -1)
            x = torch.cat([front, x], 1)
        for block in self.blocks:
            x = block(x)
        return x[:, self.prefix :]


class VisionBackbone(nn.Module):
    """Both towers side by side."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.featurizer, self.fused_featurizer = (VisionTower(tower) for tower in shape.towers)

    def forward(self, pixels: Tensor) -> Tensor:
        """Map pixels (B, 6, h, w), three channels for each tower, to patches (B, n, W + W')."""
        return torch.cat([self.featurizer(pixels[:, :3]), self.fused_featurizer(pixels[:, 3:])], -1)


class Projector(nn.Module):
    """Three layers, the first four times as wide as its input."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        width, hidden = shape.vision_width, shape.language.hidden_size
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, hidden)
        self.fc3 = nn.Linear(hidden, hidden)

    def forward(self, patches: Tensor) -> Tensor:
        """Map patches (B, n, W + W') to embeddings (B, n, E)."""
        return self.fc3(F.gelu(self.fc2(F.gelu(self.fc1(patches)))))
