"""The vision stem on a frozen CPU model: channels-last maps, blocked weights, heat maps summed from coarse to fine."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from kerv_cli.targets.compact.inference import FastConv, Plan
from kerv_cli.targets.compact.vision import Residual, VisionEncoder


class StagePlan:
    """A strided convolution and the residual block behind it."""

    def __init__(self, stage: nn.Sequential, size: int, weight: Tensor | None = None) -> None:
        entry, block = stage
        assert isinstance(entry, nn.Conv2d)
        residual: Residual = block  # type: ignore[assignment]
        self.entry = FastConv(entry, size, weight)
        self.norm = residual.norm
        self.first, self.second = (FastConv(c, size // entry.stride[0]) for c in (residual.first, residual.second))

    def __call__(self, x: Tensor) -> Tensor:
        x = self.entry(x)
        return self.second.added_to(x, self.first(self.norm(x), "relu"))


class VisionPlan(Plan):
    """As `VisionEncoder.forward` for one frame, but from pixels in 0…255.

    Softmax is taken to the base 2, which the temperature absorbs: 2^x is a fast vector loop where MKL's e^x is not
    (measured on an AMD CPU, 48 × 48 × 32 numbers: 12 µs against 48 µs).
    """

    def __init__(self, vision: VisionEncoder) -> None:
        entry = vision.fine[0]
        assert isinstance(entry, nn.Conv2d)
        height = vision.columns.shape[0]
        self.size = 2 * height
        self.fine = StagePlan(vision.fine, self.size, entry.weight / 255)
        self.middle = StagePlan(vision.middle, self.size // 2)
        self.coarse = StagePlan(vision.coarse, self.size // 4)
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
