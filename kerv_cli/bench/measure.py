"""Measure how long each phase of a decode takes, and what the device can do at best.

The engine runs complete decodes with dummy drafts. `measure` is the whole benchmark.
"""

from __future__ import annotations

import functools
import logging
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from kerv_cli.base.config import compose
from kerv_cli.base.errors import KervError
from kerv_cli.base.registry import ProposerPart
from kerv_cli.bench.model import Model, blank
from kerv_cli.bench.physics import Sizes
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.decisions import ROOT
from kerv_cli.engine.decoder import Decoder, Parts, Stopwatch
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.parts import Fixed
from kerv_cli.engine.proposer import Proposer
from kerv_cli.engine.record import Round
from kerv_cli.episodes.cost import FORWARDS, Profile
from kerv_cli.episodes.policy import decoder_for
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.eagle.network import DrafterProposer
from kerv_cli.methods.spec_vla import RelaxedRule
from kerv_cli.targets.compact.program import Program
from kerv_cli.targets.provenance import stamp

_LOG = logging.getLogger("kerv")

_BUFFER = 64 * 2**20  # float32 numbers, 256 MiB: larger than the caches of a server, which hold 100 MB and more
_LEVELS = (2**20, 4 * 2**20, 16 * 2**20, 32 * 2**20)  # bytes of the buffers that measure the bandwidth of CPU caches
_ROWS, _WIDTH = 256, 4096  # of the matrix multiplication that measures operations per second
REPEATS = 9
_WARM_UP = 2  # repeats that do not count
_EVICTING = 16 * 2**20  # float32 numbers that are read before each decode, to empty the caches as a simulator does
_TREE = (5, 8, 50)  # depth, children, nodes of EAGLE-2's tree
_MERGED = 30  # nodes of a merged in-prefill draft
_TASK = "reach-v3"
_LAUNCH = re.compile(r"cu(da)?(Launch(Cooperative)?Kernel|GraphLaunch|Memcpy|Memset)")
Key = tuple[str, int]  # the attributes `kind` and `rows` of a `Phase`
Lap = tuple[str, float]  # phase of a decode, as in `engine.record.PHASES`, and its seconds


@dataclass(frozen=True)
class Machine:
    """What a device can do at best: bytes and operations per second, each the best of several measurements."""

    bandwidth: float  # bytes per second when reading a buffer that is larger than all caches
    flops: float  # operations per second of a large matrix multiplication in the number format of the weights
    # bytes per second of smaller buffers that fit into caches, in the order of `_LEVELS`. Empty on a GPU.
    caches: tuple[float, ...] = ()

    def bandwidth_of(self, read: float) -> float:
        """Return the bytes per second at which the same `read` bytes can be read again and again.

        This is the bandwidth of the smallest measured buffer that holds the bytes. If no buffer is that large, it is
        `bandwidth`.
        """
        for size, bandwidth in zip(_LEVELS, self.caches, strict=False):
            if read <= size:
                return bandwidth
        return self.bandwidth

    def bounds(self, read: float, flops: float) -> tuple[float, float]:
        return read / self.bandwidth_of(read), flops / self.flops

    def best_of(self, other: Machine) -> Machine:
        caches = tuple(map(max, self.caches, other.caches))
        return Machine(max(self.bandwidth, other.bandwidth), max(self.flops, other.flops), caches)


def fastest(work: Callable[[], object], device: torch.device) -> float:
    seconds = math.inf
    for _ in range(REPEATS):
        clock = Stopwatch(device)
        work()
        seconds = min(seconds, clock.stop())
    return seconds


@torch.inference_mode()
def measure_machine(device: torch.device, dtype: torch.dtype) -> Machine:
    """Measure a device's bandwidth and operations per second, with as many threads as torch has in this process."""

    def rate(numbers: int) -> float:
        return 4.0 * numbers / fastest(buffer[:numbers].sum, device)

    on_cpu = device.type == "cpu"
    buffer, width = torch.ones(_BUFFER, device=device), _WIDTH // 4 if on_cpu else _WIDTH
    bandwidth, caches = rate(_BUFFER), [rate(size // 4) for size in _LEVELS if on_cpu]
    x = torch.ones(_ROWS, width, dtype=dtype, device=device)
    weight = torch.ones(width, width, dtype=dtype, device=device)
    multiply: Callable[..., object] = functools.partial(F.linear, weight=weight)
    if on_cpu and dtype == torch.float32:  # as in a target's forward
        multiply = Program(multiply, (1, width))
    return Machine(bandwidth, 2.0 * _ROWS * width**2 / fastest(lambda: multiply(x), device), tuple(caches))


@dataclass(frozen=True)
class Phase:
    """The measured time of one phase of a decode."""

    # encode, prefill, verify, feed (the drafter reads the target's hidden states), draft (the drafter drafts a
    # chain), tree (the drafter drafts a tree), or early, retrieval (drafts made without the drafter). The last two
    # are measured with the shipped policy, because their time does not depend on the target's size.
    kind: str
    rows: int  # number of tokens in a forward or in a drafted chain. Depth of a drafted tree. 1 for the other kinds.
    seconds: float
    p95: float
    least: float
    read: float  # bytes that the phase must read. 0 if unknown.
    flops: float  # arithmetic operations that the phase needs. 0 if unknown.
    floor: float  # shortest possible seconds for these bytes and operations on this device. 0 if unknown.

    @property
    def name(self) -> str:
        if self.kind == "verify":
            return "one token" if self.rows == 1 else f"verify {self.rows}"
        return f"{self.kind} {self.rows}" if self.kind in FORWARDS[1:] else self.kind

    def as_dict(self) -> dict[str, float | str]:
        rates = {"gb_per_s": self.read / self.seconds / 1e9, "gflop_per_s": self.flops / self.seconds / 1e9}
        return {"name": self.name, **asdict(self), **rates, "share": self.floor / self.seconds}


class Dummy(Proposer):
    """A proposer that always drafts the same number of nodes, with arbitrary tokens.

    The nodes form a chain. Nodes that do not fit into the chunk become alternatives to the chain's first token.
    """

    name = "dummy"

    def __init__(self, nodes: int) -> None:
        self.nodes = nodes

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        chain = min(self.nodes, depth)
        return Draft.of(range(self.nodes), [*range(-1, chain - 1), *[ROOT] * (self.nodes - chain)])


def decoders(model: Model) -> list[Decoder]:
    """Return decoders that accept every draft and together run forwards of many sizes.

    The first one decodes without drafts. The next ones verify dummy drafts in the prefill or after it. The last three
    use the drafter: two verify chains, one verifies trees.
    """
    target, size = model.target, model.size
    rule, everything = RelaxedRule(target.actions, strict_dofs=False), Fixed(target.actions.tokens)

    def decoder(in_prefill: int = 0, proposer: Proposer | None = None) -> Decoder:
        draft = Dummy(in_prefill) if in_prefill else None
        return Decoder(target, Parts(rule, everything, draft, proposer))

    every = [decoder()]
    # drafts of which all rounds commit equally many tokens
    every += [decoder(rows - 1, Dummy(rows - 1)) for rows in range(2, size) if size % rows == 0]
    every += [decoder(0, Dummy(size - 2)), decoder(size - 1), decoder(max(_MERGED, size - 1))]
    for shape in ((size - 2, 1, size - 2), (min(3, size - 2), 1, 3), _TREE):
        every.append(decoder(0, DrafterProposer(model.drafter, target, *shape)))
    return every


def costs_of(
    decoder: Decoder, prompt: int, rounds: Sequence[Round], laps: Sequence[Lap]
) -> Iterator[tuple[Key, float]]:
    """Yield the kind, rows (both as in `Phase`) and seconds of each phase of a decode.

    A forward's seconds include copying the target's tokens to the CPU.
    """
    seconds = dict.fromkeys(("vision", "prefill", "verify", "propose"), 0.0)
    for name, lap in laps:
        seconds[name] = seconds.get(name, 0.0) + lap
    yield ("encode", 1), seconds["vision"]
    yield ("prefill", prompt + rounds[0].tree_size), seconds["prefill"]
    nodes = {one.tree_size for one in rounds[1:]}
    if len(nodes) == 1:
        yield ("verify", 1 + nodes.pop()), seconds["verify"] / (len(rounds) - 1)
    drafter = decoder.parts.proposer
    if isinstance(drafter, DrafterProposer):
        # The first lap computes thresholds. In the second, the drafter reads the prompt's states. After that, drafting
        # and reading the states of the committed tokens take turns.
        _, prompt_states, *turns = (s for name, s in laps if name == "propose")
        yield ("feed", prompt), prompt_states
        for one, drafting in zip(rounds[1:], turns[::2], strict=False):
            levels = min(drafter.depth, decoder.target.actions.longest(decoder.steps) - one.start - 1)
            yield ("tree" if drafter.top_k > 1 else "draft", levels), drafting
        for one, feeding in zip(rounds[1:], turns[1::2], strict=False):
            yield ("feed", 1 + one.accepted), feeding


def phases_of(seconds: Mapping[Key, Sequence[float]], sizes: Sizes, machine: Machine) -> Iterator[Phase]:
    """Yield a Phase per kind and number of rows, in the order of a decode. `seconds` has the times of all repeats."""
    order = (*FORWARDS, *source_methods())
    prompt = min(rows for kind, rows in seconds if kind == "prefill")
    for kind, rows in sorted(seconds, key=lambda key: (order.index(key[0]), key[1])):
        read, flops = sizes.needs(kind, rows, prompt)
        times = seconds[kind, rows]
        median, p95 = np.percentile(times, [50, 95])
        floor = max(machine.bounds(read, flops))
        yield Phase(kind, rows, float(median), float(p95), float(min(times)), read, flops, floor)


def profile_of(phases: Sequence[Phase], tokens: int) -> Profile:
    costs: dict[str, tuple[tuple[int, ...], tuple[float, ...]]] = {}
    for phase in phases:
        rows, seconds = costs.get(phase.kind, ((), ()))
        costs[phase.kind] = (*rows, phase.rows), (*seconds, phase.seconds)
    prompt = costs["prefill"][0][0] if "prefill" in costs else 0
    return Profile(prompt, costs, tokens)


def source_methods() -> dict[str, str]:
    return {part.cost: part.measured_by for part in ProposerPart.every().values() if part.measured_by}


def source_decoders(settings: BenchSettings) -> dict[str, Any]:
    """Return decoders of the shipped policy that measure the drafts `early` and `retrieval`, by these names.

    The time of these drafts does not depend on the size of the target. A draft that cannot be measured, for example
    because its drafter is missing, is left out, and a warning says why.
    """
    words = [f"runtime.device={settings.runtime.device}", f"runtime.threads={settings.runtime.threads}"]
    found = {}
    for kind, method in source_methods().items():
        try:
            found[kind] = decoder_for(compose("rollout", [f"method={method}", *words], RolloutSettings), _TASK)
        except KervError as error:
            _LOG.warning("the profile has no time of the draft '%s': %s", kind, error)
    return found


def title_of(model: Model) -> str:
    dtype, where = str(model.dtype).removeprefix("torch."), stamp(str(model.target.device))["device_name"]
    return f"{model.name}, {dtype}, {where}, {torch.get_num_threads()} thread, caches cold at first"


def document(model: Model, phases: Sequence[Phase], launched: float | None) -> dict[str, Any]:
    device = str(model.target.device)
    return {
        "target": model.name,
        "random_weights": model.is_shape,
        "dtype": str(model.dtype).removeprefix("torch."),
        "device": device,
        "threads": torch.get_num_threads(),
        "launches_per_token": launched,
        **stamp(device),
        "phases": list(map(Phase.as_dict, phases)),
        "profile": profile_of(phases, model.size).as_dict(),
    }


@torch.inference_mode()
def measure(model: Model, settings: BenchSettings) -> list[Phase]:
    """Measure the time of each phase of a decode. All decoders run in turn, `settings.repeats` times."""
    device, evicting = model.target.device, torch.ones(_EVICTING)
    machine = measure_machine(device, model.dtype)
    every, sources = decoders(model), source_decoders(settings)
    seconds: dict[Key, list[float]] = {}
    for turn in range(_WARM_UP + settings.repeats):
        costs: list[tuple[Key, float]] = []
        for decoder in every:
            evicting.sum()
            clock = Stopwatch(device)
            prompt = model.target.encode(model.observation)
            clock.lap("vision")
            chunk = decoder.decode_prompt(prompt, clock)
            chunk.actions(chunk.values(chunk.steps))
            clock.stop()
            costs += costs_of(decoder, prompt.shape[1], chunk.rounds, clock.laps)
        for kind, source in sources.items():
            evicting.sum()
            costs.append(((kind, 1), source.decode(blank(source.target)).phases["propose"]))
        if turn >= _WARM_UP:
            for key, value in costs:
                seconds.setdefault(key, []).append(value)
    machine = machine.best_of(measure_machine(device, model.dtype))
    return list(phases_of(seconds, model.sizes, machine))


@torch.inference_mode()
def launches_per_token(model: Model) -> float | None:
    """Count the calls that start work on the GPU in one autoregressive decode, per token.

    None on a CPU, and where PyTorch's profiler sees no calls.
    """
    if model.target.device.type == "cpu":
        return None
    decoder, prompt = Decoder(model.target), model.target.encode(model.observation)
    decoder.decode_prompt(prompt)  # captures the graphs
    with torch.profiler.profile() as profiler:
        chunk = decoder.decode_prompt(prompt)
        torch.cuda.synchronize()
    return launches(event.name for event in profiler.events()) / len(chunk.tokens) or None


def launches(calls: Iterable[str]) -> int:
    """Count the CUDA calls that start a kernel, a graph, a copy or a fill, by their names in a profile."""
    return sum(bool(_LAUNCH.match(call)) for call in calls)


def phase_rows(phases: Sequence[Phase]) -> Iterator[dict[str, str]]:
    for phase in phases:
        row = {"phase": phase.name}
        for name, seconds in (("median ms", phase.seconds), ("p95", phase.p95), ("least", phase.least)):
            row[name] = f"{1e3 * seconds:.2f}"
        limits = dict.fromkeys(("GB/s", "GFLOP/s", "floor ms", "least ÷ floor"), "–")
        if phase.floor > 0:
            limits["GB/s"] = f"{phase.read / phase.seconds / 1e9:.1f}"
            limits["GFLOP/s"] = f"{phase.flops / phase.seconds / 1e9:.0f}"
            limits["floor ms"] = f"{1e3 * phase.floor:.3f}"
            limits["least ÷ floor"] = f"{phase.least / phase.floor:.1f}"
        yield row | limits
