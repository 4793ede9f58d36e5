"""Compute the results of a benchmark, write them to files, and return the rows of its tables.

The results are times of each phase of a decode, the highest speedup of each method, and estimates for other devices.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from kerv_cli.base.config import compose, groups
from kerv_cli.base.files import write_json
from kerv_cli.base.places import results_dir
from kerv_cli.base.registry import DRAFTING, part_of
from kerv_cli.bench.machine import Machine
from kerv_cli.bench.model import Model, Sizes, shape_of
from kerv_cli.bench.phases import Phase, measure, source_methods
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.engine.cost import FORWARDS, Profile
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.settings import EXPERT
from kerv_cli.targets.compact.settings import TargetSettings
from kerv_cli.targets.provenance import stamp


@dataclass(frozen=True)
class Bench:
    """The results of a benchmark.

    Attributes:
        model: The measured model.
        machine: The device's measured bandwidth and operations per second.
        phases: Measured times of the phases of a decode.
        ceilings: Highest speedup of each method, by N, the number of tokens in a chunk.
        profile: Median seconds by kind and rows of a phase, from which the time of a decode can be computed.
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
        """Return all results for JSON (docs/formats.md)."""
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
    """Compute the shortest times that a model's forwards can take on this device. No forward is executed.

    A shortest time (floor) has two parts in seconds: one for reading memory, one for arithmetic. The larger one counts.

    Args:
        model: The model.
        machine: The device's measured bandwidth and operations per second.
        tokens: N, tokens of a chunk.

    Returns:
        By name: the model's sizes, the device's bandwidth and operations per second, and the floors. `card_rows` prints
        them.
    """
    prompt, sizes = model.target.max_prompt, model.sizes
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
    profile = profile_of(phases, model.size)
    by_tokens = {n: ceilings(profile, n) for n in settings.tokens}
    return Bench(model, machine, phases, by_tokens, profile)


def write(settings: BenchSettings, bench: Bench) -> list[Path]:
    """Write the results, and the estimates for other devices, as JSON files. Return the paths of the files."""
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


@dataclass(frozen=True)
class MethodCeiling:
    """The speedup of a method over autoregressive decoding (AR) if every draft were accepted completely.

    Attributes:
        method: Name of the method.
        how: How often and where it verifies, as text.
        free: Speedup if drafting took no time.
        drafted: Speedup with the time of the drafter. The same as `free` if the method uses no drafter.
    """

    method: str
    how: str
    free: float
    drafted: float


def ceilings(profile: Profile, tokens: int) -> list[MethodCeiling]:
    """Return the highest speedup of each method in conf/method. Methods without verification are left out.

    Args:
        profile: Measured seconds of the forwards and drafts.
        tokens: N, tokens of a chunk.
    """
    names = [name for name in groups()["method"] if name != EXPERT]
    candidates = (_ceiling(name, profile, tokens) for name in names)
    return [ceiling for ceiling in candidates if ceiling is not None]


def _ceiling(name: str, profile: Profile, tokens: int) -> MethodCeiling | None:
    settings = compose("rollout", [f"method={name}"], RolloutSettings)
    autoregressive, encode = profile.decode(tokens), profile.seconds("encode", 1)
    draft, proposer, skip = (
        part_of(kind, getattr(settings, kind).kind) for kind in ("prefill_draft", "proposer", "skip")
    )
    if skip.traits.get("parallel"):
        speedup = autoregressive / (encode + profile.seconds("prefill", profile.prompt + tokens))
        return MethodCeiling(name, "one forward", speedup, speedup)
    if not skip.traits.get("verifies", True) or (draft.absent and proposer.absent):
        return None
    if not draft.absent:
        least = encode + profile.seconds("prefill", profile.prompt + tokens - 1)
        return MethodCeiling(name, "in the prefill", autoregressive / least, autoregressive / least)
    prefill = encode + profile.seconds("prefill", profile.prompt)
    least = prefill + profile.seconds("verify", tokens - 1)
    free = autoregressive / least
    if proposer.traits.get("cost") != DRAFTING:
        return MethodCeiling(name, "one verification", free, free)
    depth = min(int(getattr(settings.proposer, "depth", tokens)), tokens - 2)
    rounds = math.ceil((tokens - 1) / (depth + 1))  # each round commits the whole chain and one more token
    drafting = profile.seconds(DRAFTING, depth) if depth else 0.0
    decode = prefill + rounds * (profile.seconds("verify", 1 + depth) + drafting)
    return MethodCeiling(name, f"{rounds} × {depth} drafted", free, autoregressive / decode)


_PER_LAYER = 15e-6  # least seconds of a layer in an estimate: the time of launching its kernels in a CUDA graph
_HALF = 2  # bytes of a bfloat16 number

Document = dict[str, Any]
"""Result of a benchmark for JSON (docs/formats.md)."""


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


def projections(
    settings: BenchSettings, model: Model, machine: Machine, phases: Sequence[Phase]
) -> Iterator[tuple[str, Document]]:
    """Estimate how long a decode of a target with another shape takes in bfloat16 on other devices.

    `settings.projected` names the shape, `settings.projections` the devices. The forwards are the same as here, with
    the prompt length of that shape.

    Args:
        settings: Settings of the benchmark.
        model: The measured model.
        machine: This device's measured bandwidth and operations per second.
        phases: Phases measured on this device.

    Yields:
        For each device its name, and the estimates as a JSON document.
    """
    shape = shape_of(settings.projected, model.size)
    sizes = Sizes.of_shape(shape, model.target.actions.tokens, _HALF, _HALF)
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
    """Return how close the measured forwards come to the shortest possible time: the median of shortest ÷ measured.

    Args:
        phases: Measured phases.
        machine: The device's measured bandwidth and operations per second.

    Returns:
        Two medians in 0 … 1: one over the forwards that spend more time on reading memory, one over those that spend
        more on arithmetic. If one kind does not occur, the other kind's median stands for both.
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
    """Return the phases of another shape with times that are estimated for another device, not measured.

    A forward is assumed to come as close to its shortest possible time as here, and to take at least 15 µs per layer.
    The encoder's time is scaled by the bandwidth. Drafts of the shipped policy keep their time.

    Args:
        phases: Phases measured on this device, with the bytes and operations of the other shape.
        reached: Result of `shares`.
        here: This device's measured bandwidth and operations per second.
        there: The other device's bandwidth and operations per second.
        layers: Number of decoder layers of the other shape.
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


def ceiling_rows(by_tokens: Mapping[int, Sequence[MethodCeiling]]) -> list[tuple[str, ...]]:
    """Return a row per method: its name, then for each N how it verifies, and its speedups.

    The first speedup counts no time for drafting, the second one the measured time.

    Args:
        by_tokens: Highest speedup of each method, by N, the number of tokens in a chunk.
    """
    by_method: dict[str, list[str]] = {}
    for ceilings in by_tokens.values():
        for one in ceilings:
            by_method.setdefault(one.method, []).extend([one.how, f"{one.free:.2f}", f"{one.drafted:.2f}"])
    return [(method, *row) for method, row in by_method.items()]
