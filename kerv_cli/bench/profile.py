"""Latency profiles from measured costs, here or projected onto another device and shape."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from kerv_cli.bench.machine import Machine
from kerv_cli.bench.model import Model, Sizes, shape_of
from kerv_cli.bench.phases import Phase, source_methods
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.engine.cost import FORWARDS, Profile
from kerv_cli.targets.compact.settings import TargetSettings

_PER_LAYER = 15e-6  # seconds per layer and pass below which projections do not go: kernels of a captured graph
_HALF = 2  # bytes of a bfloat16

Document = dict[str, Any]
"""What a bench writes, as JSON."""


def profile_of(phases: Sequence[Phase], tokens: int) -> Profile:
    """Return the profile of the medians of measured costs. tokens: N."""
    points = {
        kind: sorted((p.rows, p.seconds) for p in phases if p.kind == kind) for kind in (*FORWARDS, *source_methods())
    }
    costs = {kind: tuple(zip(*pairs, strict=True)) for kind, pairs in points.items() if pairs}
    prompt = costs["prefill"][0][0] if "prefill" in costs else 0
    return Profile(int(prompt), {kind: (rows, seconds) for kind, (rows, seconds) in costs.items()}, tokens)


def projections(
    settings: BenchSettings, model: Model, machine: Machine, phases: Sequence[Phase]
) -> Iterator[tuple[str, Document]]:
    """Yield every device of `projections` and its document, for the shape `projected` in bfloat16.

    The rows after the prompt are those measured here.
    """
    shape = shape_of(settings.projected, model.size)
    sizes = Sizes(shape, model.target.actions.tokens, _HALF, _HALF)
    here, prompt = min(p.rows for p in phases if p.kind == "prefill"), prompt_of(shape)
    moved = []
    for p in phases:
        counts_prompt = p.kind == "prefill" or (p.kind == "feed" and p.rows == here)
        rows = p.rows - here + prompt if counts_prompt else p.rows
        read, flops = sizes.needs(p.kind, rows, prompt)
        moved.append(replace(p, rows=rows, read=read, flops=flops))
    for name, (bandwidth, flops) in settings.projections.items():
        device = Machine(bandwidth * 1e9, flops * 1e12)
        costs = projected(moved, shares(phases, machine), machine, device, shape.layers)
        document = {
            "target": settings.projected,
            "dtype": "bfloat16",
            "device_name": name,
            "projected": True,
            "from": f"{model.name} on {settings.runtime.device}; {bandwidth:g} GB/s, {flops:g} TFLOP/s",
            "profile": profile_of(costs, model.size).as_dict(),
        }
        yield name, document


def shares(phases: Sequence[Phase], machine: Machine) -> tuple[float, float]:
    """Return the median floor ÷ time of costs bound by memory, and of costs bound by arithmetic.

    Without costs of one kind the other kind's median stands for it.
    """
    by_bound: dict[bool, list[float]] = {True: [], False: []}
    for p in phases:
        if p.floor > 0 and p.kind in FORWARDS:
            reading, computing = machine.bounds(p.read, p.flops)
            by_bound[reading >= computing].append(min(1.0, p.share))
    memory, arithmetic = (statistics.median(by_bound[kind] or by_bound[not kind]) for kind in (True, False))
    return memory, arithmetic


def projected(
    phases: Sequence[Phase], reached: tuple[float, float], here: Machine, there: Machine, layers: int
) -> list[Phase]:
    """Project phases, with the bytes and operations that they need there, onto a device that is not at hand.

    A time is the device's floor divided by the share of the floor that was reached here, and at least what so many
    layers' kernels take. The encoder has no floor: it scales with bandwidth. Drafts of the shipped policy stay as they
    are. This is no measurement.
    """
    projections = []
    for p in phases:
        passes = {"prefill": layers, "verify": layers, "feed": 1}.get(p.kind, p.rows - 1)
        least = max(passes * _PER_LAYER, p.read / there.bandwidth / reached[0], p.flops / there.flops / reached[1])
        if p.kind == "encode":
            least = p.seconds * here.bandwidth / there.bandwidth
        elif p.kind not in FORWARDS:
            least = p.seconds
        projections.append(replace(p, seconds=least, p95=least, least=least, floor=max(there.bounds(p.read, p.flops))))
    return projections


def prompt_of(shape: TargetSettings) -> int:
    """Return P of a shape: vision tokens, instruction, scene and proprioception."""
    vision = shape.grid**2 if shape.observation == "vision" else 0
    return vision + shape.instruction_tokens + shape.scene_tokens + 1
