"""Latency profiles from measured costs, here or projected onto another device and shape."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from kerv_cli.base.settings import BenchSettings
from kerv_cli.bench.machine import Machine
from kerv_cli.bench.model import Model, Sizes, shape_of
from kerv_cli.bench.phases import Phase, projected
from kerv_cli.engine.cost import KINDS, Profile

_PER_LAYER = 15e-6  # seconds per layer and forward below which projections do not go: kernels of a captured graph
_HALF = 2  # bytes of a bfloat16


def profile_of(phases: Sequence[Phase], tokens: int = 0, gauge: float = math.nan) -> Profile:
    """The profile of measured costs, their medians. tokens: N. gauge: seconds of the reference workload."""
    points = {kind: sorted((p.rows, p.seconds) for p in phases if p.kind == kind) for kind in KINDS}
    costs = {kind: tuple(zip(*found, strict=True)) for kind, found in points.items() if found}
    prompt = costs["prefill"][0][0] if "prefill" in costs else 0
    return Profile(int(prompt), {kind: (rows, seconds) for kind, (rows, seconds) in costs.items()}, tokens, gauge)


def projections(
    settings: BenchSettings, model: Model, machine: Machine, phases: Sequence[Phase]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """(device, document) of every device of `projections`, for the shape `projected` in bfloat16. Its rows behind the
    prompt are those measured here; the share of the floor that a cost reaches is taken over from here."""
    shape = shape_of(settings.projected, model.size)
    there = Sizes(shape, model.target.actions.tokens, _HALF, _HALF)
    here = min(p.rows for p in phases if p.kind == "prefill")
    prompt = prompt_of(shape)
    moved = [replace(p, rows=p.rows - here + prompt) if _counts_prompt(p, here) else p for p in phases]

    def needs(kind: str, rows: int) -> tuple[float, float]:
        return there.needs(kind, rows, prompt)

    for name, (bandwidth, flops) in settings.projections.items():
        device = Machine(bandwidth * 1e9, flops * 1e12)
        profile = profile_of(projected(moved, machine, device, shape.layers * _PER_LAYER, needs), model.size)
        yield (
            name,
            {
                "target": settings.projected,
                "dtype": "bfloat16",
                "device_name": name,
                "projected": True,
                "from": f"{model.name} on {settings.runtime.device}, {bandwidth:g} GB/s, {flops:g} TFLOP/s",
                "profile": profile.as_dict(),
            },
        )


def _counts_prompt(phase: Phase, prompt: int) -> bool:
    return phase.kind == "prefill" or (phase.kind == "feed" and phase.rows == prompt)


def prompt_of(shape: Any) -> int:
    """P of a shape with these settings: vision tokens, instruction, scene, proprioception."""
    vision = shape.grid**2 if shape.observation == "vision" else 0
    return int(vision + shape.instruction_tokens + shape.scene_tokens + 1)


def as_document(document: Mapping[str, Any]) -> dict[str, Any]:
    """What of a bench's document is shipped: whose profile it is, and the profile."""
    dropped = ("card", "cold_start", "phases", "ceilings", "ties")
    return {key: value for key, value in document.items() if key not in dropped}
