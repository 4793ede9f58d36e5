"""The chunk being decoded, what is known before the target runs, and the clock: what the parts of a decode share."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from kerv_cli.decoding.boundary import Choice
from kerv_cli.decoding.record import PHASES, Round
from kerv_cli.drafting.kinematics import ActionHistory
from kerv_cli.drafting.tree import TokenTree
from kerv_cli.errors import UsageError
from kerv_cli.targets.protocol import Cache


class Clock:
    """Seconds by phase between two synchronised ends."""

    def __init__(self, device: torch.device) -> None:
        self.cuda = device.type == "cuda"
        self.phases = dict.fromkeys(PHASES, 0.0)
        self.began = self.last = self._now()

    def _now(self) -> float:
        if self.cuda:
            torch.cuda.synchronize()
        return time.perf_counter()

    def lap(self, phase: str) -> None:
        """Everything since the last lap belongs to `phase`."""
        now = self._now()
        self.phases[phase] += now - self.last
        self.last = now

    def stop(self) -> float:
        self.lap("other")
        return self.last - self.began


def steps_of(asked: int, trained: int) -> int:
    """Control steps of a chunk: as many as asked for, 0 for as many as the target was trained for.

    Raises:
        UsageError: more than it was trained for.
    """
    if not 0 <= asked <= trained:
        raise UsageError(f"chunk={asked}: the target was trained for {trained} control steps")
    return asked or trained


@dataclass(frozen=True)
class Situation:
    """What is known before the target runs. history: executed actions, normalised, oldest first; path: measured
    end-effector positions (3,), metres; random: the episode's own numbers, for boundaries that draw lots."""

    task: str
    history: ActionHistory
    path: list[np.ndarray] = field(default_factory=list)
    random: np.random.Generator = field(default_factory=np.random.default_rng)


@dataclass
class Chunk:
    """The chunk being decoded. The cache holds the prompt and every committed token but the last."""

    prompt: Tensor  # (1, P, E)
    size: int  # N
    dofs: int  # D
    cache: Cache
    situation: Situation
    hidden: Tensor = field(default_factory=lambda: torch.empty(0))  # (1, P + c − 1, E) once c tokens are committed
    tokens: list[int] = field(default_factory=list)  # committed
    rounds: list[Round] = field(default_factory=list)
    forwards: int = 0
    variability: float = 0.0
    similarity: float | None = None  # of the best stored chunk, where one was looked up
    limits: tuple[int, ...] = ()  # bins per DoF that a draft may be off: what is worth drafting depends on it
    choice: Choice | None = None  # who drafts, where a boundary decides
    unverified: list[int] = field(default_factory=list)  # what the rejected draft had behind the rejected token
    guesses: list[int] = field(default_factory=list)  # target_tokens behind the rejected token: right if the draft was
    closed: np.ndarray | None = None  # (steps, D) normalised actions, once a rectifier ended the chunk

    @property
    def left(self) -> int:
        """Tokens still to be decoded; none once the chunk was closed."""
        return 0 if self.closed is not None else self.size - len(self.tokens)


class DraftsChunks(Protocol):
    """Drafts whole chunks without the target's states: what openings are merged from."""

    @property
    def name(self) -> str: ...

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Tokens behind the committed ones, at most `depth` each, the best first; none where nothing is known."""

    def is_sure(self, chunk: Chunk) -> bool:
        """Whether it expects its first chain to be accepted whole."""


class Proposer(Protocol):
    """Drafts a tree behind the committed tokens. `name` goes into the record; `needs_states` says whether it reads the
    target's hidden states: one that does not can also draft before the prefill."""

    @property
    def name(self) -> str: ...
    @property
    def needs_states(self) -> bool: ...

    def begin(self, chunk: Chunk) -> None:
        """The prompt is encoded and the first tokens are committed."""

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        """A tree of depth ≤ `depth`; an empty one means that nothing is drafted this round."""

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Tokens were committed behind chunk index `first`, the last token before them; hidden (1, T, E) are the
        target's states at chunk indices first … first + T − 1. target_tokens: the round's 1 + n argmax tokens, those behind
        rejected nodes included."""
