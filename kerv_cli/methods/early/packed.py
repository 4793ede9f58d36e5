"""An early drafter in one call of ONNX Runtime, from one pooled prompt to the logits of a chunk."""

from __future__ import annotations

from typing import Any

import numpy as np
from onnx import TensorProto
from torch import Tensor, nn

from kerv_cli.targets.compact.graph import Graph, Session


class PackedEarly(Session):
    """`EarlyDrafter.forward` for one pooled prompt."""

    def __init__(self, early: Any) -> None:
        """early: an `EarlyDrafter`."""
        graph = Graph()
        logits = add_drafter(graph, "features", early)
        super().__init__(graph, {"features": (TensorProto.FLOAT, [1, len(early.mean)])}, logits)

    def __call__(self, features: Tensor) -> Tensor:
        """The pooled prompt (1, F) -> logits (1, N, V)."""
        return self.run(features=features)[0]


def add_drafter(graph: Graph, x: str, drafter: Any) -> str:
    """The network of an `EarlyDrafter`, features (1, F) -> logits (1, N, V); standardisation is in its first layer."""
    weight = drafter.enter.weight * drafter.scale
    x = graph.linear(x, weight, drafter.enter.bias - weight @ drafter.mean)
    for block in drafter.blocks:
        normed, gained = _normed(graph, x, block.norm), block.gate_up.weight * block.norm.weight
        parts = zip(gained.chunk(2), block.gate_up.bias.chunk(2), strict=True)
        gate, up = (graph.linear(normed, weight, bias) for weight, bias in parts)
        inner = graph.add("Mul", graph.silu(gate), up)
        x = graph.add("Add", x, graph.linear(inner, block.down.weight, block.down.bias))
    spread = graph.linear(
        _normed(graph, x, drafter.norm), drafter.spread.weight * drafter.norm.weight, drafter.spread.bias
    )
    rows = graph.shaped(spread, drafter.tokens, drafter.settings.rank)
    return graph.shaped(graph.linear(rows, drafter.head.weight, drafter.head.bias), 1, drafter.tokens, -1)


def _normed(graph: Graph, x: str, norm: nn.RMSNorm) -> str:
    """x (1, W) divided by its root mean square; the gain belongs into the weights behind."""
    mean = graph.add("ReduceMean", graph.add("Mul", x, x), axes=[1], keepdims=1)
    floor = graph.constant(np.array(norm.eps, np.float32))
    return graph.add("Div", x, graph.add("Sqrt", graph.add("Add", mean, floor)))
