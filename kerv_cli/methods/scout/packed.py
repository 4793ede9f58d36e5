"""A scout in one call of ONNX Runtime, from one observation to the logits of a chunk.

Its sixty small operations cost more as calls than as sums, above all behind a step of the simulator, which leaves no
cache warm.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from onnx import TensorProto
from torch import Tensor, nn

from kerv_cli.methods.early.packed import add_drafter
from kerv_cli.targets.compact.features import hand_features, saturating_columns
from kerv_cli.targets.compact.graph import Graph, Session
from kerv_cli.targets.compact.packed import affine, affine_scene
from kerv_cli.targets.compact.target import Inputs
from kerv_cli.targets.compact.vision_graph import add_vision


class PackedScout(Session):
    """`Scout.forward` for one observation."""

    def __init__(self, scout: Any) -> None:
        """scout: a `Scout`."""
        graph, size, p = Graph(), scout.size, len(scout.observation.proprioception)
        places, centre = len(scout.observation.places), scout.centre.double()
        edges = [graph.constant(np.array([size * view])) for view in range(len(scout.stems) + 1)]
        axis = graph.constant(np.array([3]))
        frames = [graph.add("Slice", "frame", first, last, axis) for first, last in pairwise(edges)]
        views = [add_vision(graph, frame, stem) for frame, stem in zip(frames, scout.stems, strict=True)]
        embedded = graph.add("Gather", graph.constant(scout.words.weight), "words")
        words = graph.add("ReduceMean", embedded, axes=[1], keepdims=0)
        cells: list[str] = []
        for tokens, _ in views:
            rows = graph.linear(
                graph.shaped(tokens, -1, scout.settings.cell_width), scout.cells.weight, scout.cells.bias
            )
            cells += [graph.add("ReduceMean", tokens, axes=[1], keepdims=0), graph.shaped(rows, 1, -1)]
        bias, weight = affine(lambda x: hand_features(x, centre), p)
        hand = graph.linear("proprioception", weight.t(), bias)
        located = graph.add("Concat", *(points for _, points in views), hand, words, axis=1)
        located = add_perceptron(graph, located, scout.locate, 0.1, scout.centre.repeat(places))
        bias, weight = affine_scene(p, places, centre)
        lines = graph.linear(graph.add("Concat", "proprioception", located, axis=1), weight.t(), bias)
        saturates = np.isin(np.arange(len(bias)), saturating_columns(scout.observation))[None]
        scene = graph.add("Where", graph.constant(saturates), graph.add("Tanh", lines), lines)
        logits = add_drafter(graph, graph.add("Concat", *cells, words, scene, axis=1), scout.drafter)
        inputs: dict[str, tuple[int, list[int | None]]] = {
            "frame": (TensorProto.UINT8, [1, 3, size, size * len(views)]),
            "proprioception": (TensorProto.FLOAT, [1, p]),
            "words": (TensorProto.INT64, [1, None]),
        }
        super().__init__(graph, inputs, logits, graph.shaped(located, 1, places, 3))

    def __call__(self, inputs: Inputs) -> tuple[Tensor, Tensor]:
        """One observation -> logits (1, N, V), positions (1, K, 3)."""
        assert inputs.images is not None
        logits, places = self.run(frame=inputs.images, proprioception=inputs.proprioception, words=inputs.words)
        return logits, places


def add_perceptron(graph: Graph, x: str, net: nn.Sequential, scale: float, offset: Tensor) -> str:
    """x (1, I) through linear layers with SiLU between them, times `scale`, plus `offset` (O,)."""
    *layers, last = (layer for layer in net if isinstance(layer, nn.Linear))
    for layer in layers:
        x = graph.silu(graph.linear(x, layer.weight, layer.bias))
    return graph.linear(x, last.weight * scale, last.bias * scale + offset)
