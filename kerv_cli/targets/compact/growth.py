"""Enlarge a trunk or a drafter so that it computes the same (`targets/grown.py`, docs/methods.md §0.2)."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import nn

from kerv_cli.base.errors import UsageError
from kerv_cli.targets.compact.program import compile_parts
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.compact.trunk import Layer, LayerStack, Rotary
from kerv_cli.targets.settings import GrowSettings

STD = 0.02  # standard deviation of the additional weights


def grow_stack(stack: LayerStack, shape: GrowSettings, layers: int) -> None:
    """Replace the layers of a trunk or a drafter by more and larger layers, in place. The outputs stay the same."""
    old: list[Any] = [copy.deepcopy(layer).float() for layer in stack.layers]
    stack.compiled = None
    units, channels = old[0].down.in_features, stack.width // stack.heads
    for name, least in {"width": stack.width, "heads": stack.heads, "feed_forward": units, "layers": len(old)}.items():
        value = layers if name == "layers" else getattr(shape, name)
        if value < least:
            raise UsageError(f"grow.{name}={value}: the policy has {least}, and only growing keeps what it computes")
    if shape.width % (shape.heads * channels):
        raise UsageError(
            f"grow.width={shape.width} with {shape.heads} heads: a head's channels must be a multiple of {channels}"
        )
    generator, like = torch.Generator().manual_seed(0), stack.weight
    before = [*old, *[None] * (layers - len(old))]
    new = nn.ModuleList(_grown_layer(layer, stack, shape, generator) for layer in before)
    stack.layers = new.to(like.device, like.dtype).eval().requires_grad_(False)
    stack.width, stack.heads, stack.depth = shape.width, shape.heads, layers
    stack.rotary = Rotary(shape.width // shape.heads).to(like.device, like.dtype)


def _grown_layer(old: Layer | None, stack: LayerStack, shape: GrowSettings, generator: torch.Generator) -> Layer:
    # computes the same output as `old`; without `old` the output is the input
    new = Layer(shape.width, shape.heads, shape.feed_forward)
    width, channels, wide = stack.width, stack.width // stack.heads, shape.width // shape.heads
    with torch.no_grad():
        for linear in (new.qkv, new.gate_up):
            noise = torch.randn(linear.weight.shape, generator=generator) * STD
            linear.weight.copy_(noise.half())  # half precision holds them without loss, like the policy's own weights
        new.out.weight.zero_()
        new.down.weight.zero_()
        if old is None:
            return new
        for name in ("attention_norm", "feed_norm"):
            # the mean square includes the additional zeros: a smaller ε and gain correct for that
            norm, small = getattr(new, name), getattr(old, name)
            norm.weight[:width] = small.weight * (width / shape.width) ** 0.5
            norm.eps = small.eps * width / shape.width
        # a channel must keep its rotary frequency: the pair of channels i of a head becomes pair i · wide / channels
        half = torch.arange(channels // 2) * (wide // channels)
        rows = (torch.arange(stack.heads)[:, None] * wide + torch.cat([half, half + wide // 2])).flatten()
        qkv = new.qkv.weight.view(3, shape.width, shape.width)
        qkv[1, : stack.heads * wide] = 0.0  # additional channels of keys are 0, so that scores do not change
        for part, small in enumerate(old.qkv.weight.view(3, width, width)):
            # attention divides scores by the square root of a head's channels, of which there are more now
            qkv[part, rows, :width] = small * ((wide / channels) ** 0.5 if part == 0 else 1.0)
        new.out.weight[:width, rows] = old.out.weight
        units = old.down.in_features
        gate_up = new.gate_up.weight.view(2, shape.feed_forward, shape.width)
        gate_up[:, :units, :width] = old.gate_up.weight.view(2, units, width)
        new.down.weight[:width, :units] = old.down.weight
    return new


def enlarge(drafter: LayerStack, recipe: GrowSettings, padding: int) -> None:
    grow_stack(drafter, recipe, layers=drafter.depth)
    drafter.padding = padding
    compile_parts(drafter)


def grow_trunk(target: CompactTarget, shape: GrowSettings) -> None:
    if 0 < shape.prompt < target.max_prompt:
        raise UsageError(f"grow.prompt={shape.prompt}: the policy's prompt has {target.max_prompt} tokens already")
    grow_stack(target.trunk, shape, shape.layers)
    target.trunk.padding = max(0, shape.prompt - target.max_prompt)
