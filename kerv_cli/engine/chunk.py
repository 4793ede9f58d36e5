"""The chunk that a decode fills, and what a decoder remembers of the running episode."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import ActionSpace, Observation
from kerv_cli.engine.draft import check_tokens
from kerv_cli.engine.protocol import Cache
from kerv_cli.engine.record import PARALLEL, DecodeRecord, Round

WINDOW = 10  # KERV's action context AC, control steps


def steps_of(chunk: int, trained: int) -> int:
    """Return the control steps of a chunk: `chunk`, or `trained` if it is 0.

    Raises:
        UsageError: `chunk` is more than the target was trained for.
    """
    if not 0 <= chunk <= trained:
        raise UsageError(f"chunk={chunk}: the target was trained for {trained} control steps")
    return chunk or trained


class ActionHistory:
    """The last `window` executed actions, normalised and continuous."""

    def __init__(self, dofs: int, window: int = WINDOW) -> None:
        self.window, self._actions = window, np.zeros((0, dofs))

    def append(self, action: np.ndarray) -> None:
        """Add an executed action (D,) in [-1, 1]."""
        self._actions = np.concatenate([self._actions, action[None]])[-self.window :]

    def values(self, pending: np.ndarray | None = None) -> np.ndarray:
        """Return the actions (m, D) with m ≤ window, oldest first.

        Args:
            pending: Steps (k, D) of the present chunk that are decided but not executed yet. They count as executed, so
                that the next step is one step ahead instead of k + 1.
        """
        if pending is None or not len(pending):
            return self._actions
        return np.concatenate([self._actions, pending])[-self.window :]


@dataclass(frozen=True)
class Situation:
    """The running episode, as the parts of a method see it."""

    task: str
    history: ActionHistory
    path: list[np.ndarray] = field(default_factory=list)  # measured end-effector positions (3,), metres
    random: np.random.Generator = field(default_factory=np.random.default_rng)  # the boundary's, seeded per episode


class EpisodeState:
    """What a decoder remembers of the running episode: its actions, its positions, and how often it decoded."""

    def __init__(self, space: ActionSpace, cameras: tuple[str, ...]) -> None:
        self.space, self.cameras, self.decodes = space, cameras, 0
        self.situation = Situation("", ActionHistory(space.dofs))

    def reset(self, task: str, seed: int, end_effector: np.ndarray) -> None:
        """Begin an episode, with the end effector at (3,) metres."""
        random = np.random.default_rng(seed)
        self.situation = Situation(task, ActionHistory(self.space.dofs), [np.asarray(end_effector)], random)
        self.decodes = 0

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        """Note an executed action (D,), after which the end effector is at (3,) metres."""
        self.situation.history.append(self.space.normalise(action))
        self.situation.path.append(np.asarray(end_effector))

    def finish(self, success: bool) -> None:
        """End the episode."""


@dataclass(frozen=True)
class Rejection:
    """What a verification computed after the accepted path.

    Attributes:
        draft: Tokens of the rejected draft after its rejected token.
        target: Target tokens after the rejected token and after each of `draft`. They are right only if the tokens
            before them are.
    """

    draft: tuple[int, ...] = ()
    target: tuple[int, ...] = ()


@dataclass(frozen=True)
class Choice:
    """A boundary's decision: the name of the proposer that drafts."""

    mode: str
    metric: float | None = None  # F (docs/methods.md §4.4), if the decision used it


@dataclass(eq=False)
class Chunk:
    """The N tokens of one decode. Parts of a method read it; only its own methods commit tokens.

    The cache holds the prompt and every committed token but the last.
    """

    encoding: Tensor | Callable[[], Tensor]  # the prompt, or a function that encodes it
    steps: int  # H
    space: ActionSpace
    cache: Cache
    situation: Situation
    limits: tuple[int, ...] = ()  # r per DoF, bins; early drafters choose their tokens by it
    choice: Choice | None = None  # None: the method has no boundary
    observation: Observation | None = None
    tokens: list[int] = field(default_factory=list)  # committed
    rounds: list[Round] = field(default_factory=list)
    rejection: Rejection = Rejection()  # of the last round
    hidden: Tensor = field(default_factory=lambda: torch.empty(0))  # (1, P + c − 1, E) after a prefill of c tokens
    # vectors (n,) that are read together with the next forward's target tokens, and who receives them
    reads: list[tuple[Tensor, Callable[[np.ndarray], None]]] = field(default_factory=list)
    forwards: int = 0
    similarity: float | None = None  # cosine of the best stored chunk, if one was looked up
    reason: str | None = None  # as in `DecodeRecord`
    closed: np.ndarray | None = None  # (steps, D) normalised actions, once a rectifier ended the chunk
    _differences: list[float] = field(default_factory=list)  # |draft − target| of judged tokens, normalised units

    @property
    def dofs(self) -> int:
        """D."""
        return self.space.dofs

    @property
    def size(self) -> int:
        """N."""
        return self.steps * self.space.dofs

    @property
    def prompt(self) -> Tensor:
        """The prompt (1, P, E), encoded when it is first read. Skipped chunks never pay for encoding."""
        if not isinstance(self.encoding, Tensor):
            self.encoding = self.encoding()
        return self.encoding

    @property
    def prompt_length(self) -> int:
        """P."""
        return self.prompt.shape[1]

    @property
    def remaining(self) -> int:
        """Tokens still to be decoded; 0 after a rectifier closed the chunk."""
        return 0 if self.closed is not None else self.size - len(self.tokens)

    @property
    def compensated(self) -> int:
        """Number of the actions' values that a rectifier predicted."""
        return 0 if self.closed is None else max(0, self.closed.size - len(self.tokens))

    @property
    def variability(self) -> float | None:
        """K: mean difference of draft and target tokens, normalised action units; None if none was judged.

        Strict DoFs are left out: one flip would outweigh all others (docs/methods.md §3.2).
        """
        return float(np.mean(self._differences)) if self._differences else None

    def distance(self, tokens: Sequence[int], others: Sequence[int]) -> float:
        """Return the mean absolute difference of two beginnings of this chunk, in normalised action units.

        It is infinite if a strict DoF's tokens differ.
        """
        first, second = np.array(tokens), np.array(others)
        if (first != second)[self.space.strict_tokens(len(first))].any():
            return math.inf
        return float(np.abs(self.space.values_of(first) - self.space.values_of(second)).mean())

    def targets_along(self, chain: Sequence[int]) -> list[int] | None:
        """Return the target's tokens along a drafted chain, from the chunk's first verification.

        None if that verification judged another draft, or fewer than all but the last token of the chain. Call it
        before the next round, which forgets what follows the rejection.
        """
        if not self.rounds:
            return None
        verification, rejection = self.rounds[-1], self.rejection
        path = [*verification.drafted, *rejection.draft]
        if verification.start or len(path) < self.size - 1 or path != list(chain[: len(path)]):
            return None
        return [*verification.target_tokens[: len(verification.drafted)], *rejection.target[: len(rejection.draft)]]

    def commit(self, record: Round, tokens: Sequence[int], rejection: Rejection | None = None) -> None:
        """Commit the tokens of one forward.

        Args:
            record: The forward's round.
            tokens: What is committed.
            rejection: What the forward computed after a rejected token.
        """
        self.forwards += 1
        self.tokens += tokens
        self.rounds.append(record)
        self.rejection = rejection or Rejection()
        if record.drafted:
            both = np.array((record.drafted, record.target_tokens[: len(record.drafted)]))
            drafted, targets = self.space.values_of(both)
            moving = ~self.space.strict_tokens(self.size)[record.start : record.start + len(drafted)]
            self._differences += np.abs(drafted - targets)[moving].tolist()

    def commit_token(self, token: int) -> None:
        """Commit the one token of a forward without a draft."""
        mode, start = "decode" if self.tokens else "prefill", len(self.tokens)
        self.commit(Round(mode, start=start, target_tokens=(token,), committed=1), [token])

    def commit_at_once(self, tokens: Sequence[int]) -> None:
        """Commit all N tokens of a parallel target's one pass."""
        self.commit(Round(PARALLEL, target_tokens=tuple(tokens), committed=self.size), tokens)

    def skip(self, tokens: Sequence[int], proposer: str) -> None:
        """Take all N tokens from `proposer`, without a verification.

        Raises:
            KervError: A token is out of range.
        """
        check_tokens(np.asarray(tokens), self.space.tokens, proposer)
        self.tokens = list(tokens[: self.size])
        drafted = tuple(self.tokens)
        self.rounds.append(Round("skip", proposer, drafted=drafted, accepted=self.size, committed=self.size))

    def close(self, values: np.ndarray, with_target_token: bool) -> None:
        """End the chunk with actions that are partly predicted.

        Args:
            values: Normalised actions (steps, D): the committed tokens' values, then predictions.
            with_target_token: Whether the target token at the rejected position stays committed.
        """
        if not with_target_token:
            del self.tokens[-1]
            self.rounds[-1] = replace(self.rounds[-1], committed=self.rounds[-1].accepted)  # without the bonus
        del self.tokens[values.size :]
        self.closed = values

    def actions(self) -> np.ndarray:
        """Return the complete chunk's actions (steps, D), float32, environment units."""
        if self.closed is None:
            return actions_of(self.space, self.tokens)
        return self.space.unnormalise(self.closed).astype(np.float32)

    def record(self, actions: np.ndarray, seconds: float, phases: dict[str, float]) -> DecodeRecord:
        """Return the record of the complete chunk. The arguments are those of `DecodeRecord`."""
        modes = [one.mode for one in self.rounds]
        drafters = (one.mode if one.mode in ("skip", PARALLEL) else one.proposer for one in self.rounds)
        return DecodeRecord(
            tokens=tuple(self.tokens),
            actions=actions,
            size=self.size,
            forwards=self.forwards,
            rounds=tuple(self.rounds),
            mode=next((name for name in drafters if name != "none"), "ar"),
            seconds=seconds,
            phases=phases,
            compensated=self.compensated,
            variability=self.variability,
            skipped="skip" in modes,
            similarity=self.similarity,
            metric=self.choice.metric if self.choice is not None else None,
            reason=self.reason,
        )


def actions_of(space: ActionSpace, tokens: Sequence[int]) -> np.ndarray:
    """Return the actions (steps, D) of whole control steps' tokens, float32, environment units."""
    return space.decode(np.array(tokens).reshape(-1, space.dofs)).astype(np.float32)


def deviation(space: ActionSpace, actions: np.ndarray, autoregressive: np.ndarray) -> float:
    """Return the mean absolute difference of two chunks, in normalised action units.

    Args:
        space: The action space.
        actions: The executed actions (h, D).
        autoregressive: Autoregressive decoding's actions (H, D). Only the first h ≤ H count.
    """
    gap = space.normalise(actions) - space.normalise(autoregressive[: len(actions)])
    return float(np.abs(gap).mean())
