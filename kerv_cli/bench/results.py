"""Compute the results of a benchmark, write them to a file, and return the rows of its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from kerv_cli.base.files import write_json
from kerv_cli.base.places import results_dir
from kerv_cli.bench.machine import Machine
from kerv_cli.bench.model import Model
from kerv_cli.bench.phases import Phase, measure, source_methods
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.engine.cost import FORWARDS, Profile
from kerv_cli.targets.provenance import stamp

Document = dict[str, Any]
"""Result of a benchmark for JSON (docs/formats.md)."""


@dataclass(frozen=True)
class Bench:
    """The results of a benchmark.

    Attributes:
        model: The measured model.
        machine: The device's measured bandwidth and operations per second.
        phases: Measured times of the phases of a decode.
        profile: Median seconds by kind and rows of a phase, from which the time of a decode can be computed.
    """

    model: Model
    machine: Machine
    phases: list[Phase]
    profile: Profile

    @property
    def dtype(self) -> str:
        """Number format of the trunk, such as `float32`."""
        return str(self.model.dtype).removeprefix("torch.")

    @property
    def title(self) -> str:
        """Title of the table of phases: target, number format, device, threads."""
        where = stamp(str(self.model.target.device))["device_name"]
        return f"{self.model.name}, {self.dtype}, {where}, {torch.get_num_threads()} thread, caches cold at first"

    def document(self) -> Document:
        """Return all results for JSON (docs/formats.md)."""
        device = self.model.target.device
        return {
            "target": self.model.name,
            "random_weights": self.model.is_shape,
            "dtype": self.dtype,
            "device": str(device),
            "threads": torch.get_num_threads(),
            **stamp(str(device)),
            "card": card_of(self.model, self.machine),
            "phases": [phase.as_dict() for phase in self.phases],
            "profile": self.profile.as_dict(),
        }


def card_of(model: Model, machine: Machine) -> dict[str, Any]:
    """Compute the shortest times that a model's forwards can take on this device. No forward is executed.

    A shortest time (floor) has two parts in seconds: one for reading memory, one for arithmetic. The larger one counts.

    Args:
        model: The model.
        machine: The device's measured bandwidth and operations per second.

    Returns:
        By name: the model's sizes, the device's bandwidth and operations per second, and the floors. `card_rows` prints
        them.
    """
    prompt, tokens, sizes = model.target.max_prompt, model.size, model.sizes
    needs = {
        "one token": sizes.forward(1, prompt),
        f"verification of {tokens}": sizes.forward(tokens, prompt),
        "prefill": sizes.forward(prompt, 0),
        f"prefill and {tokens - 1} drafted": sizes.forward(prompt + tokens - 1, 0),
    }
    weights = sizes.trunk_weights * sizes.weight
    return {
        "weights": sizes.trunk_weights,
        "weight_bytes": weights,
        "cache_bytes": float(sizes.cached) * (prompt + tokens) * sizes.slot,
        "prompt": prompt,
        "tokens": tokens,
        "bandwidth": machine.bandwidth,
        "bandwidth_of_weights": machine.bandwidth_of(weights),
        "flops": machine.flops,
        "floors": {name: machine.bounds(*need) for name, need in needs.items()},
    }


def run(settings: BenchSettings, model: Model, machine: Machine) -> Bench:
    """Measure a model and return the results.

    Args:
        settings: Settings of the benchmark.
        model: The model, from `open_model`.
        machine: The device's measured bandwidth and operations per second. Both are measured again after the decodes;
            the higher values count.
    """
    machine, phases = measure(model, machine, settings)
    return Bench(model, machine, phases, profile_of(phases, model.size))


def write(settings: BenchSettings, bench: Bench) -> Path:
    """Write the results as a JSON file. Return its path."""
    name = bench.model.name.rstrip("/").rsplit("/", 1)[-1]
    path = results_dir(settings.results) / "bench" / f"{name}-{bench.dtype}.json"
    write_json(path, bench.document())
    return path


def profile_of(phases: Sequence[Phase], tokens: int) -> Profile:
    """Return a latency profile: the median seconds of each kind of phase, by its number of rows.

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


PHASE_COLUMNS = ("phase", "median ms", "p95", "least", "GB/s", "GFLOP/s", "floor ms", "least ÷ floor")


def card_rows(card: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return rows (name, value) for a table: sizes of the model, rates of the device, and shortest times of forwards.

    Args:
        card: Result of `card_of`.
    """
    rows = [
        ("weights that a forward reads", f"{card['weights'] / 1e6:.1f} M, {card['weight_bytes'] / 1e6:.1f} MB"),
        ("cache of prompt and chunk", f"{card['cache_bytes'] / 1e6:.2f} MB"),
        ("memory, measured", f"{card['bandwidth'] / 1e9:.1f} GB/s"),
        ("memory that holds the weights, measured", f"{card['bandwidth_of_weights'] / 1e9:.1f} GB/s"),
        ("arithmetic, measured", f"{card['flops'] / 1e9:.0f} GFLOP/s"),
    ]
    for name, (reading, computing) in card["floors"].items():
        why = "to read the weights" if reading >= computing else "for the arithmetic"
        rows.append((f"floor of {name}", f"{1e3 * max(reading, computing):.2f} ms, {why}"))
    return rows


def phase_rows(phases: Sequence[Phase]) -> list[tuple[str, ...]]:
    """Return a row per phase with the columns PHASE_COLUMNS. The floor is the shortest time that the device allows."""
    rows: list[tuple[str, ...]] = []
    for phase in phases:
        limits = ("–", "–", "–", "–")
        if phase.floor > 0:
            rates = (f"{phase.read / phase.seconds / 1e9:.1f}", f"{phase.flops / phase.seconds / 1e9:.0f}")
            limits = (*rates, f"{1e3 * phase.floor:.3f}", f"{phase.least / phase.floor:.1f}")
        times = (f"{1e3 * phase.seconds:.2f}", f"{1e3 * phase.p95:.2f}", f"{1e3 * phase.least:.2f}")
        rows.append((phase.name, *times, *limits))
    return rows
