"""The vision encoder as a graph of ONNX Runtime, alone or as a part of a larger graph.

Convolutions of so few channels are small: oneDNN takes 19 µs per call before it computes anything, and a scout's stem
has eleven (measured on an AMD EPYC, 96 × 96 pixels: 8 channels 607 µs by oneDNN, 270 by the graph; 24 channels, as of
the targets, 1 410 and 1 250).
"""

from __future__ import annotations

import numpy as np
import torch
from onnx import TensorProto
from torch import Tensor

from kerv_cli.targets.compact.graph import Graph, Session
from kerv_cli.targets.compact.vision import VisionEncoder


def add_vision(graph: Graph, frame: str, vision: VisionEncoder) -> tuple[str, str]:
    """`VisionEncoder.forward` of one frame (1, 3, size, size) uint8 -> tokens (1, grid², E), points (1, 2K). Heat maps
    are summed from coarse to fine, the temperature is in their weights."""
    side, sharp = vision.columns.shape[0], vision.temperature.detach()
    # the mean cannot move into the bias: the border is padded with zeros behind the subtraction
    mean = graph.constant(np.array(127.5, np.float32))
    pixels = graph.add("Sub", graph.add("Cast", frame, to=TensorProto.FLOAT), mean)
    fine = graph.stage(pixels, vision.fine, side, scale=255.0)
    middle = graph.stage(fine, vision.middle, side // 2)
    coarse = graph.stage(middle, vision.coarse, side // 4)
    heat = graph.conv(coarse, vision.heat_coarse, sharp)
    for finer, conv in ((middle, vision.heat_middle), (fine, vision.heat_fine)):
        heat = graph.add("Add", graph.upsampled(heat), graph.conv(finer, conv, sharp))
    weight = graph.add("Softmax", graph.shaped(heat, -1, side * side), axis=-1)
    column, row = vision.columns.repeat(side), vision.columns.repeat_interleave(side)
    points = graph.add("MatMul", weight, graph.constant(torch.stack([column, row], 1)))
    points = graph.shaped(graph.add("Transpose", points, perm=[1, 0]), 1, -1)
    tokens = graph.shaped(graph.conv(coarse, vision.patch), 1, vision.patch.out_channels, -1)
    tokens = graph.add("Transpose", tokens, perm=[0, 2, 1])
    return graph.add("Add", tokens, graph.constant(vision.grid_position)), points


class PackedVision(Session):
    """`VisionEncoder.forward` for one frame."""

    def __init__(self, vision: VisionEncoder) -> None:
        graph, size = Graph(), 2 * vision.columns.shape[0]
        super().__init__(graph, {"frame": (TensorProto.UINT8, [1, 3, size, size])}, *add_vision(graph, "frame", vision))

    def __call__(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """images (1, 3, size, size) uint8 -> tokens (1, grid², E), points (1, 2K)."""
        tokens, points = self.run(frame=images)
        return tokens, points
