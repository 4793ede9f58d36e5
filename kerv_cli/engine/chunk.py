"""What the parts of a decode share: the clock, the actions and positions before the decode, the chunk."""

from __future__ import annotations

import itertools
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import ActionSpace, Observation
from kerv_cli.engine.protocol import Cache
from kerv_cli.engine.record import PARALLEL, PHASES, Round

Mode = Literal["retrieval", "drafter"]
WINDOW = 10  # KERV's action context AC, control steps


class Clock:
    """Stopwatch of one decode: seconds per phase.

    On CUDA it synchronises when it is made and when it stops, and nowhere between: laps are events in the stream, read
    at the end, so that measuring phases does not keep the host from running ahead.
    """

    def __init__(self, device: torch.device) -> None:
        self.phases = dict.fromkeys(PHASES, 0.0)
        self.events: list[tuple[str, torch.cuda.Event]] | None = None
        if device.type == "cuda":
            torch.cuda.synchronize()
            self.events = [("", _event())]
        self.began = self.last = time.perf_counter()

    def lap(self, phase: str) -> None:
        """Adds the time since the last lap to `phase`; on CUDA the device's time, added when the clock stops."""
        if self.events is not None:
            self.events.append((phase, _event()))
            return
        now = time.perf_counter()
        self.phases[phase] += now - self.last
        self.last = now

    def stop(self) -> float:
        """Seconds since the clock was made; the time since the last lap is added to `other`."""
        self.lap("other")
        if self.events is not None:
            torch.cuda.synchronize()
            self.last = time.perf_counter()
            for (_, begin), (phase, end) in itertools.pairwise(self.events):
                self.phases[phase] += begin.elapsed_time(end) / 1000.0
            self.phases["other"] += max(0.0, self.last - self.began - sum(self.phases.values()))
        return self.last - self.began


def _event() -> torch.cuda.Event:
    """An event with a time, recorded in the current stream."""
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def steps_of(chunk: int, trained: int) -> int:
    """Control steps of a chunk: `chunk`, or, where that is 0, as many as the target was trained for.

    Raises:
        UsageError: more than it was trained for.
    """
    if not 0 <= chunk <= trained:
        raise UsageError(f"chunk={chunk}: the target was trained for {trained} control steps")
    return chunk or trained


class ActionHistory:
    """The last `window` executed actions, normalised and continuous."""

    def __init__(self, dofs: int, window: int = WINDOW) -> None:
        self.dofs = dofs
        self._actions: deque[np.ndarray] = deque(maxlen=window)
        self._stacked = np.zeros((0, dofs))  # these actions as one array, which nobody writes to
        self._stacked.flags.writeable = False

    def append(self, action: np.ndarray) -> None:
        """An action (D,) in [-1, 1] was executed."""
        self._actions.append(np.asarray(action, dtype=np.float64))
        self._stacked = np.array(self._actions)
        self._stacked.flags.writeable = False

    def values(self, pending: np.ndarray | None = None) -> np.ndarray:
        """(m, D), oldest first, m ≤ window.

        pending: (k, D) steps of the present chunk that are decided but not yet executed. They are appended as
        if executed, so that the next step is one step ahead instead of k + 1.
        """
        if pending is None or not len(pending):
            return self._stacked
        steps = np.concatenate([self._stacked, np.asarray(pending, dtype=np.float64)])
        return steps[-(self._actions.maxlen or 0) :]


@dataclass(frozen=True)
class Situation:
    """The episode before a decode. history: executed actions, normalised, oldest first. path: measured end-effector
    positions (3,), metres. random: the boundary's generator, seeded per episode."""

    task: str
    history: ActionHistory
    path: list[np.ndarray] = field(default_factory=list)
    random: np.random.Generator = field(default_factory=np.random.default_rng)


@dataclass(frozen=True)
class Rejection:
    """What a verification found behind the accepted path. draft: the rejected draft's tokens behind its rejected token.
    target: target tokens behind the rejected token and behind those; valid only if the tokens before them had been
    right."""

    draft: tuple[int, ...] = ()
    target: tuple[int, ...] = ()


@dataclass(frozen=True)
class Choice:
    """A boundary's decision: which side drafts, and F where the decision used it."""

    mode: Mode
    metric: float | None = None


class Chunk:
    """The N tokens of one decode. Only its own methods change what is committed; the parts of a method read it.

    prompt: (1, P, E), encoded when it is first read: a chunk that nothing of the target's decodes costs no encoding.
    observation: what is decoded, where there is one. size: N. limits: r per DoF in bins; early drafters choose their
    tokens by it. choice: which side drafts, where a boundary decides. The cache holds the prompt and every committed
    token but the last; `hidden` (1, P + c − 1, E) are the target's states there after the prefill, which committed c
    tokens.
    """

    def __init__(
        self,
        prompt: Tensor | Callable[[], Tensor],
        steps: int,
        space: ActionSpace,
        cache: Cache,
        situation: Situation,
        limits: tuple[int, ...] = (),
        choice: Choice | None = None,
        observation: Observation | None = None,
    ) -> None:
        self._prompt, self.space, self.cache, self.situation = prompt, space, cache, situation
        self.observation = observation
        self.size, self.limits, self.choice = steps * space.dofs, limits, choice
        self.tokens: list[int] = []
        self.rounds: list[Round] = []
        self.rejection = Rejection()
        self.hidden = torch.empty(0)
        # vectors (n,) that the host reads in the same copy as the next forward's target tokens, and their receivers
        self.reads: list[tuple[Tensor, Callable[[np.ndarray], None]]] = []
        self.forwards = 0
        self._differences: list[float] = []  # of judged tokens, |draft − target token| in normalised action units
        self.similarity: float | None = None  # cosine of the best stored chunk, where one was looked up
        self.reason: str | None = None  # as in `DecodeRecord`
        self.closed: np.ndarray | None = None  # (steps, D) normalised actions, once a rectifier ended the chunk

    @property
    def dofs(self) -> int:
        """D."""
        return self.space.dofs

    @property
    def steps(self) -> int:
        """H, control steps."""
        return self.size // self.dofs

    @property
    def prompt(self) -> Tensor:
        """(1, P, E)."""
        if not isinstance(self._prompt, Tensor):
            self._prompt = self._prompt()
        return self._prompt

    @property
    def encoded(self) -> bool:
        """Whether the target encoded the observation."""
        return isinstance(self._prompt, Tensor)

    @property
    def prompt_length(self) -> int:
        """P."""
        return self.prompt.shape[1]

    @property
    def remaining(self) -> int:
        """Tokens still to be decoded; 0 after a rectifier closed the chunk."""
        return 0 if self.closed is not None else self.size - len(self.tokens)

    @property
    def variability(self) -> float | None:
        """K: mean difference of draft and target over the judged tokens, normalised action units; None where none was
        judged. Strict DoFs are left out: one flip would outweigh all others (docs/methods.md §3.2)."""
        return float(np.mean(self._differences)) if self._differences else None

    def distance(self, tokens: Sequence[int], others: Sequence[int]) -> float:
        """Mean absolute difference of two token sequences from a chunk's first token on, normalised action units;
        infinite where a strict DoF's tokens differ."""
        first, second = np.array(tokens), np.array(others)
        if (first != second)[self.space.strict_tokens(len(first))].any():
            return math.inf
        return float(np.abs(self.space.values_of(first) - self.space.values_of(second)).mean())

    def targets_along(self, chain: Sequence[int]) -> list[int] | None:
        """The target's tokens along a drafted chain, from the chunk's first verification; None where that judged
        another draft, or less than all but the last token of the chain. The next round forgets what lies behind the
        rejection: call it before."""
        if not self.rounds:
            return None
        verification, rejection = self.rounds[-1], self.rejection
        path = [*verification.drafted, *rejection.draft]
        if verification.start or len(path) < self.size - 1 or path != list(chain[: len(path)]):
            return None
        return [*verification.target_tokens[: len(verification.drafted)], *rejection.target[: len(rejection.draft)]]

    def commit(self, record: Round, tokens: Sequence[int], rejection: Rejection | None = None) -> None:
        """Commits `tokens` after a forward. record: of its round."""
        self.forwards += 1
        self.tokens += tokens
        self.rounds.append(record)
        self.rejection = rejection or Rejection()
        if record.drafted:
            both = np.array((record.drafted, record.target_tokens[: len(record.drafted)]))
            drafted, targets = self.space.values_of(both)
            moving = ~self.space.strict_tokens(self.size)[record.start : record.start + len(drafted)]
            self._differences += np.abs(drafted - targets)[moving].tolist()

    def skip(self, tokens: Sequence[int], proposer: str) -> None:
        """Takes all N tokens from `proposer`, without a verification."""
        self.tokens = list(tokens[: self.size])
        self.rounds.append(Round("skip", proposer, 0, tuple(self.tokens), (), self.size, self.size, 0, ()))

    def commit_at_once(self, tokens: Sequence[int]) -> None:
        """Commits all N tokens after one pass of a parallel target."""
        self.commit(Round(PARALLEL, "none", 0, (), tuple(tokens), 0, self.size, 0, ()), tokens)

    def close(self, values: np.ndarray, with_target_token: bool) -> None:
        """Ends the chunk with values (steps, D), normalised: its committed tokens, then predictions. with_target_token:
        whether the target token at the rejected position stays committed."""
        if not with_target_token:
            del self.tokens[-1]
            self.rounds[-1] = replace(self.rounds[-1], committed=self.rounds[-1].accepted)  # without the bonus
        del self.tokens[values.size :]
        self.closed = values
