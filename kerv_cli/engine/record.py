"""Records of a decode and of an episode. Recordings (.rrd), tables and plots are made from these records alone.

Notation (docs/methods.md §0): D degrees of freedom, H control steps in a chunk, N = H·D tokens of a chunk.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from kerv_cli.base.spaces import ActionSpace

PARALLEL = "parallel"  # mode of a round, and of its decode, in which a parallel target decoded all tokens at once

# phases of a decode; their seconds add up to `DecodeRecord.seconds`; `vision` is the time of `Target.encode`
PHASES = ("vision", "prefill", "propose", "verify", "accept", "rectify", "other")


class Round(NamedTuple):
    """One round of a decode: a draft, and the target tokens that it was compared with.

    Attributes:
        mode: "prefill" (the prompt alone, which gives token 0), "decode" (one token), "verify" (a draft), "skip" (the
            target did not run) or "parallel" (one forward gave all tokens).
        proposer: Name of the proposer that drafted, or "none".
        start: Number of tokens committed before this round.
        drafted: The accepted draft tokens, then the rejected one that is nearest to the target's token, if any.
        target_tokens: The target's tokens at the positions of `drafted`. If the whole draft was accepted and the chunk
            is not full, the bonus (the target's next token) comes after them.
        accepted: Number of accepted draft tokens.
        committed: Number of committed tokens: the accepted draft tokens and the bonus.
        tree_size: Number of draft tokens in the verified tree.
        threshold: Largest accepted distance per DoF, in bins. Empty if no acceptance rule ran.
        levels: Depth to which a tree was drafted. The verified tree may have fewer levels. 0 for a chain.
    """

    mode: str
    proposer: str = "none"
    start: int = 0
    drafted: tuple[int, ...] = ()
    target_tokens: tuple[int, ...] = ()
    accepted: int = 0
    committed: int = 0
    tree_size: int = 0
    threshold: tuple[int, ...] = ()
    levels: int = 0

    @property
    def drafter(self) -> str:
        if self.mode in ("skip", PARALLEL):
            return self.mode
        return "" if self.proposer == "none" else self.proposer

    @property
    def is_verification(self) -> bool:
        return self.tree_size > 0 and self.mode != "skip"


@dataclass(frozen=True)
class Delay:
    """Latency of a decode in a world that does not wait, and what the robot did meanwhile (docs/methods.md §8).

    Attributes:
        steps: Latency in control steps, rounded up.
        observed: Control step of the episode at which the observation was taken, from 0.
        carried: Number of control steps during the decode that executed the rest of the previous chunk.
        held: Number of control steps during the decode that repeated the last action. carried + held equals `steps`,
            unless the episode ended during the decode.
        dropped: Number of actions at the start of the new chunk that are not executed, because they are too old.
    """

    seconds: float
    steps: int
    observed: int
    carried: int = 0
    held: int = 0
    dropped: int = 0


@dataclass(frozen=True)
class Served:
    """What a policy's server reports about one of its answers.

    Attributes:
        seconds: Time that the server needed for the answer. NaN if the server does not report it.
        drafts: Number of drafts that the server verified.
        accepted: Number of draft tokens that the server accepted.
    """

    seconds: float = math.nan
    drafts: int = 0
    accepted: int = 0


@dataclass(frozen=True)
class DecodeRecord:
    """Result of decoding one observation: the actions to execute, and how they were computed."""

    tokens: tuple[int, ...]  # committed tokens in order: N of them, unless the rest of the chunk was dropped
    actions: np.ndarray  # (steps, D) float32, environment units, to be executed; steps ≤ H
    forwards: int  # target forwards, prefill included
    rounds: tuple[Round, ...]
    mode: str  # proposer of the first round that drafted; "ar": none did; "skip", PARALLEL, "expert" or "remote"
    seconds: float  # inference time (docs/methods.md §7), device synchronised at both ends; NaN: not timed
    phases: dict[str, float]  # seconds by phase, keys from PHASES
    compensated: int = 0  # tokens filled by a prediction instead of the target
    filled: tuple[int, ...] = ()  # indices of these tokens; empty if the chunk ended early: then they are the last ones
    size: int = 0  # N; 0: as many as `tokens`
    skipped: bool = False  # executed without verification
    variability: float | None = None  # K of this decode (§3.2), normalised action units
    similarity: float | None = None  # best retrieval similarity; None: nothing was retrieved
    metric: float | None = None  # F of the hybrid boundary (§4.4)
    reason: str | None = None  # the skip rule's reason to skip or to verify
    deviation: float | None = None  # mean |difference| to autoregressive actions; None: not measured
    delay: Delay | None = None  # None: the world waited for the decode
    served: Served | None = None  # of a policy behind a server

    @property
    def delay_steps(self) -> int | None:
        return None if self.delay is None else self.delay.steps

    def unverified_among(self, first: int, end: int) -> int:
        """Return the number of unverified values among the control steps first … end − 1 of `actions`.

        In a skipped or parallel decode these are all values. In any other decode they are the predicted values.
        """
        values = self.actions.size // max(1, len(self.actions))
        among = range(first * values, end * values)
        if self.skipped or self.mode == PARALLEL:
            return len(among)
        predicted = self.filled or range(self.actions.size - self.compensated, self.actions.size)
        return sum(place in among for place in predicted)

    @property
    def verifications(self) -> int:
        return sum(r.is_verification for r in self.rounds)

    @property
    def first_rejected(self) -> int | None:
        for r in self.rounds:
            if r.is_verification:
                return r.start + r.accepted if r.accepted < len(r.drafted) else self.size or len(self.tokens)
        return None


MEAN = "mean of compared"  # the measure of `DecodeRecord.variability`
# ways to compute the kinematic variability K of a decode (docs/methods.md §3.2); `accepted`: only accepted draft tokens
# count; `compared`: the rejected token after them counts, too
MEASURES = MEAN, "sum of compared", "mean of accepted", "sum of accepted"


def variability(rounds: Sequence[Round], space: ActionSpace, measure: str = MEAN) -> float | None:
    """Return the kinematic variability K, in normalised action units: how far drafts were from the target's tokens.

    Strict DoFs, such as a gripper, are left out, because one wrong gripper token would outweigh all other differences.
    None if no draft token of another DoF was judged, and for FAST tokens, which have no distances.
    """
    if space.code is not None:
        return None
    differences, centres, strict = list[float](), space.centres, space.is_strict.tolist()
    for one in rounds:
        if one.drafted and one.mode != "skip":
            count = one.accepted if measure.endswith("accepted") else len(one.drafted)
            pairs = zip(one.drafted[:count], one.target_tokens, strict=False)
            for place, (draft, target) in enumerate(pairs, one.start):
                if not strict[place % space.dofs]:
                    differences.append(abs(centres[draft] - centres[target]))
    if not differences:
        return None
    found = np.array(differences)
    return float(found.sum() if measure.startswith("sum") else found.mean())


def path_length(points: np.ndarray) -> float:
    """Return the sum of distances between successive points (n, 3), in metres. 0 if there are fewer than two points."""
    return float(np.linalg.norm(np.diff(points.astype(np.float64), axis=0), axis=1).sum())


@dataclass(frozen=True)
class EpisodeRecord:
    """One episode: a task, a seed, and everything that the decoder and the robot did."""

    environment: str  # name of the task's environment
    space: ActionSpace  # action space of the environment
    task: str
    instruction: str
    seed: int
    success: bool  # the task's flag at any step within the horizon
    steps: int  # T, control steps executed
    decodes: tuple[DecodeRecord, ...]
    decode_steps: tuple[int, ...]  # control step at which each decode's actions begin, same length as `decodes`
    actions: np.ndarray  # (T, D) float32, executed, environment units, within the space's limits
    path: np.ndarray  # (T + 1, 3) float32, end-effector positions, metres
    gripper: np.ndarray  # (T + 1,) float32, gripper opening, 0..1
    initial_state: np.ndarray  # (n,) float64, equal for episodes of a task that start in the same state
    frames: dict[int, np.ndarray] = field(default_factory=dict)  # control step -> (h, w, 3) uint8, if recorded
    closest_approach: float = math.nan  # least distance of fingertips to object, metres; NaN: unknown
    object_moved: float = math.nan  # largest motion of the object after the fingertips came near, metres; NaN: unknown
    wall_seconds: float = 0.0  # whole episode, with simulation and rendering
    places: dict[str, np.ndarray] = field(default_factory=dict)  # object, goal, … -> (T + 1, 3) metres, if recorded

    @property
    def seconds(self) -> float:
        return sum(d.seconds for d in self.decodes)

    @property
    def executed(self) -> list[tuple[int, int]]:
        found, begins = [], [*self.decode_steps[1:], self.steps]
        for decode, step, following in zip(self.decodes, self.decode_steps, begins, strict=True):
            first = decode.delay.dropped if decode.delay else 0
            found.append((first, min(len(decode.actions), first + following - step)))
        return found

    @property
    def forwards(self) -> int:
        return sum(d.forwards for d in self.decodes)

    @property
    def path_length(self) -> float:
        return path_length(self.path)

    @property
    def jerk(self) -> float:
        third = np.diff(self.path.astype(np.float64), n=3, axis=0) * self.space.control_hz**3
        return float(np.sqrt((third**2).sum(axis=1).mean())) if len(third) else math.nan
