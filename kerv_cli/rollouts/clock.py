"""The clock of a world that goes on while the policy decodes, and compensations of the delay (docs/methods.md §8)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from kerv_cli.decoding.record import DecodeRecord, Delay
from kerv_cli.drafting.kinematics import Noise, Predictor, build_predictor
from kerv_cli.rollouts.latency import Latency, steps_of
from kerv_cli.spaces import Observation

CHUNK = "chunk"
"""Compensation that drops the new chunk's stale actions; the others, but for `none`, predict the end effector."""

_LEAST = {"hold": 1, "linear": 2, "kalman": 2}  # displacements that a prediction needs
_NOISE = Noise.uniform(1, q=1.0)


class RealClock:
    """Tells an episode how long each decode takes the world.

    expected: control steps that the next decode is expected to take: as many as the one before, 0 at the beginning.
    """

    def __init__(self, latency: Latency, control_hz: float, compensation: str = "none", horizon: int = 500) -> None:
        """compensation: none, hold, linear, kalman or chunk. horizon: most control steps of an episode."""
        self.latency, self.control_hz, self.compensation = latency, control_hz, compensation
        self.motion: Motion | None = None
        if compensation in _LEAST:
            self.motion = Motion(compensation, horizon)
        self.expected = 0

    def reset(self) -> None:
        """A new episode begins."""
        self.expected = 0

    def observed(self, observation: Observation, path: Sequence[np.ndarray]) -> Observation:
        """What the decoder is shown: the observation, the end effector where it is expected to be when the decode ends.
        path: its measured positions (3,) in the episode, metres, oldest first."""
        if self.motion is None or not self.expected:
            return observation
        ahead = self.motion.ahead(np.asarray(path), self.expected)
        proprioception, state = observation.proprioception.copy(), observation.state.copy()
        proprioception[:3] += ahead
        state[:3] += ahead  # the privileged state begins with the proprioception
        return dataclasses.replace(observation, proprioception=proprioception, state=state)

    def delay(self, decode: DecodeRecord, observed: int) -> Delay:
        """Of a decode whose observation was taken at control step `observed`.

        Raises:
            KervError: a latency that is negative or not finite.
        """
        seconds = self.latency.seconds(decode)
        steps = self.expected = steps_of(seconds, self.control_hz)
        dropped = min(steps, len(decode.actions) - 1) if self.compensation == CHUNK else 0
        return Delay(seconds, steps, observed, dropped=dropped)


class Motion:
    """Predicts how far the end effector moves: a predictor of KERV's (§3.1) on its displacements per control step."""

    def __init__(self, kind: str, horizon: int) -> None:
        """kind: hold, linear or kalman. horizon: most control steps ahead."""
        held, least = np.array([False]), _LEAST[kind]
        self.predictor: Predictor = build_predictor(kind, held, {"kalman": _NOISE}, least, horizon=horizon)

    def ahead(self, path: np.ndarray, steps: int) -> np.ndarray:
        """path (m, 3), metres, newest last -> displacement (3,) over the next `steps` control steps, at most the
        horizon; zero where the path is too short."""
        moves = np.diff(path[-self.predictor.window - 1 :], axis=0)
        if len(moves) < self.predictor.minimum:
            return np.zeros(3)
        steps = min(steps, self.predictor.horizon)
        moved: np.ndarray = self.predictor.predict_many(moves.T[:, :, None], steps).sum(axis=(1, 2))
        return moved
