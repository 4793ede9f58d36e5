"""The clock of a world that goes on while the policy decodes, and compensations of the delay (docs/methods.md §8)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from kerv_cli.base.spaces import ActionSpace, Observation
from kerv_cli.engine.record import DecodeRecord, Delay
from kerv_cli.lab.latency import Latency, steps_of
from kerv_cli.methods.kinematics.prediction import Noise, Predictor, build_predictor

CHUNK, POSITION = "chunk", "position"
"""Compensations: drop the new chunk's stale actions; show the decoder the end effector where it will be."""

AHEAD = 64
"""Control steps that are predicted at most; later ones repeat the last of them."""

_LEAST = {"hold": 1, "linear": 2, "kalman": 2}  # actions that a prediction needs
_RATIO = 10.0  # q / r of the filter; experts' actions are predicted best with it, up to five steps ahead


class RealClock:
    """Tells an episode how long each decode takes the world, and which actions are executed then.

    expected: control steps that the next decode is expected to take: as many as the one before, 0 at the beginning.
    """

    def __init__(self, latency: Latency, space: ActionSpace, compensation: str = "none") -> None:
        """space: the environment's. compensation: none, chunk, hold, linear, kalman or position."""
        self.latency, self.space, self.compensation = latency, space, compensation
        self.stream = predictor(compensation, space.is_strict) if compensation in _LEAST else None
        self.motion = predictor("kalman", np.zeros(3, dtype=bool)) if compensation == POSITION else None
        self.expected = 0

    def reset(self) -> None:
        """A new episode begins."""
        self.expected = 0

    def observed(self, observation: Observation, path: Sequence[np.ndarray]) -> Observation:
        """The observation to decode: with `position`, its end effector is moved to where it is predicted to be when the
        decode ends. path: the measured positions (3,) in the episode, metres, oldest first."""
        if self.motion is None or not self.expected:
            return observation
        ahead = displacement(self.motion, np.asarray(path), self.expected)
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
        steps = self.expected = steps_of(seconds, self.space.control_hz)
        stale = min(steps, len(decode.actions))
        if self.compensation == CHUNK:
            return Delay(seconds, steps, observed, dropped=min(stale, len(decode.actions) - 1))
        if self.stream is not None:
            return Delay(seconds, steps, observed, dropped=stale, predicted=stale)
        return Delay(seconds, steps, observed)

    def chunk(self, decode: DecodeRecord, history: Sequence[np.ndarray]) -> np.ndarray:
        """The actions (n, D) to execute from now on, environment units: those of the decode, whose `delay` is known,
        without the dropped ones, and predicted ones behind them. history: actions that were executed up to its
        observation, oldest first."""
        actions, delay = decode.actions, decode.delay
        if delay is None or not delay.predicted or self.stream is None:
            return actions[delay.dropped :] if delay is not None else actions
        recent = self.space.normalise(np.array([*history[-self.stream.window :], *actions]))
        first = delay.steps + 1 - delay.predicted  # steps ahead of the chunk's end of the first predicted action
        ahead = np.minimum(np.arange(first, delay.steps + 1), AHEAD) - 1
        predicted = self.stream.predict(recent, AHEAD)
        if predicted is None:
            predicted = np.repeat(recent[-1:], AHEAD, axis=0)
        behind = self.space.unnormalise(predicted[ahead]).astype(actions.dtype)
        return np.concatenate([actions[delay.dropped :], behind])


def predictor(kind: str, held: np.ndarray) -> Predictor:
    """KERV's predictor of that kind (§3.1), up to `AHEAD` steps ahead: hold, linear, or kalman with q = 10 r."""
    noise = Noise.uniform(len(held), q=_RATIO)
    return build_predictor(kind, held, {"kalman": noise}, _LEAST[kind], horizon=AHEAD)


def displacement(motion: Predictor, path: np.ndarray, steps: int) -> np.ndarray:
    """path (m, 3), metres, newest last -> predicted displacement (3,) over the next `steps` control steps, at most
    `AHEAD`; zero where the path is too short."""
    moves = np.diff(path[-motion.window - 1 :], axis=0)
    predicted = motion.predict(moves, min(steps, AHEAD))
    return np.zeros(3) if predicted is None else predicted.sum(axis=0)
