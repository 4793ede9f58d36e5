"""Predict the next actions from the last actions: as a draft, and after a rejection (docs/methods.md §3.1).

For a given noise and window length, every prediction is a weighted sum of the last actions. The weights are fixed and
computed once. Actions are normalised to [-1, 1]. The unit of time is a control step.

Shapes: D degrees of freedom of an action, m past actions, B histories of actions.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from kerv_cli.base.errors import CheckpointError
from kerv_cli.engine.chunk import WINDOW
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.methods.artifacts import AGAIN

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.methods.kerv import CompensateSettings

MINIMUM = 4  # past actions that a filter needs; longer windows were not measurably better on the demonstrations
HORIZON = 8  # number of control steps ahead for which weights are computed


@dataclass(frozen=True)
class Noise:
    """Parameters of a Kalman filter, one number per DoF.

    Only the ratio q / r matters, because the filter's initial covariance is r times the identity. The numbers of strict
    DoFs (such as the gripper) are used only if `rectifier.hold_strict` is false. If q is 0, the DoF was not fitted.

    Attributes:
        q: Process noise: variance of the random acceleration per control step.
        r: Measurement noise: variance of the observed actions.
    """

    q: tuple[float, ...]
    r: tuple[float, ...]


@functools.lru_cache(maxsize=64)
def filter_state(ratio: float, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of the last actions in the state of a Kalman filter with the noise ratio q / r.

    The state is [action, velocity]. The filter begins at the first action a₀ with the state [a₀, 0] and the covariance
    r · I. For each further action the filter predicts and updates once.

    Returns:
        Two matrices. The weights (2, window) times the actions (oldest first) give the state after the last action. The
        transition matrix (2, 2) times a state gives the state one control step later.
    """
    from filterpy.kalman import KalmanFilter

    transition = np.array([[1.0, 1.0], [0.0, 1.0]])
    model = KalmanFilter(dim_x=2, dim_z=1)
    model.F, model.H = transition, np.eye(1, 2)
    model.P, model.Q, model.R = np.eye(2), ratio * np.outer([0.5, 1.0], [0.5, 1.0]), np.eye(1)  # all divided by r
    state = np.eye(2, 1)
    for i in range(1, window):
        state = transition @ np.pad(state, ((0, 0), (0, 1)))
        model.predict()
        model.update(0.0)  # any measurement gives the same gain
        innovation = -state[0]
        innovation[i] += 1.0
        state = state + model.K @ innovation[None]
    return state, transition


def kalman_weights(q: float, r: float, window: int, horizon: int) -> np.ndarray:
    """Return the weights (horizon, window) with which past actions, oldest first, add up to the predictions."""
    state, transition = filter_state(q / r, window)
    return np.stack([(np.linalg.matrix_power(transition, h) @ state)[0] for h in range(1, horizon + 1)])


class Predictor:
    """Base class of predictors of the next actions from the last actions. Strict DoFs keep their last value.

    Attributes:
        name: Name of the predictor in settings.
        least: Minimum number of past actions for a prediction. With fewer, nothing is predicted.
    """

    name = ""
    least = 1

    def __init__(
        self,
        held: np.ndarray,
        noise: Noise | None = None,
        minimum: int | None = None,
        window: int = WINDOW,
        horizon: int = HORIZON,
    ) -> None:
        self.held, self.dofs, self.noise = np.asarray(held, dtype=bool), len(held), noise
        self.minimum, self.window, self.horizon = self.least if minimum is None else minimum, window, horizon
        self.tables = {}  # for each number of past actions the weights (D, horizon, past actions) of all DoFs
        for past in range(self.minimum, window + 1):
            table = np.tile(Predictor.weights(self, 0, past), (self.dofs, 1, 1))
            for dof in np.flatnonzero(~self.held):
                table[dof] = self.weights(int(dof), past)
            self.tables[past] = table

    def weights(self, dof: int, window: int) -> np.ndarray:
        """Return the weights (horizon, window) of the past actions, oldest first, in the predictions for one DoF.

        The prediction h control steps ahead is the dot product of row h − 1 and the past actions.
        """
        weights = np.zeros((self.horizon, window))
        weights[:, -1] = 1.0
        return weights

    def released(self) -> Self:
        """Return a copy that also predicts the strict DoFs, instead of holding them."""
        if self.noise is not None and not all(self.noise.q):
            raise CheckpointError(f"the calibration's filters were not fitted to strict DoFs: {AGAIN}")
        return type(self)(np.zeros(self.dofs, bool), self.noise, self.minimum, self.window, self.horizon)

    def predict(self, history: np.ndarray, steps: int) -> np.ndarray | None:
        """Predict the next actions (steps, D) in [-1, 1], or None if the history has fewer than `minimum` actions.

        Args:
            history: (m, D) past actions, oldest first.
        """
        if len(history) < self.minimum:
            return None
        past = np.asarray(history, dtype=np.float64)[-self.window :]
        table = self.tables[len(past)][:, :steps]
        return np.clip(np.einsum("dhm,bmd->bhd", table, past[None])[0], -1.0, 1.0)


class Hold(Predictor):
    """Repeats the last action: a baseline for all other predictions."""

    name = "hold"


class Linear(Predictor):
    """Continues the line through the last two actions."""

    name = "linear"
    least = 2

    def weights(self, dof: int, window: int) -> np.ndarray:
        ahead = np.arange(1, self.horizon + 1)
        weights = np.zeros((self.horizon, window))
        weights[:, -1], weights[:, -2] = 1 + ahead, -ahead
        return weights


class Kalman(Predictor):
    """A Kalman filter with constant velocity, per DoF (docs/methods.md §3.1)."""

    name = "kalman"
    least = MINIMUM

    def weights(self, dof: int, window: int) -> np.ndarray:
        assert self.noise is not None
        return kalman_weights(self.noise.q[dof], self.noise.r[dof], window, self.horizon)


class Walk(Predictor):
    """The filter of KERV's public code: a random walk per DoF with Q = 1 and R = 1e-3.

    Its gain is 0.999, so it nearly repeats the last action. The filter starts at the first action, with the variance R.
    The public code filters token ids, kerv normalised values. The predictions are the same, because a token id is a
    linear function of the value.
    """

    name = "walk"
    least = MINIMUM
    noise_ratio = 1.0 / 1e-3  # Q / R

    def weights(self, dof: int, window: int) -> np.ndarray:
        state, variance = np.eye(1, window)[0], 1.0  # all variances divided by R
        for newest in np.eye(window)[1:]:
            variance += self.noise_ratio
            gain = variance / (variance + 1.0)
            state, variance = state + gain * (newest - state), (1.0 - gain) * variance
        return np.tile(state, (self.horizon, 1))


PREDICTORS = {kind.name: kind for kind in (Hold, Linear, Kalman, Walk)}


class PredictionProposer(ChainProposer):
    """Drafts the chunk by predicting it from the last actions (docs/methods.md §3.1, §6).

    The chunk's committed control steps count as executed. While there are too few past actions, nothing is drafted.
    """

    def __init__(self, predictor: Predictor) -> None:
        self.name, self.predictor = predictor.name, predictor

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        whole = len(chunk.tokens) // chunk.dofs
        history = chunk.history()
        predicted = self.predictor.predict(history, chunk.steps - whole)
        if predicted is None:
            return []
        tokens: list[int] = chunk.space.bins_of(predicted).flatten().tolist()
        return [tokens[len(chunk.tokens) - whole * chunk.dofs :][:depth]]


def assemble(
    tokens: list[int], chunk: Chunk, predictor: Predictor, settings: CompensateSettings, drafted: Sequence[int] = ()
) -> np.ndarray | None:
    """Assemble the actions of a compensated chunk: known tokens, then drafted tokens, then predictions.

    `settings.steps` control steps are filled, beginning with the first step that is not completely known. One step
    fewer is filled if fewer than `min_verified` DoFs of that first step are known, or if none of its DoFs is known and
    the setting `drop` is true. Neither rule applies to the first control step of the chunk.

    Returns:
        (S, D) normalised actions of the chunk's first S control steps, known and filled ones. None if there are too few
        past actions for a prediction.
    """
    dofs, horizon = chunk.dofs, chunk.steps
    whole, part = divmod(len(tokens), dofs)
    fills_this = whole == 0 or part >= max(settings.min_verified, settings.drop)
    steps = min(horizon, whole + settings.steps - 1 + fills_this)
    values = chunk.space.values_of(np.array([*tokens, *drafted][: steps * dofs], dtype=np.int64))
    flat = np.full(steps * dofs, np.nan)
    flat[: len(values)] = values
    actions: np.ndarray = flat.reshape(steps, dofs)
    history = chunk.episode.history(actions[:whole])
    # Held DoFs keep their last value. In an episode's first step there is none, and they take the draft's tokens.
    if len(history) and settings.hold_strict:
        flat[len(tokens) :][chunk.space.strict_tokens(flat.size)[len(tokens) :]] = np.nan
    if np.isnan(actions).any():
        predicted = predictor.predict(history, steps - whole)
        if predicted is None:
            return None
        gap = np.isnan(actions[whole:])
        actions[whole:][gap] = predicted[gap]
    return actions
