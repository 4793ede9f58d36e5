"""Frames -> vision tokens and image points.

A small convolutional stem. Two things leave it: a coarse grid of tokens for the trunk, and K image points by spatial
soft-argmax (Finn et al. 2016) on the finest map, because success depends on the position of markers of 4 pixels.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.compact.packable import Packable


class Residual(nn.Module):
    """Residual block: a norm and two 3 × 3 convolutions. norm: instance (every channel is normalised by itself, which
    light and colour change least) or group (eight groups of channels); the weights have the same shapes."""

    def __init__(self, channels: int, norm: str = "group") -> None:
        super().__init__()
        self.norm = nn.GroupNorm(channels if norm == "instance" else 8, channels)
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """x (B, C, h, w) -> the same shape."""
        return x + self.second(F.relu(self.first(self.norm(x))))


class VisionEncoder(Packable):
    """The convolutional stem. size: of a view, pixels. grid: vision tokens per side. keypoints: K. channels: of the
    first stage. width: E. norm: of its residual blocks."""

    columns: Tensor
    packed: Callable[[Tensor], list[Tensor]] | None

    def __init__(self, size: int, grid: int, keypoints: int, channels: int, width: int, norm: str = "group") -> None:
        super().__init__()
        c, coarse = channels, size // 8
        self.fine = nn.Sequential(nn.Conv2d(3, c, 5, stride=2, padding=2), Residual(c, norm))
        self.middle = nn.Sequential(nn.Conv2d(c, 2 * c, 3, stride=2, padding=1), Residual(2 * c, norm))
        self.coarse = nn.Sequential(nn.Conv2d(2 * c, 4 * c, 3, stride=2, padding=1), Residual(4 * c, norm))
        self.heat_fine = nn.Conv2d(c, keypoints, 3, padding=1)
        self.heat_middle = nn.Conv2d(2 * c, keypoints, 1)
        self.heat_coarse = nn.Conv2d(4 * c, keypoints, 1)
        self.patch = nn.Conv2d(4 * c, width, coarse // grid, stride=coarse // grid)
        self.grid_position = nn.Parameter(torch.randn(grid * grid, width) * 0.02)
        self.temperature = nn.Parameter(torch.ones(keypoints) * 2.0)
        self.register_buffer("columns", torch.linspace(-1, 1, size // 2), persistent=False)

    def pack_weights(self) -> Callable[[Tensor], list[Tensor]] | None:
        """Return the encoder of one frame as a graph of ONNX Runtime; None in other formats than float32."""
        from kerv_cli.targets.compact.vision_graph import PackedVision  # ONNX Runtime, which a GPU does not need

        return PackedVision(self, 2 * len(self.columns)) if self.columns.dtype == torch.float32 else None

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """images (B, 3, size, size) uint8 -> tokens (B, grid², E), points (B, 2K) in [-1, 1]."""
        if self.packed is not None and len(images) == 1:
            tokens, points = self.packed(images)
            return tokens, points
        images = images.to(self.patch.weight.dtype) / 255.0 - 0.5
        fine = self.fine(images)
        middle = self.middle(fine)
        coarse = self.coarse(middle)
        heat = (
            self.heat_fine(fine)
            + F.interpolate(self.heat_middle(middle), scale_factor=2.0, mode="nearest")
            + F.interpolate(self.heat_coarse(coarse), scale_factor=4.0, mode="nearest")
        )
        tokens = self.patch(coarse).flatten(2).transpose(1, 2) + self.grid_position
        return tokens, self.points(heat)

    def points(self, heat: Tensor) -> Tensor:
        """heat maps (B, K, h, w) -> (B, 2K): each map's expected column and row under its softmax, in [-1, 1]."""
        batch, keypoints, height, width = heat.shape
        scaled = heat.float() * self.temperature[:, None, None].float()
        weight = scaled.flatten(2).softmax(-1).view(batch, keypoints, height, width)
        x = (weight.sum(2) * self.columns).sum(-1)
        y = (weight.sum(3) * self.columns).sum(-1)
        return torch.cat([x, y], -1)
