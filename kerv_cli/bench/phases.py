"""The costs of a decode, measured inside whole decodes of the engine's own loop on dummy drafts."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from kerv_cli.base.config import compose
from kerv_cli.base.errors import KervError
from kerv_cli.base.registry import parts
from kerv_cli.bench.machine import Machine, measure_machine
from kerv_cli.bench.model import Model, Sizes, blank
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.cost import FORWARDS
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.parts import Fixed
from kerv_cli.engine.proposer import Proposer
from kerv_cli.engine.record import Round
from kerv_cli.engine.stopwatch import Stopwatch
from kerv_cli.engine.tree import ROOT
from kerv_cli.episodes.policy import decoder_for
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.eagle.drafter import DrafterProposer
from kerv_cli.methods.early.drafter import EarlyProposer
from kerv_cli.methods.scout.drafter import ScoutProposer
from kerv_cli.methods.spec_vla import RelaxedRule
from kerv_cli.targets.compact.program import stored_bytes

_WARM_UP = 2  # cycles that do not count
_EVICTING = 16 * 2**20  # float32 numbers that are read between decodes: a simulator leaves nothing in the caches
_TREE = (5, 8, 50)  # depth, children, nodes of EAGLE-2's tree
_MERGED = 30  # nodes of a merged in-prefill draft
_TASK = "reach-v3"
SCOUT = "scout"
"""A draft whose cost is measured here; prices of recorded decodes take the recorded seconds."""

Key = tuple[str, int]
"""Kind of a cost, and its rows."""


@dataclass(frozen=True)
class Phase:
    """One measured cost.

    Attributes:
        kind: encode, prefill, verify, feed (the target's states into the drafter), draft (the drafter's chain), tree
            (its tree), or a draft of the shipped policy: early, retrieval, scout.
        rows: Forwarded tokens; tokens of a chain, levels of a tree.
        seconds: The median.
        least: The least of all repeats.
        read: Bytes that it must read at least.
        flops: Operations that it must do at least.
        floor: Seconds that the device needs for them; 0 if they are not counted.
    """

    kind: str
    rows: int
    seconds: float
    p95: float
    least: float
    read: float
    flops: float
    floor: float

    @property
    def share(self) -> float:
        """Floor ÷ median: 1 if the phase takes no longer than the device needs."""
        return self.floor / self.seconds

    @property
    def name(self) -> str:
        """The phase in words, for tables."""
        if self.kind == "verify":
            return "one token" if self.rows == 1 else f"verify {self.rows}"
        return f"{self.kind} {self.rows}" if self.kind in FORWARDS[1:] else self.kind

    def as_dict(self) -> dict[str, float | str]:
        """Return the fields, and rates in GB/s and GFLOP/s, as JSON values."""
        rates = {"gb_per_s": self.read / self.seconds / 1e9, "gflop_per_s": self.flops / self.seconds / 1e9}
        return {"name": self.name, **asdict(self), **rates, "share": self.share}


class Laps(Stopwatch):
    """A stopwatch that keeps every lap: its phase and seconds."""

    def __init__(self, device: torch.device) -> None:
        self.laps: list[tuple[str, float]] = []
        super().__init__(device)

    def lap(self, phase: str) -> None:
        """End a lap of a phase."""
        before = self.phases[phase]
        super().lap(phase)
        self.laps.append((phase, self.phases[phase] - before))

    def stop(self) -> float:
        """Stop, and return all seconds."""
        seconds = super().stop()
        if self.events is not None:
            pairs = itertools.pairwise(self.events)
            self.laps = [(phase, begin.elapsed_time(end) / 1000.0) for (_, begin), (phase, end) in pairs]
        return seconds


class Dummy(Proposer):
    """Draft a number of nodes: a chain, and more children of the root if the chunk has no room for a longer one."""

    name = "dummy"

    def __init__(self, nodes: int) -> None:
        self.nodes = nodes

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        """The dummy draft; see `Proposer.propose`."""
        chain = min(self.nodes, depth)
        return Draft.of(range(self.nodes), [*range(-1, chain - 1), *[ROOT] * (self.nodes - chain)])


def decoders(model: Model) -> list[Decoder]:
    """Return decoders whose rounds have all sizes that a chunk can have. They accept everything that is drafted."""
    target, size = model.target, model.size
    rule, everything = RelaxedRule(target.actions, strict_dofs=False), Fixed(target.actions.tokens)

    def decoder(in_prefill: int = 0, proposer: Proposer | None = None) -> Decoder:
        draft = Dummy(in_prefill) if in_prefill else None
        return Decoder(target, Parts(rule, everything, draft, proposer))

    equal = [n - 1 for n in range(2, size) if size % n == 0]  # rounds of as many rows as the prefill commits tokens
    every = [decoder(), *(decoder(n, Dummy(n)) for n in equal), decoder(0, Dummy(size - 2))]
    every += [decoder(size - 1), decoder(max(_MERGED, size - 1))]
    shapes = ((size - 2, 1, size - 2), (min(3, size - 2), 1, 3), _TREE)
    return every + [decoder(0, DrafterProposer(model.drafter, target, *shape)) for shape in shapes]


def costs_of(decoder: Decoder, prompt: int, rounds: Sequence[Round], laps: Sequence[tuple[str, float]]) -> Iterator[
    tuple[Key, float]
]:  # fmt: skip
    """Yield the costs in a decode and their seconds. A forward ends when the CPU has its argmax."""
    seconds = {phase: sum(s for name, s in laps if name == phase) for phase in ("vision", "prefill", "verify")}
    yield ("encode", 1), seconds["vision"]
    yield ("prefill", prompt + rounds[0].tree_size), seconds["prefill"]
    nodes = {one.tree_size for one in rounds[1:]}
    if len(nodes) == 1:
        yield ("verify", 1 + nodes.pop()), seconds["verify"] / (len(rounds) - 1)
    drafter = decoder.parts.proposer
    if isinstance(drafter, DrafterProposer):
        # behind the limits of acceptance: the prompt's states, then by turns a draft and the states of its tokens
        _, prompt_states, *turns = (s for name, s in laps if name == "propose")
        yield ("feed", prompt), prompt_states
        for one, drafting in zip(rounds[1:], turns[::2], strict=False):
            levels = min(drafter.depth, decoder.steps * decoder.target.actions.dofs - one.start - 1)
            yield ("tree" if drafter.top_k > 1 else "draft", levels), drafting
        for one, feeding in zip(rounds[1:], turns[1::2], strict=False):
            yield ("feed", 1 + one.accepted), feeding


@torch.inference_mode()
def measure(model: Model, machine: Machine, settings: BenchSettings) -> tuple[Machine, list[Phase]]:
    """Time all decoders in turn, `repeats` times, then measure the machine again.

    Returns:
        The machine's best rates, and the costs with floors at these rates.
    """
    device, evicting = model.target.device, torch.ones(_EVICTING)
    every, seconds = decoders(model), dict[Key, list[float]]()
    sources = source_decoders(settings)
    for turn in range(_WARM_UP + settings.repeats):
        costs: list[tuple[Key, float]] = []
        for decoder in every:
            evicting.sum()
            clock = Laps(device)
            prompt = model.target.encode(model.observation)
            clock.lap("vision")
            chunk = decoder.decode_prompt(prompt, clock)
            chunk.actions()
            clock.stop()
            costs += costs_of(decoder, prompt.shape[1], chunk.rounds, clock.laps)
        for kind, source in sources.items():
            evicting.sum()
            costs.append(((kind, 1), source.decode(blank(source.target)).phases["propose"]))
        for key, value in costs if turn >= _WARM_UP else ():
            seconds.setdefault(key, []).append(value)
    machine = machine.best_of(measure_machine(device, model.dtype))
    drafts = {(kind, 1): needs_of_draft(source) for kind, source in sources.items()}
    return machine, phases_of(seconds, model.sizes, machine, drafts)


def phases_of(
    seconds: Mapping[Key, Sequence[float]], sizes: Sizes, machine: Machine, drafts: Mapping[Key, tuple[float, float]]
) -> list[Phase]:
    """Return the costs by kind and rows. seconds: of every repeat. drafts: bytes and operations of the sources."""
    order = (*FORWARDS, *source_methods(), SCOUT)
    phases, prompt = [], min(rows for kind, rows in seconds if kind == "prefill")
    for (kind, rows), times in sorted(seconds.items(), key=lambda item: (order.index(item[0][0]), item[0][1])):
        read, flops = drafts.get((kind, rows)) or sizes.needs(kind, rows, prompt)
        median, p95 = np.percentile(times, [50, 95])
        floor = max(machine.bounds(read, flops))
        phases.append(Phase(kind, rows, float(median), float(p95), float(min(times)), read, flops, floor))
    return phases


@torch.inference_mode()
def needs_of_draft(decoder: Any) -> tuple[float, float]:
    """Return the bytes of the weights and the operations of a drafting network; zeros if it is none."""
    draft, target = decoder.parts.prefill_draft, decoder.target
    if not isinstance(draft, EarlyProposer):
        return 0.0, 0.0
    network: Any = draft.early
    given: Any = torch.zeros(1, target.pooled_width)
    if isinstance(draft, ScoutProposer):
        network, given = draft.scout, draft.inputs(blank(target))
    with FlopCounterMode(display=False) as counter:
        copy.deepcopy(network)(given)  # a copy is not compiled
    return stored_bytes(network), float(counter.get_total_flops())


def source_methods() -> dict[str, str]:
    """Return the kinds of proposers' own costs, each with the method whose decodes measure it."""
    measured = [part.traits for part in parts("proposer").values() if "measured_by" in part.traits]
    return {traits["cost"]: traits["measured_by"] for traits in measured}


def source_decoders(settings: BenchSettings) -> dict[str, Any]:
    """The shipped policy's decoders that execute an early draft and a stored chunk: whatever the target, these drafts
    do not grow with it. Empty where that policy is not there."""
    words = [f"runtime.{name}={getattr(settings.runtime, name)}" for name in ("device", "threads")]
    try:
        return {
            kind: decoder_for(compose("rollout", [f"method={method}", *words], RolloutSettings), _TASK)
            for kind, method in {**source_methods(), SCOUT: "scout_unverified"}.items()
        }
    except KervError:
        return {}
