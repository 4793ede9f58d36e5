"""The phases of a decode as functions that can be timed alone, their bytes and operations, and their measurement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch

from kerv_cli.bench.machine import Machine, measure_machine, timed
from kerv_cli.bench.model import Model
from kerv_cli.engine.transfer import read
from kerv_cli.methods.eagle.drafter import DraftState, draft_chain, observe

Seen = np.ndarray | torch.Tensor | None
"""The argument `seen` of `Target.forward`: which tokens of a draft each of its tokens attends to; None: a chain."""


@dataclass(frozen=True)
class Phase:
    """One measured phase. kind: encode, prefill, verify (1 row: a single token), feed (the target's states into the
    drafter), draft (rows: tokens of the drafter's chain), eager (one token without a captured graph). rows: forwarded
    tokens. seconds: median; read, flops: bytes and operations that it cannot do without; floor: the seconds that the
    device needs for them; share: floor over median."""

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
        """Floor over median: 1 where the phase takes no longer than the device needs; noise may exceed it."""
        return self.floor / self.seconds

    @property
    def name(self) -> str:
        """The phase in words, for tables."""
        if self.kind == "verify":
            return "one token" if self.rows == 1 else f"verify {self.rows}"
        return self.kind if self.kind == "encode" else f"{self.kind} {self.rows}"

    def as_dict(self) -> dict[str, float | str]:
        """For JSON: the fields, and rates in GB/s and GFLOP/s."""
        rates = {"gb_per_s": self.read / self.seconds / 1e9, "gflop_per_s": self.flops / self.seconds / 1e9}
        return {"name": self.name, **asdict(self), **rates, "share": self.share}


class Stage:
    """Runs a model's forwards on dummy tokens: prompts, verifications and drafts of any size, one at a time.

    A forward ends as in a decode: the argmax of its rows reaches the host.
    """

    def __init__(self, model: Model, room: int = 64) -> None:
        """room: most tokens behind the prompt."""
        self.model, self.target, self.device = model, model.target, model.target.device
        with torch.inference_mode():
            self.prompt = self.target.encode(model.observation)
        self.length = self.prompt.shape[1]
        self.cache = self.target.new_cache(1, self.length + room + 1)
        state = model.drafter.new_cache(1, self.length + 2 * room)
        self.draft_state = DraftState(state, torch.empty(0))
        self.hidden = self.prompt

    def tokens(self, count: int) -> torch.Tensor:
        """(1, count) tokens, any."""
        return torch.arange(count, device=self.device)[None] % self.target.actions.tokens

    def encode(self) -> None:
        """Observation -> prompt."""
        self.prompt = self.target.encode(self.model.observation)

    def prefill(self, drafted: int = 0, seen: Seen = None) -> list[int]:
        """The prompt and `drafted` tokens behind it -> argmax of the prompt's last row and of the drafted rows. seen:
        see `Seen`."""
        x = self.prompt
        if drafted:
            x = torch.cat([x, self.target.embed(self.tokens(drafted))], 1)
        self.cache.length = 0
        self.hidden = self.target.forward(x, torch.arange(x.shape[1], device=self.device), self.cache, seen)
        argmax: list[int] = self.target.head(self.hidden[0, self.length - 1 :]).argmax(-1).tolist()
        return argmax

    def verify(
        self,
        drafted: int = 0,
        committed: int = 1,
        seen: Seen = None,
        beside: torch.Tensor | None = None,
        reads: bool = True,
    ) -> list[int]:
        """The last of `committed` tokens and `drafted` tokens behind it -> argmax of every row.

        Args:
            drafted: tokens of the draft.
            committed: tokens of the chunk that are committed before this forward.
            seen: see `Seen`.
            beside: (m,) numbers that reach the host in the same transfer as the argmax.
            reads: whether the argmax reaches the host at all; without, the list is empty.
        """
        start = self.cache.length = self.length + committed - 1
        positions = torch.arange(start, start + 1 + drafted, device=self.device)
        x = self.target.embed(self.tokens(1 + drafted))
        self.hidden = self.target.forward(x, positions, self.cache, seen)
        argmax = self.target.head(self.hidden)[0].argmax(-1)
        if not reads:
            return []
        tokens: list[int] = read(argmax)[0].tolist() if beside is None else read(argmax, beside)[0].tolist()
        return tokens

    def feed(self, hidden: torch.Tensor, first: int) -> None:
        """The target's states hidden (1, T, E) at positions first … go into the drafter."""
        following = self.target.embed(self.tokens(hidden.shape[1]))
        observe(self.model.drafter, self.draft_state, following, hidden, first)

    def draft(self, depth: int) -> list[int]:
        """A chain of `depth` tokens from the drafter."""
        chain: list[int] = draft_chain(self.model.drafter, self.target, self.draft_state, depth).tolist()
        return chain


def costs(model: Model, rows: int, cached: int) -> tuple[float, float]:
    """Bytes and operations of a forward of `rows` tokens behind `cached` ones: every weight once, every key and value
    once; two operations per weight and row, four per attended key's number."""
    s = model.target.settings
    weights = model.trunk_weights
    slots = cached + rows
    size = 4 if model.target.device.type == "cpu" else model.dtype.itemsize  # CPU caches are float32
    read = weights * model.dtype.itemsize + 2.0 * s.layers * slots * s.width * size
    attended = rows * cached + rows * (rows + 1) / 2
    return read, 2.0 * weights * rows + 4.0 * s.layers * s.width * attended


def _phase(kind: str, rows: int, seconds: np.ndarray, needs: tuple[float, float], machine: Machine) -> Phase:
    read, flops = needs
    median, p95 = np.percentile(seconds, [50, 95])
    floor = machine.floor(read, flops)
    return Phase(kind, rows, float(median), float(p95), float(seconds.min()), read, flops, floor)


@torch.inference_mode()
def measure(
    model: Model, machine: Machine, tokens: Sequence[int], depth: int, repeats: int
) -> tuple[Machine, list[Phase]]:
    """Times every phase that a chunk of N tokens can have, for each N: one token, verify(1 + n), prefill(P + n) and
    drafts; then measures the machine again.

    Returns:
        The machine's best rates, and the phases with floors from these rates.
    """
    stage = Stage(model, max(tokens) + 2)
    most = max(tokens)
    device, length = stage.device, stage.length
    counts = sorted({1, 2, 4, 8, *tokens, most})
    phases: list[Phase] = []

    def add(kind: str, rows: int, needs: tuple[float, float], work: Callable[[], object]) -> None:
        phases.append(_phase(kind, rows, timed(work, device, repeats), needs, machine))

    add("encode", 1, (0.0, 0.0), stage.encode)
    for drafted in (0, *(n - 1 for n in counts if n > 2)):
        rows = length + drafted
        add("prefill", rows, costs(model, rows, 0), lambda n=drafted: stage.prefill(n))  # type: ignore[misc]
    stage.prefill()
    for rows in counts:
        add("verify", rows, costs(model, rows, length), lambda n=rows: stage.verify(n - 1))  # type: ignore[misc]
    stage.prefill()
    if device.type == "cuda":
        eager = Stage(model, most + 2)
        eager.cache = eager.target.new_cache(1, eager.cache.capacity, fixed=False)
        eager.prefill()
        add("eager", 1, costs(model, 1, length), eager.verify)  # what the captured graph saves
    _measure_drafter(model, stage, depth, add)
    machine = machine.best_of(measure_machine(device, model.dtype))
    return machine, [replace(phase, floor=machine.floor(phase.read, phase.flops)) for phase in phases]


Add = Callable[[str, int, tuple[float, float], Callable[[], object]], None]
"""Measures a phase: kind, rows, bytes and operations, what to run."""


def _measure_drafter(model: Model, stage: Stage, depth: int, add: Add) -> None:
    """Times feeding the drafter with one state and with the prompt's states, and its chains, after a prefill."""
    stage.feed(stage.hidden, 0)
    s = model.target.settings
    per_token = (layer_numbers(model) + 2 * s.width**2 + s.width * model.target.actions.tokens) * model.dtype.itemsize
    hidden, length = stage.hidden[:, : stage.length], stage.length
    for rows in (1, length):
        needs = per_token * 1.0, 2.0 * rows * per_token / model.dtype.itemsize
        add("feed", rows, needs, lambda n=rows: stage.feed(hidden[:, :n], 0))  # type: ignore[misc]
    for count in sorted({2, max(2, depth)}):  # the first token comes from the state that is there: no forward
        needs = per_token * (count - 1), 2.0 * (count - 1) * per_token / model.dtype.itemsize
        add("draft", count, needs, lambda n=count: stage.draft(n))  # type: ignore[misc]


def layer_numbers(model: Model) -> int:
    """Weights of the drafter's layers."""
    return sum(part.weight.numel() for layer in model.drafter.layers for part in _linears(layer))


def _linears(layer: torch.nn.Module) -> list[torch.nn.Linear]:
    return [part for part in layer.modules() if isinstance(part, torch.nn.Linear)]


@torch.inference_mode()
def flipped(model: Model, chunks: int, tokens: int) -> tuple[int, int]:
    """Tokens whose argmax in one verification differs from that of single forwards, and tokens compared: ties that the
    number format flips. The prompt is the model's own, the chunks' tokens random."""
    stage = Stage(model, tokens + 2)
    generator = torch.Generator().manual_seed(0)
    differ = 0
    for _ in range(chunks):
        chunk = torch.randint(model.target.actions.tokens, (1, tokens), generator=generator).to(stage.device)
        stage.tokens = lambda count, chunk=chunk: chunk[:, :count]  # type: ignore[misc,method-assign]
        stage.prefill()
        together = stage.verify(tokens - 1)
        stage.cache.length = stage.length
        for i in range(tokens):
            at = torch.tensor([stage.length + i], device=stage.device)
            hidden = stage.target.forward(stage.target.embed(chunk[:, i : i + 1]), at, stage.cache, None)
            differ += int(stage.target.head(hidden)[0, 0].argmax()) != together[i]
    return differ, chunks * tokens
