"""The vision encoder: a small convolutional network that turns an image into vision tokens and image points.

The vision tokens are a coarse grid for the trunk. The K image points are found by spatial soft-argmax (Finn et al.
2016) on the finest feature map, because success depends on the exact position of markers that are 4 pixels wide.

Shapes: B images, h × w pixels or cells, C channels, E width of the trunk.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.compact.program import Compilable


class Residual(nn.Module):
    """Residual block: a norm and two 3 × 3 convolutions.

    Args:
        channels: C, number of channels.
        norm: `group` normalises eight groups of channels. `instance` normalises each channel by itself, which makes the
            output least sensitive to light and colour. Both have weights of the same shapes.
    """

    def __init__(self, channels: int, norm: str = "group") -> None:
        super().__init__()
        self.norm = nn.GroupNorm(channels if norm == "instance" else 8, channels)
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Return the block's output (B, C, h, w) for x (B, C, h, w)."""
        return x + self.second(F.relu(self.first(self.norm(x))))


class VisionEncoder(Compilable):
    """The vision encoder of one camera view (docs/methods.md §0.1).

    Args:
        size: Pixels per side of the image.
        grid: Vision tokens per side.
        keypoints: K, number of image points.
        channels: Channels of the first stage. The second stage has twice as many, the third four times as many.
        width: E, width of a vision token.
        norm: Norm of the residual blocks, `group` or `instance`.
    """

    columns: Tensor
    compiled: Callable[[Tensor], list[Tensor]] | None

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

    def new_program(self) -> Callable[[Tensor], list[Tensor]] | None:
        """Return this encoder as a `PackedVision`, which encodes single images. None if the weights are not float32."""
        return PackedVision(self, 2 * len(self.columns)) if self.columns.dtype == torch.float32 else None

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Map images (B, 3, size, size) uint8 to vision tokens (B, grid², E) and image points (B, 2K) in [-1, 1]."""
        if self.compiled is not None and len(images) == 1:
            tokens, points = self.compiled(images)
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
        """Return the image points of K heat maps (B, K, h, w): the expected column and row under each map's softmax.

        Returns:
            (B, 2K) in [-1, 1]: all columns, then all rows.
        """
        batch, keypoints, height, width = heat.shape
        scaled = heat.float() * self.temperature[:, None, None].float()
        weight = scaled.flatten(2).softmax(-1).view(batch, keypoints, height, width)
        x = (weight.sum(2) * self.columns).sum(-1)
        y = (weight.sum(3) * self.columns).sum(-1)
        return torch.cat([x, y], -1)


class PackedVision:
    """A vision encoder for one image, in ONNX Runtime, which is faster than torch on a CPU for small convolutions.

    torch calls oneDNN for each convolution, and a call takes 19 µs before it computes anything. The encoder of the
    smallest drafter has eleven convolutions. Measured on an AMD EPYC, 96 × 96 pixels, 8 channels: 607 µs in torch,
    270 µs here.

    The session uses as many threads as torch has at the time of the export.
    """

    def __init__(self, encoder: nn.Module, size: int) -> None:
        """Export an encoder to ONNX, and open a session that runs it.

        Args:
            encoder: Maps images (1, 3, size, size) uint8 to tokens and points.
            size: Pixels per side of an image.
        """
        import onnxruntime  # needed only on a CPU

        exported, options = io.BytesIO(), onnxruntime.SessionOptions()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # this exporter is deprecated, but the new one takes ten seconds
            frame = torch.zeros(1, 3, size, size, dtype=torch.uint8)
            names: Any = {"f": exported, "input_names": ["frame"], "opset_version": 17, "dynamo": False}
            torch.onnx.export(encoder, (frame,), **names)
        options.intra_op_num_threads, options.inter_op_num_threads = torch.get_num_threads(), 1
        options.log_severity_level = 3
        providers = ["CPUExecutionProvider"]
        self.session = onnxruntime.InferenceSession(exported.getvalue(), options, providers=providers)

    def __call__(self, images: Tensor) -> list[Tensor]:
        """Map an image (1, 3, size, size) uint8 to vision tokens (1, grid², E) and K image points (1, 2K)."""
        return [torch.from_numpy(found) for found in self.session.run(None, {"frame": images.numpy()})]
