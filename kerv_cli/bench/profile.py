"""Make latency profiles from measured times, for this machine or estimated for another device and shape."""

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

_PER_LAYER = 15e-6  # least seconds of a layer in an estimate: the time of launching its kernels in a CUDA graph
_HALF = 2  # bytes of a bfloat16 number

Document = dict[str, Any]
"""Result of a benchmark for JSON (docs/formats.md)."""


def profile_of(phases: Sequence[Phase], tokens: int) -> Profile:
    """Return a profile, the median seconds of each phase by its number of rows.

    Args:
        phases: Measured phases.
        tokens: N, tokens of a chunk.
    """
    points = {
        kind: sorted((p.rows, p.seconds) for p in phases if p.kind == kind) for kind in (*FORWARDS, *source_methods())
    }
    costs = {kind: tuple(zip(*pairs, strict=True)) for kind, pairs in points.items() if pairs}
    prompt = costs["prefill"][0][0] if "prefill" in costs else 0
    return Profile(int(prompt), {kind: (rows, seconds) for kind, (rows, seconds) in costs.items()}, tokens)


def projections(
    settings: BenchSettings, model: Model, machine: Machine, phases: Sequence[Phase]
) -> Iterator[tuple[str, Document]]:
    """Estimate the times of another shape in bfloat16 on other devices.

    The shape is `settings.projected`, the devices are those of `settings.projections`. Forwards have as many tokens
    after the prompt as those that were measured here.

    Args:
        settings: Settings of the benchmark.
        model: The measured model.
        machine: Limits of this device.
        phases: Measured phases.

    Yields:
        Name of a device, and the result for it.
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
    """Return how much of the device's limits the measured forwards reach, as median of floor ÷ time.

    Args:
        phases: Measured phases.
        machine: Limits of the device.

    Returns:
        Two medians: of phases in which reading takes longer, and of phases in which arithmetic takes longer. If there
        are no phases of one kind, it gets the other's median.
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
    """Estimate the times of phases on another device. These are no measurements.

    A forward is assumed to reach the same share of the device's limits as here, and to take at least 15 µs per layer.
    The encoder's time is scaled by the bandwidth. Drafts of the shipped policy keep their time.

    Args:
        phases: Phases with the bytes and operations of the shape on that device.
        reached: Result of `shares`.
        here: Limits of this device.
        there: Limits of the other device.
        layers: Number of decoder layers of the shape.
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
    """Return P, the number of prompt tokens of a shape: vision, instruction, scene and proprioception."""
    vision = shape.grid**2 if shape.observation == "vision" else 0
    return vision + shape.instruction_tokens + shape.scene_tokens + 1
