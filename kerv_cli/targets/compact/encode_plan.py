"""The prompt of one observation on a frozen CPU vision policy: what is affine in the scene is one small product."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.targets.compact.inference import Plan
from kerv_cli.targets.compact.target import Inputs, Target

Affine = tuple[Tensor, Tensor]  # bias (O,), weight (I, O)
SATURATING = [10 + 6 * vector + 3 + axis for vector in range(3) for axis in range(3)]  # columns of `scene_features`
STRAIGHT = [column for column in range(28) if column not in SATURATING]


def hand_features(x: Tensor, centre: Tensor) -> Tensor:
    return torch.cat([(x[:, :3] - centre) / 0.1, x[:, 3:]], -1)


def scene_lines(x: Tensor, centre: Tensor) -> Tensor:
    """x (n, 10), state and positions -> (n, 28): `scene_features` before SATURATING columns do, and these last."""
    hand, thing, goal = x[:, :3], x[:, 4:7], x[:, 7:]
    places = [hand_features(x[:, :4], centre), (thing - centre) / 0.1, (goal - centre) / 0.1]
    vectors = torch.cat([thing - hand, goal - hand, goal - thing], -1)
    return torch.cat([*places, vectors / 0.1, vectors / 0.02], -1)


def affine(function: Callable[[Tensor], Tensor], inputs: int) -> Affine:
    """(1, I) -> (1, O), known to be affine, as bias and weight; asked in float64."""
    offset = function(torch.zeros(1, inputs, dtype=torch.float64))
    weight = function(torch.eye(inputs, dtype=torch.float64)) - offset
    return offset[0].float(), weight.float()


def affines(layers: nn.Module) -> list[Affine]:
    return [(part.bias, part.weight.t().contiguous()) for part in layers.children() if isinstance(part, nn.Linear)]


def perceptron(x: Tensor, layers: list[Affine]) -> Tensor:
    """x (1, I) through products with SiLU between them."""
    for bias, weight in layers[:-1]:
        x = torch.addmm(bias, x, weight)
        F.silu(x, inplace=True)
    return torch.addmm(layers[-1][0], x, layers[-1][1])


class EncodePlan(Plan):
    def __init__(self, target: Target) -> None:
        centre = target.centre.double()
        self.vision, self.words = target.vision, target.word_embedding
        self.tokens = target.settings.scene_tokens
        self.hand = affine(lambda x: hand_features(x, centre), 4)
        self.lines = affine(lambda x: scene_lines(x, centre), 10)
        self.scene = affines(target.scene)
        self.scene[0] = (self.scene[0][0], self.scene[0][1][STRAIGHT + SATURATING].contiguous())
        self.proprioception = affines(target.proprioception)
        self.locate = affines(target.locate)
        bias, weight = self.locate[-1]
        self.locate[-1] = (bias * 0.1 + target.centre.repeat(2), weight * 0.1)

    def __call__(self, inputs: Inputs) -> tuple[Tensor, Tensor]:
        """As `Target.encode`, for one observation."""
        words = self.words(inputs.words)
        state = inputs.states[:, :4]
        hand = torch.addmm(self.hand[0], state, self.hand[1])
        tokens, points = self.vision(inputs.images)
        positions = perceptron(torch.cat([points, hand, words.mean(1)], -1), self.locate)
        features = torch.addmm(self.lines[0], torch.cat([state, positions], -1), self.lines[1])
        features[:, len(STRAIGHT) :].tanh_()
        scene = perceptron(features, self.scene).view(1, self.tokens, -1)
        return torch.cat([tokens, words, scene, perceptron(hand, self.proprioception)[None]], 1), positions
