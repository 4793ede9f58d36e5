"""Run a benchmark: limits of the device, times of all phases of a decode, highest speedups; and store the result."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from kerv_cli.base.files import write_json
from kerv_cli.base.places import results_dir
from kerv_cli.bench.ceilings import MethodCeiling, ceilings
from kerv_cli.bench.machine import Machine
from kerv_cli.bench.model import Model
from kerv_cli.bench.phases import Phase, measure
from kerv_cli.bench.profile import Document, profile_of, projections
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.engine.cost import Profile
from kerv_cli.targets.provenance import stamp


@dataclass(frozen=True)
class Bench:
    """The results of a benchmark.

    Attributes:
        model: The measured model.
        machine: Limits of the device.
        phases: Measured times.
        ceilings: N (tokens of a chunk) -> highest speedup of each method.
        profile: Median times by kind and rows, from which the time of a decode can be computed.
    """

    model: Model
    machine: Machine
    phases: list[Phase]
    ceilings: dict[int, list[MethodCeiling]]
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
        """Return the whole result for JSON (docs/formats.md)."""
        device = self.model.target.device
        return {
            "target": self.model.name,
            "random_weights": self.model.is_shape,
            "dtype": self.dtype,
            "device": str(device),
            "threads": torch.get_num_threads(),
            **stamp(str(device)),
            "card": card_of(self.model, self.machine, max(self.ceilings)),
            "phases": [phase.as_dict() for phase in self.phases],
            "ceilings": {str(n): [asdict(c) for c in rows] for n, rows in self.ceilings.items()},
            "profile": self.profile.as_dict(),
        }


def card_of(model: Model, machine: Machine, tokens: int) -> dict[str, Any]:
    """Compute the least times that a model's forwards can take on this machine. No forward is executed.

    A floor consists of two times in seconds: for reading the weights and for the arithmetic. The larger one counts.

    Args:
        model: The model.
        machine: Limits of the device.
        tokens: N, tokens of a chunk.

    Returns:
        Sizes, rates and floors by name, see `tables.card_rows`.
    """
    prompt, s, sizes = model.target.max_prompt, model.target.settings, model.sizes
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
        "cache_bytes": 2.0 * s.layers * s.width * (prompt + tokens) * sizes.slot,
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
        machine: Limits of the device. They are measured once more at the end, and the better ones count.
    """
    machine, phases = measure(model, machine, settings)
    profile = profile_of(phases, model.size)
    by_tokens = {n: ceilings(profile, n) for n in settings.tokens}
    return Bench(model, machine, phases, by_tokens, profile)


def write(settings: BenchSettings, bench: Bench) -> list[Path]:
    """Write the result and the projections onto other devices as JSON files. Return their paths."""
    folder = results_dir(settings.results) / "bench"
    name = bench.model.name.rstrip("/").rsplit("/", 1)[-1]
    documents = {folder / f"{name}-{bench.dtype}.json": bench.document()}
    if settings.projected:
        for device, document in projections(settings, bench.model, bench.machine, bench.phases):
            file = f"{settings.projected}-{document['dtype']}-{device.lower().replace(' ', '-')}.json"
            documents[folder / file] = document
    for path, document in documents.items():
        write_json(path, document)
    return list(documents)
