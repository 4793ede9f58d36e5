"""Records of a decode and of an episode. Rerun files, tables and plots are made from them alone.

Notation (docs/methods.md §0): D degrees of freedom, H control steps in a chunk, N = H·D tokens of a chunk.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from kerv_cli.base.spaces import ActionSpace

PARALLEL = "parallel"
"""Mode of a round, and of its decode, in which the target decoded all tokens at once."""

PHASES = ("vision", "prefill", "propose", "verify", "accept", "rectify", "other")
"""Phases of a decode. Their seconds add up to `DecodeRecord.seconds`. vision is `Target.encode`."""

UNTIMED = dict.fromkeys(PHASES, math.nan)
"""Phases of a decode that was computed together with others and has no time of its own."""


@dataclass(frozen=True)
class Round:
    """One round of a decode: a draft and the target tokens it was compared with.

    Attributes:
        mode: "prefill" (token 0), "decode" (one token), "verify" (a tree), "skip" (no forward) or PARALLEL.
        proposer: Name of the proposer that drafted, or "none".
        start: Number of tokens committed before this round.
        drafted: The judged path: the accepted tokens and, after a rejection, the rejected candidate that is nearest to
            the target token.
        target_tokens: The target's tokens at the same positions. If the whole path was accepted and places are left,
            one more: the bonus.
        accepted: Number of accepted draft tokens.
        committed: Number of committed tokens: accepted ones and the bonus.
        tree_size: Number of verified nodes.
        threshold: r per DoF, in bins. Empty if no acceptance rule ran.
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

    @property
    def is_verification(self) -> bool:
        """Whether the target verified a tree."""
        return self.tree_size > 0 and self.mode != "skip"


@dataclass(frozen=True)
class Delay:
    """What the world did while the policy decoded (docs/methods.md §8)."""

    seconds: float  # latency
    steps: int  # the same in control steps, rounded up
    observed: int  # control step at which the observation was taken
    carried: int = 0  # steps that executed the chunk before; carried + held < steps if the episode ended
    held: int = 0  # steps that held the last action
    dropped: int = 0  # first actions of the new chunk that were left out


@dataclass(frozen=True)
class DecodeRecord:
    """One call of the decoder: from an observation to the actions to execute."""

    tokens: tuple[int, ...]  # committed tokens in order: N of them, unless the rest of the chunk was dropped
    actions: np.ndarray  # (steps, D) float32, environment units, what is executed; steps ≤ H
    forwards: int  # target forwards, prefill included
    rounds: tuple[Round, ...]
    mode: str  # proposer of the first round that drafted; "skip": not verified; PARALLEL; "ar": no draft; "expert"
    seconds: float  # inference time (docs/methods.md §7), device synchronised at both ends; NaN: not timed
    phases: dict[str, float]  # seconds by phase, keys from PHASES
    compensated: int = 0  # tokens filled by a prediction instead of the target
    size: int = 0  # N; 0: as many as `tokens`
    skipped: bool = False  # executed without a verification
    variability: float | None = None  # K of this decode (§3.2), normalised action units
    similarity: float | None = None  # best retrieval similarity; None: nothing was retrieved
    metric: float | None = None  # F of the hybrid boundary (§4.4)
    reason: str | None = None  # why a skip rule executed the draft unverified, or had it verified
    deviation: float | None = None  # mean abs difference to AR's chunk from the same observation; None: not sampled
    delay: Delay | None = None  # None: the world waited

    @property
    def delay_steps(self) -> int | None:
        """Control steps that the world went on during the decode; None if it waited."""
        return None if self.delay is None else self.delay.steps

    @property
    def unverified(self) -> int:
        """Number of executed tokens without a target token on their accepted path.

        All of a skipped or parallel decode's, else those that a prediction or a rejected draft filled.
        """
        return len(self.tokens) if self.skipped or self.mode == PARALLEL else self.compensated

    @property
    def verifications(self) -> int:
        """Number of rounds in which the target verified a tree."""
        return sum(r.is_verification for r in self.rounds)

    @property
    def first_rejected(self) -> int | None:
        """Index in the chunk of the first verification's first rejected token; N if none, None if no tree."""
        for r in self.rounds:
            if r.is_verification:
                return r.start + r.accepted if r.accepted < len(r.drafted) else self.size or len(self.tokens)
        return None


def path_length(points: np.ndarray) -> float:
    """Return the summed distances between successive points (n, 3), metres; 0 for fewer than two points."""
    return float(np.linalg.norm(np.diff(points.astype(np.float64), axis=0), axis=1).sum())


@dataclass(frozen=True)
class EpisodeRecord:
    """One episode: a task, a seed, and everything the decoder did."""

    environment: str  # name of the task's environment
    space: ActionSpace  # the environment's
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
    initial_state: np.ndarray  # (n,) float64, equal for episodes of a task that begin alike
    frames: dict[int, np.ndarray] = field(default_factory=dict)  # control step -> (h, w, 3) uint8, if recorded
    wall_seconds: float = 0.0  # whole episode with simulation and rendering; its share if several ran at once
    places: dict[str, np.ndarray] = field(default_factory=dict)  # object, goal, … -> (T + 1, 3) metres, if recorded

    @property
    def seconds(self) -> float:
        """Inference time of the episode; NaN if it was not timed."""
        return sum(d.seconds for d in self.decodes)

    @property
    def timed(self) -> bool:
        """Whether its decodes have times. Those of a batch have none."""
        return not math.isnan(self.seconds)

    @property
    def forwards(self) -> int:
        """Number of target forwards."""
        return sum(d.forwards for d in self.decodes)

    @property
    def path_length(self) -> float:
        """Length of the end effector's path, metres."""
        return path_length(self.path)

    @property
    def jerk(self) -> float:
        """Root mean square of the third difference of the end effector's positions, m/s³; NaN for under 3 steps."""
        third = np.diff(self.path.astype(np.float64), n=3, axis=0) * self.space.control_hz**3
        return float(np.sqrt((third**2).sum(axis=1).mean())) if len(third) else math.nan
