"""Latency profiles from measured phases, here or projected onto another device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from kerv_cli.bench.machine import Machine
from kerv_cli.bench.phases import Phase
from kerv_cli.engine.cost import KINDS, Profile


def profile_of(prompt: int, phases: Sequence[Phase]) -> Profile:
    """The profile of measured phases, their medians. prompt: P."""
    latencies = {}
    for kind in KINDS:
        points = sorted((p.rows, p.seconds) for p in phases if p.kind == kind)
        latencies[kind] = tuple(rows for rows, _ in points), tuple(seconds for _, seconds in points)
    return Profile(prompt, latencies)


def projected(phases: Sequence[Phase], here: Machine, there: Machine, overhead: float = 0.0) -> list[Phase]:
    """The phases on a device that is not at hand: each needs its floor there, divided by the share of the floor that it
    reached here, and at least `overhead` seconds. A projection, not a measurement."""
    projections = []
    for phase in phases:
        floor = there.floor(phase.read, phase.flops)
        share = min(1.0, phase.share)
        scale = here.bandwidth / there.bandwidth  # a phase without a floor, e.g. encode, scales with bandwidth
        seconds = max(overhead, floor / share if share > 0 else phase.seconds * scale)
        projections.append(replace(phase, seconds=seconds, p95=seconds, least=seconds, floor=floor))
    return projections
