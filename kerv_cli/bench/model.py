"""Open the model that `kerv bench` measures: a policy's target, or a shape with random weights; and a drafter."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.config import compose, groups
from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.runtime import DTYPES, set_up
from kerv_cli.base.spaces import Observation
from kerv_cli.bench.machine import REPEATS, product_with, timed
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.episodes.policy import still_observation
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.drafter import EagleDrafter, EagleNetwork
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.targets.compact.bfloat16 import Bfloat16Layers, multiplies_bfloat16
from kerv_cli.targets.compact.packable import pack
from kerv_cli.targets.compact.program import Program, stored_bytes
from kerv_cli.targets.compact.settings import TargetSettings
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.compact.trunk import Layer
from kerv_cli.targets.folders import target_names
from kerv_cli.training.imitation import vocabulary
from kerv_cli.training.settings import TrainTargetSettings
from kerv_cli.worlds.metaworld.spec import SPEC

_SPARE = 1.15  # free memory that is needed, relative to the weights: also for encoder, caches, a copy of one layer


@dataclass(frozen=True)
class Sizes:
    """The sizes of a target, from which the bytes and operations of its forwards are computed.

    Attributes:
        settings: Shapes of the target.
        vocabulary: V, number of action tokens.
        weight: Bytes of a weight, on average.
        slot: Bytes of a number in the key/value cache.
    """

    settings: TargetSettings
    vocabulary: int
    weight: float
    slot: int

    @property
    def trunk_weights(self) -> int:
        """Number of weights that every forward reads: the layers' matrices and the head."""
        return layer_weights(self.settings) * self.settings.layers + self.settings.width * self.vocabulary

    def forward(self, rows: int, cached: int) -> tuple[float, float]:
        """Return the bytes that a forward reads, and its number of arithmetic operations.

        Every weight, key and value counts as read once. There are two operations per weight and token, and four per
        channel of each key that a token attends to.

        Args:
            rows: Number of tokens in the forward.
            cached: Number of earlier tokens in the cache.
        """
        s, weights = self.settings, self.trunk_weights
        read = weights * self.weight + 2.0 * s.layers * (cached + rows) * s.width * self.slot
        attended = rows * cached + rows * (rows + 1) / 2
        return read, 2.0 * weights * rows + 4.0 * s.layers * s.width * attended

    def needs(self, kind: str, rows: int, prompt: int) -> tuple[float, float]:
        """Return the bytes and operations of one phase of a decode, see `forward`. Zeros if they are not known.

        Args:
            kind: Kind of phase, see `phases.Phase`.
            rows: Number of tokens or levels, see `phases.Phase`.
            prompt: P, number of prompt tokens.
        """
        s = self.settings
        drafter = float(layer_weights(s) + 2 * s.width**2 + s.width * self.vocabulary)
        # number of passes over the drafter's weights, and of rows in all passes; its tree has eight nodes per level
        passes = {"feed": (1, rows), "draft": (rows - 1, rows - 1), "tree": (rows - 1, 8 * (rows - 1))}
        if kind in ("prefill", "verify"):
            return self.forward(rows, prompt if kind == "verify" else 0)
        times, tokens = passes.get(kind, (0, 0))
        return times * drafter * self.weight, 2.0 * tokens * drafter


@dataclass(frozen=True)
class Model:
    """The model that is measured.

    Attributes:
        name: Name of the policy or of the shape.
        target: The target, a ReadableTarget.
        drafter: The policy's drafter, or one with random weights.
        observation: The observation that is decoded, black images and zeros.
        is_shape: Whether the target has random weights.
    """

    name: str
    target: Any
    drafter: EagleNetwork
    observation: Observation
    is_shape: bool

    @property
    def sizes(self) -> Sizes:
        """Sizes of the target. On a CPU its cache is float32, and compiled weights have their stored format."""
        slot, trunk = 4 if self.target.device.type == "cpu" else self.dtype.itemsize, self.target.trunk
        weight: float = self.dtype.itemsize
        if isinstance(getattr(trunk, "packed", None), Program):
            weight = stored_bytes(trunk) / sum(p.numel() for p in trunk.parameters())
        return Sizes(self.target.settings, self.target.actions.tokens, weight, slot)

    @property
    def size(self) -> int:
        """N, number of tokens in a chunk."""
        return int(self.target.chunk * self.target.actions.dofs)

    @property
    def dtype(self) -> torch.dtype:
        """Number format of the trunk's weights."""
        dtype: torch.dtype = self.target.head.weight.dtype
        return dtype


class ShapeTarget(CompactTarget):
    """A compact target with random weights.

    It is built layer by layer in its final number format, so that memory never holds 7 B weights twice. On a CPU the
    prompt's encoder stays float32, because only then it is compiled. All layers have the same random numbers, shifted
    by a few rows. Each has its own memory, so a forward reads as much as in a trained target.

    Args:
        settings: Shapes.
        device: Device of the weights.
        dtype: Number format of the trunk's weights.
    """

    def __init__(self, settings: TargetSettings, device: torch.device, dtype: torch.dtype) -> None:
        super().__init__(replace(settings, layers=0), SPEC.actions, SPEC.observation, vocabulary(SPEC.name), "corner4")
        self.requires_grad_(False).eval()
        layers, compiled = shifted_layers(settings, device, dtype), device.type == "cpu" and dtype == torch.float32
        if device.type == "cpu" and not compiled:
            pack(self)
            self.packed = self.packed and self.packed._replace(step=None)
        self.settings, self.trunk.depth = settings, settings.layers
        if device.type == "cpu" and dtype == torch.bfloat16 and multiplies_bfloat16():
            self.trunk.packed = Bfloat16Layers(self.trunk.rotary(slice(None)), layers)
        else:
            self.trunk.layers = torch.nn.ModuleList(layers)
            self.trunk.to(dtype=dtype)
        for part in (self.embedding, self.head, self.trunk.norm):
            part.to(device=device, dtype=dtype)
        if device.type == "cuda":
            self.to(device=device, dtype=dtype)
        elif compiled:
            pack(self)

    def encode(self, observation: Observation) -> Tensor:
        """Return the prompt (1, P, E) of an observation in the trunk's number format."""
        return super().encode(observation).to(self.dtype)


def shifted_layers(settings: TargetSettings, device: torch.device, dtype: torch.dtype) -> Iterator[Layer]:
    """Yield the decoder layers of a `ShapeTarget` one after the other; arguments as for that class."""
    torch.manual_seed(0)
    first = Layer(settings.width, settings.heads, settings.feed_forward).requires_grad_(False)
    for parameter in first.parameters():
        if parameter.dim() == 2:
            parameter.normal_(std=0.02)
    for shift in range(settings.layers):
        with torch.device("meta"):
            layer = Layer(settings.width, settings.heads, settings.feed_forward)
        for name, part in first.named_children():
            weight: Any = part.weight
            values = weight.roll(shift, 0).to(device=device, dtype=dtype)
            layer.get_submodule(name).register_parameter("weight", torch.nn.Parameter(values, False))
        yield layer


def layer_weights(settings: TargetSettings) -> int:
    """Return the number of weights in one decoder layer's matrices."""
    return 4 * settings.width**2 + 3 * settings.width * settings.feed_forward


def open_model(settings: BenchSettings) -> Model:
    """Open the policy or shape `settings.model` for inference, with its drafter.

    A shape, or a policy without a drafter, gets a drafter with random weights.

    Raises:
        UsageError: There is too little memory for the shape.
        UnknownName: There is neither a policy nor a shape of that name.
        CheckpointError: The policy is damaged.
    """
    shapes = groups()["target"]
    if settings.model in shapes:
        return _shape(settings)
    device, _ = set_up(settings.runtime)
    try:
        artifacts = Artifacts(
            settings.results, PolicySettings(target=settings.model), None, device, settings.runtime.dtype
        )
        target: Any = artifacts.target
    except UsageError as error:
        if "/" not in settings.model and "is damaged" not in str(error):
            raise UnknownName("target", settings.model, [*target_names(settings.results), *shapes]) from error
        raise
    drafter = artifacts.load("drafter") if artifacts.path("drafter").exists() else _drafter(target)
    return Model(settings.model, target, drafter, blank(target), False)


def _shape(settings: BenchSettings) -> Model:
    shape = shape_of(settings.model, max(settings.tokens))
    device, _ = set_up(settings.runtime)
    dtype = DTYPES[settings.dtype] if settings.dtype != "auto" else fastest(torch.device(device))
    needed = _SPARE * dtype.itemsize * layer_weights(shape) * (shape.layers + 1)
    free = free_memory(torch.device(device))
    if needed > free:
        raise UsageError(
            f"target={settings.model} needs {needed / 1e9:.1f} GB in {str(dtype).removeprefix('torch.')}, "
            f"{free / 1e9:.1f} GB are free on {device}: take a smaller shape, e.g. target=vla-150m"
        )
    with torch.inference_mode():
        target = ShapeTarget(shape, torch.device(device), dtype)
        return Model(settings.model, target, _drafter(target), blank(target), True)


def shape_of(name: str, tokens: int) -> TargetSettings:
    """Return a shape of conf/target, with chunks of at least `tokens` tokens."""
    shape = compose("train_target", [f"target={name}"], TrainTargetSettings).target
    return replace(shape, chunk=-(-tokens // SPEC.actions.dofs))


def _drafter(target: ReadableTarget) -> EagleNetwork:
    drafter = EagleDrafter().network(DrafterSettings(), target).to(device=target.device, dtype=target.dtype)
    drafter.eval().requires_grad_(False)
    pack(drafter)
    return drafter


def blank(target: Any) -> Observation:
    """Return an observation for a target in which all images are black and all numbers 0."""
    return still_observation(target, target.observation, target.settings.image_size)


def fastest(device: torch.device) -> torch.dtype:
    """Return the faster number format on this device, float32 or bfloat16.

    On a CPU this is measured by multiplying one row with a large matrix. On CUDA it is bfloat16.
    """
    if device.type == "cuda":
        return torch.bfloat16
    if not multiplies_bfloat16():
        return torch.float32
    row = torch.ones(1, 4096)
    seconds = {}
    for dtype in (torch.bfloat16, torch.float32):
        product = product_with(torch.ones(8192, 4096), dtype)
        seconds[dtype] = np.median(timed(functools.partial(product, row.to(dtype)), device, REPEATS))
    return min(seconds, key=seconds.__getitem__)


def free_memory(device: torch.device) -> float:
    """Return the bytes of free memory on a device."""
    if device.type == "cuda":
        return float(torch.cuda.mem_get_info(device)[0])
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            fields = dict(line.split(":", 1) for line in file)
        return 1024.0 * int(fields["MemAvailable"].split()[0])
    except (OSError, KeyError):
        return float(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
