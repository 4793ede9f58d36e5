"""Preparing a module for inference: weight layouts, and a plan for every part that has one."""

from __future__ import annotations

import torch
from torch import nn

from kerv_cli.targets.compact.encode_plan import EncodePlan
from kerv_cli.targets.compact.inference import Plan, Planned, frozen_on_cpu, has_blocked_layouts
from kerv_cli.targets.compact.target import Target
from kerv_cli.targets.compact.trunk import Layer, Rotary, Trunk
from kerv_cli.targets.compact.trunk_plan import LayerPlan, NormPlan, RotaryPlan
from kerv_cli.targets.compact.vision import VisionEncoder
from kerv_cli.targets.compact.vision_plan import VisionPlan


def lay_out_for_inference(module: nn.Module) -> None:
    """Prepare a module whose weights are final: every linear weight input-major, shapes unchanged, and a plan for what
    has one where it is frozen float32 on a CPU.

    On a CPU one token times an output-major matrix is twice as slow (measured: 192 × 1024, 69 µs against 36 µs).
    Every method runs on the same layouts.
    """
    for part in module.modules():
        if isinstance(part, nn.Linear) and part.weight.device.type == "cpu":
            part.weight.data = part.weight.data.t().contiguous().t()
    if not frozen_on_cpu(module):
        return
    heads = next((part.heads for part in module.modules() if isinstance(part, Layer)), 0)
    with torch.no_grad():
        for part in module.modules():
            if isinstance(part, Planned):
                part.plan = plan_of(part, heads)


def plan_of(part: nn.Module, heads: int) -> Plan | None:
    """heads: of the layers that a rotary embedding turns."""
    if isinstance(part, Rotary) and heads:
        return RotaryPlan(part, heads)
    if isinstance(part, Layer):
        return LayerPlan(part)
    if isinstance(part, Trunk):
        return NormPlan(part.norm)
    if isinstance(part, VisionEncoder) and has_blocked_layouts():
        return VisionPlan(part)
    if isinstance(part, Target) and part.needs_frame:
        return EncodePlan(part)
    return None
