"""Open the model that `kerv bench` measures, and its drafter. A model is a policy or a shape with random weights."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any

import torch

from kerv_cli.base.config import compose, groups
from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.paths import find_target, target_names
from kerv_cli.base.runtime import dtype_of, set_up
from kerv_cli.base.spaces import Observation
from kerv_cli.bench.physics import Sizes
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.episodes.policy import still_observation
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.drafter import EagleDrafter
from kerv_cli.methods.eagle.network import EagleNetwork
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.targets.compact.program import compile_parts, stored_bytes
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.compact.trunk import Layer
from kerv_cli.targets.settings import TargetSettings
from kerv_cli.training.settings import TrainTargetSettings
from kerv_cli.training.target import vocabulary
from kerv_cli.worlds.metaworld.spec import SPEC

_SPARE = 1.15  # free memory that is needed, relative to the weights: also for encoder, caches, a copy of one layer
_COMPILED = 2  # bytes of a weight in a compiled network, which holds them a second time


@dataclass(frozen=True)
class Model:
    """The model that `kerv bench` measures: a trained policy, or an untrained model of a given size.

    A *shape* is a file in conf/target that gives the size of a model, such as its width and number of layers. The
    untrained model has this size and random weights.
    """

    name: str
    target: Any
    drafter: EagleNetwork  # the policy's drafter, or a drafter with random weights if the policy has no drafter
    observation: Observation  # the observation to decode: all images are black, and all numbers 0
    is_shape: bool  # whether the model is untrained, with the size that a shape gives

    @property
    def sizes(self) -> Sizes:
        target, drafter, cache = self.target, self.drafter, self.target.new_cache(1, 1)
        matrices = [x for x in (*target.layers.parameters(), *target.layers.buffers()) if x.dim() == 2]
        weights, head = sum(map(torch.numel, matrices)), target.width * target.actions.tokens
        return Sizes(
            layers=weights,
            head=head,
            drafter=sum(p.numel() for p in drafter.parameters() if p.dim() == 2) + head,
            channels=len(target.layers) * matrices[0].shape[1],
            cached=cache.buffer[..., 0, :].numel(),
            weight=stored_bytes(matrices) / weights,
            slot=cache.buffer.element_size(),
            padding=cache.capacity - 1,
            drafter_padding=drafter.new_cache(1, 1).capacity - 1,
        )

    @property
    def size(self) -> int:
        return int(self.target.actions.longest(self.target.chunk))

    @property
    def dtype(self) -> torch.dtype:
        return self.target.dtype


def random_target(shape: TargetSettings, device: torch.device, dtype: torch.dtype) -> CompactTarget:
    """Return a compact target with random weights, for inference.

    The layers are made one after the other, so that memory never holds all weights of a large model twice. The weights
    are rounded to half precision, as the weights of the shipped targets are.
    """
    torch.manual_seed(0)
    target = CompactTarget(replace(shape, layers=0), SPEC.actions, SPEC.observation, vocabulary(SPEC.name), "corner4")
    for parameter in target.parameters():
        parameter.data = parameter.data.half()
    target.to(device=device, dtype=dtype)
    for _ in range(shape.layers):
        with device:
            layer = Layer(shape.width, shape.heads, shape.feed_forward)
        target.trunk.layers.append(layer.half().to(dtype))
    target.settings, target.trunk.depth = shape, shape.layers
    target.eval().requires_grad_(False)
    compile_parts(target)
    return target


def open_model(settings: BenchSettings) -> Model:
    """Open `settings.target` for inference: a policy, or the name of a shape (a file in conf/target).

    For a shape, the model and its drafter get random weights. A policy without a drafter gets a drafter with random
    weights, too.
    """
    shapes = groups()["target"]
    if settings.target in shapes:
        return _shape(settings)
    try:
        find_target(settings.results, settings.target)
    except UsageError as error:
        raise UnknownName("target", settings.target, [*target_names(settings.results), *shapes]) from error
    device, _ = set_up(settings.runtime)
    artifacts = Artifacts(settings.results, PolicySettings(target=settings.target), device, settings.runtime.dtype)
    target: Any = artifacts.target
    if not hasattr(target, "layers"):
        family = artifacts.description.family
        raise UsageError(
            f"target={settings.target}: the family '{family}' has no attribute `layers`, which kerv bench counts; "
            "add it (kerv_cli/engine/protocol.py)"
        )
    drafter = artifacts.load("drafter") if artifacts.path("drafter").exists() else _drafter(target)
    return Model(settings.target, target, drafter, blank(target), False)


def _shape(settings: BenchSettings) -> Model:
    shape = compose("train_target", [f"target={settings.target}"], TrainTargetSettings).target
    shape = replace(shape, chunk=-(-settings.tokens // SPEC.actions.dofs))
    device = torch.device(set_up(settings.runtime)[0])
    on_cpu = device.type == "cpu"
    dtype = dtype_of({"auto": "float32" if on_cpu else "bfloat16"}.get(settings.dtype, settings.dtype))
    size = dtype.itemsize + _COMPILED * on_cpu
    layer = 4 * shape.width**2 + 3 * shape.width * shape.feed_forward
    needed, most = _SPARE * size * layer * (shape.layers + 1), memory_of(device)
    if needed > most:
        raise UsageError(
            f"target={settings.target} needs {needed / 1e9:.1f} GB in {str(dtype).removeprefix('torch.')}, "
            f"{device} has {most / 1e9:.1f} GB: take a smaller shape, e.g. target=vla-150m"
        )
    with torch.inference_mode():
        target = random_target(shape, device, dtype)
        return Model(settings.target, target, _drafter(target), blank(target), True)


def _drafter(target: ReadableTarget) -> EagleNetwork:
    drafter = EagleDrafter().network(DrafterSettings(), target).to(device=target.device, dtype=target.dtype)
    drafter.eval().requires_grad_(False)
    compile_parts(drafter)
    return drafter


def blank(target: Any) -> Observation:
    return still_observation(target, target.observation, target.settings.image_size)


def memory_of(device: torch.device) -> float:
    if device.type == "cuda":
        return float(torch.cuda.mem_get_info(device)[0])
    return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
