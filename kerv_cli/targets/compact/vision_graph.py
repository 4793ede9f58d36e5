"""A vision encoder for one frame as a graph of ONNX Runtime, exported from its module.

Convolutions of so few channels are small: oneDNN takes 19 µs per call before it computes anything, and a scout's stem
has eleven (measured on an AMD EPYC, 96 × 96 pixels, 8 channels: 607 µs by oneDNN, 270 µs by the graph).
"""

from __future__ import annotations

import io
import warnings
from typing import Any

import onnxruntime
import torch
from torch import Tensor, nn

OPSET = 17


class PackedVision:
    """The graph, computed with as many threads as torch has when it is made. It copies and pickles as None."""

    def __init__(self, encoder: nn.Module, size: int) -> None:
        """size: pixels per side of a frame."""
        exported, options = io.BytesIO(), onnxruntime.SessionOptions()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the exporter by tracing is called old; the new one takes ten seconds
            frame = torch.zeros(1, 3, size, size, dtype=torch.uint8)
            names: Any = {"f": exported, "input_names": ["frame"], "opset_version": OPSET, "dynamo": False}
            torch.onnx.export(encoder, (frame,), **names)
        options.intra_op_num_threads, options.inter_op_num_threads = torch.get_num_threads(), 1
        options.log_severity_level = 3
        providers = ["CPUExecutionProvider"]
        self.session = onnxruntime.InferenceSession(exported.getvalue(), options, providers=providers)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(None), ()

    def __call__(self, images: Tensor) -> list[Tensor]:
        """images (1, 3, size, size) uint8 -> tokens (1, grid², E), points (1, 2K)."""
        return [torch.from_numpy(found) for found in self.session.run(None, {"frame": images.numpy()})]
