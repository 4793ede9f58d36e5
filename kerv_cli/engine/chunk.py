"""The chunk of actions that a decode fills, and the running episode.

Shapes: D degrees of freedom of an action, N tokens of a chunk, P prompt tokens, E width of the target.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.spaces import ActionSpace, Observation
from kerv_cli.engine.decisions import Choice, Judged, Rectified, SkipDecision
from kerv_cli.engine.record import PARALLEL, DecodeRecord, Round, variability

if TYPE_CHECKING:
    from torch import Tensor

    from kerv_cli.engine.protocol import Cache

WINDOW = 10  # number of past actions that a prediction reads (KERV's action context AC)


def chunk_steps(chunk: int, trained: int) -> int:
    """Return the number of control steps to decode at once: the user's `chunk`, or `trained` if `chunk` is 0."""
    if not 0 <= chunk <= trained:
        raise UsageError(f"chunk={chunk}: the target was trained for {trained} control steps")
    return chunk or trained


class Follower:
    """Follows one episode at a time. The caller reports the start, every executed action and the end.

    Attributes:
        cameras: Names of the cameras whose images the decoder reads.
        task: Name of the running episode's task.
        path: Measured positions of the end effector, (n, 3), metres, oldest first.
        decoded: Tokens of each chunk that was decoded in this episode, oldest first.
        planned: The last chunk's normalised actions (D,) that are not executed yet.
    """

    def __init__(self, space: ActionSpace, cameras: tuple[str, ...] = ()) -> None:
        self.space, self.cameras = space, cameras
        self._start("", np.zeros((0, 3)))

    def _start(self, task: str, path: np.ndarray) -> None:
        self.task, self.path, self.decoded, self.planned = task, path, list[list[int]](), list[np.ndarray]()
        self._executed = np.zeros((0, self.space.dofs))

    def reset(self, task: str, seed: int, end_effector: np.ndarray) -> None:
        """Start a new episode. Parts that draw random numbers use `seed`.

        Args:
            end_effector: Initial position (3,), metres.
        """
        self._start(task, np.array([end_effector]))

    def decode(self, observation: Observation) -> DecodeRecord:
        raise NotImplementedError

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        """Store an executed action (D,), environment units, and the end effector's position (3,) after it, metres."""
        self._executed = np.concatenate([self._executed, self.space.normalise(action)[None]])[-WINDOW:]
        self.path = np.concatenate([self.path, [end_effector]])
        del self.planned[:1]

    def starts(self, planned: Sequence[np.ndarray], dropped: int) -> None:
        """Begin to execute a chunk that other actions were executed during the decode of (`rollout.clock=real`).

        Args:
            planned: The chunk's normalised actions that are to be executed.
            dropped: Number of actions at its start that come too late, and are not in `planned`.
        """
        self.planned = list(planned)

    def history(self, pending: np.ndarray | None = None) -> np.ndarray:
        """Return the last executed actions (m, D), oldest first, normalised and not rounded to tokens; m ≤ WINDOW.

        Args:
            pending: Actions (k, D) of the current chunk that are decided but not executed yet. They count as executed.
        """
        if pending is None or not len(pending):
            return self._executed
        return np.concatenate([self._executed, pending])[-WINDOW:]

    def finish(self, success: bool) -> None:
        pass


@dataclass(eq=False)
class TargetSide:
    """What the target holds for one chunk: the prompt, the cache, and hidden states.

    Attributes:
        encode: Function that encodes the observation and returns the prompt's embeddings (1, P, E).
        cache: Keys and values of the prompt and of the committed tokens that the target has read.
        hidden: Hidden states after the prefill, (1, P + c − 1, E). c is the number of tokens that the prefill
            committed. None before the prefill.
    """

    encode: Callable[[], Tensor]
    cache: Cache
    hidden: Tensor | None = None

    @cached_property
    def prompt(self) -> Tensor:
        """The prompt's embeddings (1, P, E), computed when first read. So skipped chunks need not pay for encoding."""
        return self.encode()

    @property
    def prompt_length(self) -> int:
        return self.prompt.shape[1]

    def uncached(self, tokens: Sequence[int]) -> list[int]:
        """Return the committed `tokens` that the target has not read yet. Empty before the prefill.

        Usually this is only the newest token. After a rectifier has filled a control step, there may be several.
        """
        return list(tokens[self.cache.length - self.prompt_length :]) if tokens else []


@dataclass(eq=False)
class Chunk:
    """State of one decode. The parts of a method read this state, and the decoder stores their results in it.

    Attributes:
        steps: H, number of control steps.
        limits: Largest accepted distance of each DoF, in bins. Early drafters choose the tokens that are most likely to
            be accepted within these distances.
        choice: What the method's boundary decided about this chunk. None if the method has no boundary.
        tokens: The committed tokens.
        judged: The draft that the last round verified. Empty if that round verified no draft.
        forwards: Number of forwards of the target so far.
        similarity: Cosine similarity of the datastore's most similar entry. None if no part searched a datastore.
        reason: The skip rule's reason to skip or to verify.
        closed: The normalised actions (S, D) of S ≤ H control steps, if a rectifier ended the chunk early.
        filled: The normalised values that a rectifier predicted, if decoding went on after the prediction. The keys are
            the indices of the tokens that the values replace.
    """

    steps: int
    space: ActionSpace
    episode: Follower
    target: TargetSide
    limits: tuple[int, ...] = ()
    choice: Choice | None = None
    tokens: list[int] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    judged: Judged = field(default_factory=Judged)
    forwards: int = 0
    similarity: float | None = None
    reason: str | None = None
    closed: np.ndarray | None = None
    filled: dict[int, float] = field(default_factory=dict)

    @property
    def dofs(self) -> int:
        return self.space.dofs

    @cached_property
    def size(self) -> int:
        """Number of tokens N in the complete chunk. With an end token, N is the largest possible number."""
        longest = self.space.longest(self.steps)
        most = self.choice.most if self.choice is not None else None
        return longest if most is None else min(longest, most)

    @property
    def ended(self) -> bool:
        return self.closed is not None or (bool(self.tokens) and self.tokens[-1] == self.space.end)

    @property
    def remaining(self) -> int:
        return 0 if self.ended else self.size - len(self.tokens)

    @property
    def compensated(self) -> int:
        return len(self.filled) if self.closed is None else max(0, self.closed.size - len(self.tokens))

    @cached_property
    def variability(self) -> float | None:
        return variability(self.rounds, self.space)  # of the finished chunk

    def commit(self, record: Round, tokens: Sequence[int], judged: Judged | None = None) -> None:
        self.forwards += 1
        self.tokens += tokens
        self.rounds.append(record)
        self.judged = judged or Judged()

    def commit_token(self, token: int) -> None:
        mode, start = "decode" if self.tokens else "prefill", len(self.tokens)
        self.commit(Round(mode, start=start, target_tokens=(token,), committed=1), [token])

    def take(self, decision: SkipDecision) -> None:
        self.reason, tokens, proposer = decision.reason, decision.tokens, decision.proposer
        if tokens is None:
            return
        if len(tokens) < self.size:
            raise KervError(f"the skip rule took {len(tokens)} tokens of '{proposer}': a chunk has {self.size}")
        if proposer == PARALLEL:
            self.commit(Round(PARALLEL, target_tokens=tuple(tokens), committed=self.size), tokens)
            return
        check_tokens(tokens, self.space.tokens, proposer)
        self.tokens = self.until_end(tokens[: self.size])
        drafted = tuple(self.tokens)
        size = len(drafted)
        self.rounds.append(Round("skip", proposer, drafted=drafted, accepted=size, committed=size))

    def until_end(self, tokens: Sequence[int]) -> list[int]:
        found, end = list(tokens), self.space.end
        return found[: found.index(end) + 1] if end is not None and end in found else found

    def rectify(self, found: Rectified, with_target_token: bool) -> None:
        """Commit the values that a rectifier predicted. The robot executes these values without rounding to tokens.

        If decoding continues, the target reads the tokens that are nearest to the values.
        """
        if not with_target_token:
            del self.tokens[-1]
            self.rounds[-1] = self.rounds[-1]._replace(committed=self.rounds[-1].accepted)
        values, start = found.values, len(self.tokens)
        if found.ends:
            del self.tokens[values.size :]
            self.closed = values
            return
        self.filled |= dict(enumerate(values.flatten()[start:].tolist(), start))
        self.tokens += self.space.bins_of(values).flatten()[start:].tolist()

    def history(self) -> np.ndarray:
        """Return `Follower.history` as if this chunk's complete control steps were executed (FAST tokens have none)."""
        whole = 0 if self.space.code else len(self.tokens) // self.dofs
        decided = self.space.values_of(np.array(self.tokens[: whole * self.dofs], dtype=np.int64))
        return self.episode.history(decided.reshape(whole, self.dofs))

    def actions(self, values: np.ndarray) -> np.ndarray:
        """Return the actions (S, D) of `values`, float32, environment units; S ≤ `steps`."""
        return self.space.unnormalise(values[: self.steps]).astype(np.float32)

    def values(self, steps: int) -> np.ndarray:
        """Return the normalised actions (S, D). S is `steps` for FAST tokens, else the number of decoded steps."""
        if self.closed is not None:
            return self.closed
        values = self.space.chunk_values(self.tokens, steps)
        if self.filled:
            values.flat[list(self.filled)] = list(self.filled.values())
        return values

    def record(self, actions: np.ndarray, seconds: float, phases: dict[str, float]) -> DecodeRecord:
        return DecodeRecord(
            tokens=tuple(self.tokens),
            actions=actions,
            size=self.size,
            forwards=self.forwards,
            rounds=tuple(self.rounds),
            mode=next(filter(None, (one.drafter for one in self.rounds)), "ar"),
            seconds=seconds,
            phases=phases,
            compensated=self.compensated,
            filled=tuple(self.filled),
            variability=self.variability,
            skipped=any(one.mode == "skip" for one in self.rounds),
            similarity=self.similarity,
            metric=self.choice.metric if self.choice is not None else None,
            reason=self.reason,
        )


def check_tokens(tokens: Sequence[int], vocabulary: int, proposer: str) -> None:
    if len(tokens) and not (min(tokens) >= 0 and max(tokens) < vocabulary):
        wrong = next(token for token in tokens if not 0 <= token < vocabulary)
        raise KervError(f"the proposer '{proposer}' drafted token {wrong}: tokens are 0 to {vocabulary - 1}")
