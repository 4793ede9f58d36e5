"""Features of what a compact policy observes: words, the scene, the privileged state and images (docs/methods.md §0.1).

A place is a position that matters to the task, such as the position of the object or of the goal. The privileged state
holds numbers that only the simulator knows. The features of places and of the privileged state are scaled to about 1.

The vision encoder is a small convolutional network that turns an image into vision tokens and image points. The vision
tokens are a coarse grid for the trunk. The image points are found by spatial soft-argmax (Finn et al. 2016) on the
finest feature map, because success depends on the exact position of markers that are 4 pixels wide.

Shapes: B batch, p numbers of proprioception, K places or image points, s numbers of privileged state, h × w pixels or
cells, C channels, E width of the trunk.
"""

from __future__ import annotations

import io
import itertools
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import ObservationSpace, Place
from kerv_cli.targets.compact.program import Compilable

COARSE, FINE = 0.1, 0.02  # metres: a vector is divided by COARSE, and before a tanh by FINE
PAD, UNKNOWN = 0, 1  # ids of words
STEP = 0.01  # metres (or units of the state) per control step: velocities are divided by it


def mlp(*widths: int) -> nn.Sequential:
    parts: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        parts += [nn.Linear(inputs, outputs), nn.SiLU()]
    return nn.Sequential(*parts[:-1])


def relative(vector: Tensor) -> Tensor:
    """Return features (…, 6) of vectors v (…, 3) in metres: v / 0.1 m (3 numbers) and tanh(v / 0.02 m) (3 numbers)."""
    return torch.cat([vector / COARSE, torch.tanh(vector / FINE)], -1)


def hand_features(proprioception: Tensor, centre: Tensor) -> Tensor:
    """Return the proprioception (B, p), with the position in it replaced by (position − centre) / 0.1 m."""
    return torch.cat([(proprioception[:, :3] - centre) / COARSE, proprioception[:, 3:]], -1)


def scene_features(proprioception: Tensor, places: Tensor, centre: Tensor) -> Tensor:
    """Return the scene features (B, p + 15 K − 6) of K places (B, K, 3) in metres.

    They hold `hand_features` (p numbers), the K places relative to the centre, divided by 0.1 m (3 K numbers), and 2 K
    − 1 vectors: from the hand to each place, and from each place to the next. `relative` turns each vector into 6
    numbers.
    """
    vectors = torch.cat([places - proprioception[:, None, :3], places[:, 1:] - places[:, :-1]], 1)
    positions = ((places - centre) / COARSE).flatten(1)
    return torch.cat([hand_features(proprioception, centre), positions, relative(vectors).flatten(1)], -1)


def scene_width(space: ObservationSpace) -> int:
    return len(space.proprioception) + 15 * len(space.places) - 6


def privileged_features(proprioception: Tensor, states: Tensor, space: ObservationSpace) -> Tensor:
    """Return features (B, `privileged_width`) for a policy that reads the simulator's states (B, s).

    They hold the state's extra numbers, its velocities (the change in a control step / 0.01, clamped to ±3), and two
    vectors for each extra place: from the hand to the extra place, and from the extra place to the last of
    `space.places`. `relative` turns each vector into 6 numbers.
    """
    hand, last = proprioception[:, :3], position(states, space.places[-1])
    parts = [states[:, list(space.extra)]]
    if space.previous is not None:
        count, first = space.previous
        velocity = (states[:, :count] - states[:, first : first + count]) / STEP
        parts.append(velocity.clamp(-3, 3))
    for place in space.extra_places:
        extra = position(states, place)
        parts += [relative(extra - hand), relative(last - extra)]
    return torch.cat(parts, -1)


def privileged_width(space: ObservationSpace) -> int:
    return len(space.extra) + (space.previous[0] if space.previous else 0) + 12 * len(space.extra_places)


def position(states: Tensor, place: Place) -> Tensor:
    return states[:, place.first : place.first + 3]


def places_of(states: Tensor, space: ObservationSpace) -> Tensor:
    """Return the positions (B, K, 3) of `space.places` in metres."""
    return torch.stack([position(states, place) for place in space.places], 1)


@dataclass(frozen=True)
class WordTokenizer:
    """A fixed vocabulary of whole words, which turns an instruction into one id per word, padded to a fixed length.

    The vocabulary is stored in the checkpoint. It is built from all instructions of the environment, so a policy
    trained on ten tasks can be fine-tuned on fifty without a new embedding.

    Attributes:
        words: The known words. `words[i]` has id i + 2. Id 0 is padding, id 1 stands for any unknown word.
    """

    words: tuple[str, ...]

    @classmethod
    def build(cls, sentences: Iterable[str]) -> WordTokenizer:
        return cls(tuple(sorted({word for s in sentences for word in s.lower().split()})))

    @property
    def size(self) -> int:
        return len(self.words) + 2

    @cached_property
    def index(self) -> dict[str, int]:
        return {word: i + 2 for i, word in enumerate(self.words)}

    def encode(self, sentence: str, length: int) -> list[int]:
        """Return exactly `length` ids for a sentence, with padding at the end."""
        ids = [self.index.get(word, UNKNOWN) for word in sentence.lower().split()]
        if len(ids) > length:
            raise UsageError(f"instruction '{sentence}' has {len(ids)} words, the policy takes {length}: shorten it")
        return ids + [PAD] * (length - len(ids))


class Residual(nn.Module):
    """Residual block: a norm and two 3 × 3 convolutions.

    The norm is `group` (eight groups of channels) or `instance` (each channel by itself). `instance` makes the output
    least sensitive to light and colour. Both norms have weights of the same shapes.
    """

    def __init__(self, channels: int, norm: str = "group") -> None:
        super().__init__()
        self.norm = nn.GroupNorm(channels if norm == "instance" else 8, channels)
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(F.relu(self.first(self.norm(x))))


class VisionEncoder(Compilable):
    """The vision encoder of one camera view (docs/methods.md §0.1).

    Args:
        grid: Vision tokens per side.
        keypoints: K, number of image points.
        channels: Channels of the first stage. The second stage has twice as many, the third four times as many.
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
        return compiled_encoder(self, 2 * len(self.columns)) if self.columns.dtype == torch.float32 else None

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
        """Return image points (B, 2K) in [-1, 1]: each heat map's expected column, then each one's expected row."""
        batch, keypoints, height, width = heat.shape
        scaled = heat.float() * self.temperature[:, None, None].float()
        weight = scaled.flatten(2).softmax(-1).view(batch, keypoints, height, width)
        x = (weight.sum(2) * self.columns).sum(-1)
        y = (weight.sum(3) * self.columns).sum(-1)
        return torch.cat([x, y], -1)


def compiled_encoder(encoder: nn.Module, size: int) -> Callable[[Tensor], list[Tensor]]:
    """Return a function that runs a vision encoder on one image in ONNX Runtime, which is faster on a CPU than torch.

    torch calls oneDNN for each convolution, and each call takes 19 µs before it computes anything. Measured on an AMD
    EPYC, 96 × 96 pixels, 8 channels: 607 µs in torch, 270 µs in ONNX Runtime. ONNX Runtime uses as many threads as
    torch has at the time of this call.

    Args:
        encoder: Maps images (1, 3, size, size) uint8 to vision tokens (1, grid², E) and K image points (1, 2K).
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
    session = onnxruntime.InferenceSession(exported.getvalue(), options, providers=["CPUExecutionProvider"])
    return lambda images: [torch.from_numpy(found) for found in session.run(None, {"frame": images.numpy()})]
