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
from kerv_cli.spaces import ActionSpace
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
        """Seconds since the clock was made; what no lap claimed belongs to `other`."""
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


@dataclass(frozen=True)
class Rejection:
    """What a verification knew behind the accepted path. draft: the rejected draft's tokens behind its rejected one.
    target: the target's tokens behind the rejected token and behind those, right if the draft was."""

    draft: tuple[int, ...] = ()
    target: tuple[int, ...] = ()


class Chunk:
    """The N tokens of one decode. Only its own methods change what is committed; the parts of a method read it.

    prompt (1, P, E), size N, limits: bins per DoF that a draft may be off, on which it depends what is worth drafting.
    choice: which side drafts, where a boundary decides. The cache holds the prompt and every committed token but the
    last; `hidden` (1, P + c − 1, E) are the target's states there once the first c tokens are committed.
    """

    def __init__(
        self,
        prompt: Tensor,
        steps: int,
        space: ActionSpace,
        cache: Cache,
        situation: Situation,
        limits: tuple[int, ...] = (),
        choice: Choice | None = None,
    ) -> None:
        self.prompt, self.space, self.cache, self.situation = prompt, space, cache, situation
        self.size, self.limits, self.choice = steps * space.dofs, limits, choice
        self.tokens: list[int] = []
        self.rounds: list[Round] = []
        self.rejection = Rejection()
        self.hidden = torch.empty(0)
        self.forwards = 0
        self._differences: list[float] = []  # of judged tokens, |draft − target token| in normalised action units
        self.similarity: float | None = None  # of the best stored chunk, where one was looked up
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
    def prompt_length(self) -> int:
        """P."""
        return self.prompt.shape[1]

    @property
    def left(self) -> int:
        """Tokens still to be decoded; none once the chunk was closed."""
        return 0 if self.closed is not None else self.size - len(self.tokens)

    @property
    def variability(self) -> float | None:
        """K: mean difference of draft and target over the judged tokens, normalised action units; strict DoFs left out,
        of which one flip would outweigh all others. None where none was judged (§3.2)."""
        return float(np.mean(self._differences)) if self._differences else None

    def encoded(self, hidden: Tensor) -> None:
        """The prompt, and what of a draft behind it was accepted, has the states hidden (1, P + c − 1, E)."""
        self.hidden = hidden

    def commit(self, played: Round, tokens: Sequence[int], rejection: Rejection | None = None) -> None:
        """A forward ended: `tokens` are committed, `played` tells how."""
        self.forwards += 1
        self.tokens += tokens
        self.rounds.append(played)
        self.rejection = rejection or Rejection()
        if played.drafted:
            judged = np.array(played.drafted), np.array(played.target_tokens[: len(played.drafted)])
            drafted, wanted = map(self.space.values_of, judged)
            moving = ~self.space.strict_tokens(self.size)[played.start : played.start + len(drafted)]
            self._differences += np.abs(drafted - wanted)[moving].tolist()

    def skip(self, tokens: Sequence[int], proposer: str) -> None:
        """All N tokens are `proposer`'s, without a verification."""
        self.tokens = list(tokens[: self.size])
        self.rounds.append(Round("skip", proposer, 0, tuple(self.tokens), (), self.size, self.size, 0, ()))

    def close(self, values: np.ndarray, with_target_token: bool) -> None:
        """The chunk ends with values (steps, D), normalised: its committed tokens, then predictions. Without the target
        token at the rejected position, that one is taken back."""
        if not with_target_token:
            del self.tokens[-1]
            self.rounds[-1] = self.rounds[-1].without_bonus()
        del self.tokens[values.size :]
        self.closed = values

    def looked_up(self, similarity: float) -> None:
        """The best stored chunk is this similar to what is seen, cosine."""
        self.similarity = similarity


class DraftsChunks(Protocol):
    """Drafts whole chunks without the target's states: what a merged draft is made of."""

    @property
    def name(self) -> str: ...

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Tokens behind the committed ones, at most `depth` each, the best first; none where nothing is known."""

    def is_sure(self, chunk: Chunk) -> bool:
        """Whether it expects its first chain to be accepted whole."""


class Proposer(Protocol):
    """Drafts a tree behind the committed tokens. `name` goes into the record; `needs_states` says whether it reads the
    target's hidden states: one that does not can also draft before the prefill. `nodes`: the largest tree it proposes;
    0: at most a chunk's tokens."""

    @property
    def name(self) -> str: ...
    @property
    def needs_states(self) -> bool: ...
    @property
    def nodes(self) -> int: ...

    def begin(self, chunk: Chunk) -> None:
        """The prompt is encoded and the first tokens are committed."""

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        """A tree of depth ≤ `depth`; an empty one means that nothing is drafted this round."""

    def committed(self, chunk: Chunk, first: int, hidden: Tensor, target_tokens: Sequence[int]) -> None:
        """Tokens were committed behind chunk index `first`, the last token before them; hidden (1, T, E) are the
        target's states at chunk indices first … first + T − 1. target_tokens: the round's 1 + n argmax tokens, those
        behind rejected nodes included."""
