"""Networks of a frozen float32 policy as ONNX graphs, each computed by ONNX Runtime in one call on a CPU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from kerv_cli.targets.compact.packable import Packed

OPSET, IR = 17, 8


class Graph:
    """Nodes and constants of a graph; every method adds nodes and returns the name of what they compute."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, value: Tensor | np.ndarray) -> str:
        """A constant of the graph."""
        array = value.detach().numpy() if isinstance(value, Tensor) else value
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(array), f"constant{len(self.constants)}"))
        return self.constants[-1].name

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """A node with one output, of an ONNX operator."""
        name = f"{operator}{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [name], **attributes))
        return name

    def shaped(self, x: str, *shape: int) -> str:
        """x in another shape."""
        return self.add("Reshape", x, self.constant(np.array(shape, np.int64)))

    def linear(self, x: str, weight: Tensor, bias: Tensor) -> str:
        """x (n, I) -> (n, O), of a weight (O, I)."""
        return self.add("Gemm", x, self.constant(weight), self.constant(bias), transB=1)

    def silu(self, x: str) -> str:
        """x · sigmoid(x)."""
        return self.add("Mul", x, self.add("Sigmoid", x))

    def conv(self, x: str, conv: nn.Conv2d, factor: Tensor | float = 1.0, scale: float = 1.0) -> str:
        """A convolution whose outputs are multiplied by `factor` (C,), of an input divided by `scale`."""
        assert conv.bias is not None
        of_output = factor if isinstance(factor, float) else factor[:, None, None, None]
        weight, bias = conv.weight * of_output / scale, conv.bias * factor
        pads = [int(p) for p in conv.padding] * 2
        strides, shape = list(conv.stride), list(conv.kernel_size)
        return self.add(
            "Conv", x, self.constant(weight), self.constant(bias), kernel_shape=shape, strides=strides, pads=pads
        )

    def norm(self, x: str, norm: nn.GroupNorm, size: int) -> str:
        """A norm of maps (1, C, size, size), channel by channel or in groups."""
        groups, channels = norm.num_groups, norm.num_channels
        if groups == channels:
            weight, bias = self.constant(norm.weight), self.constant(norm.bias)
            return self.add("InstanceNormalization", x, weight, bias, epsilon=norm.eps)
        ones, zeros = self.constant(torch.ones(groups)), self.constant(torch.zeros(groups))
        grouped = self.shaped(x, 1, groups, -1)
        grouped = self.add("InstanceNormalization", grouped, ones, zeros, epsilon=norm.eps)
        normed = self.add(
            "Mul", self.shaped(grouped, 1, channels, size, size), self.constant(norm.weight[:, None, None])
        )
        return self.add("Add", normed, self.constant(norm.bias[:, None, None]))

    def stage(self, x: str, stage: nn.Sequential, size: int, scale: float = 1.0) -> str:
        """A strided convolution and the residual block behind it, which works on maps of `size`."""
        entry: Any = stage[0]
        residual: Any = stage[1]
        x = self.conv(x, entry, scale=scale)
        inner = self.add("Relu", self.conv(self.norm(x, residual.norm, size), residual.first))
        return self.add("Add", x, self.conv(inner, residual.second))

    def upsampled(self, x: str) -> str:
        """Maps of twice the size, each cell four times."""
        twice = self.constant(np.array([1, 1, 2, 2], np.float32))
        how = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
        return self.add("Resize", x, "", twice, **how)


class Session(Packed):
    """A graph that is computed with as many threads as torch has when it is made.

    inputs: name -> number format and shape. outputs: names, of the graph's nodes.
    """

    def __init__(self, graph: Graph, inputs: Mapping[str, tuple[int, Sequence[int | None]]], *outputs: str) -> None:
        taken = [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in inputs.items()]
        given = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs]
        body = helper.make_graph(graph.nodes, "kerv", taken, given, graph.constants)
        model = helper.make_model(body, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = torch.get_num_threads(), 1
        options.log_severity_level = 3
        self.session = onnxruntime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )

    def run(self, **inputs: Tensor) -> list[Tensor]:
        """The outputs for these inputs."""
        arrays = {name: np.ascontiguousarray(value.numpy()) for name, value in inputs.items()}
        return [torch.from_numpy(output) for output in self.session.run(None, arrays)]
