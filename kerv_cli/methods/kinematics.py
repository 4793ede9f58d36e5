"""Kinematic prediction of the next actions from the last ones (docs/methods.md §3.1, KERV §3).

Every predictor here is a fixed linear function of its window for given noise and window length. The weights are
computed once; predicting is one small matrix product.
Actions are normalised to [-1, 1], one control step is the unit of time.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kerv_cli.base.errors import UnknownName, UsageError

WINDOW = 10  # KERV's action context AC, control steps
MINIMUM = 4  # actions that a prediction needs; longer windows were not measurably better on the demonstrations
HORIZON = 8  # steps ahead that weights are computed for


class ActionHistory:
    """The last `window` executed actions, normalised and continuous."""

    def __init__(self, dofs: int, window: int = WINDOW) -> None:
        self.dofs = dofs
        self._actions: deque[np.ndarray] = deque(maxlen=window)
        self._stacked = np.zeros((0, dofs))  # the same, for the readers of one decode; never written to
        self._stacked.flags.writeable = False

    def append(self, action: np.ndarray) -> None:
        """An action (D,) in [-1, 1] was executed.

        Raises:
            ValueError: another shape, or a number that is not finite.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (self.dofs,) or not np.isfinite(action).all():
            raise ValueError(f"an executed action must be {self.dofs} finite numbers, not {action}")
        self._actions.append(action)
        self._stacked = np.array(self._actions)
        self._stacked.flags.writeable = False

    def values(self, pending: np.ndarray | None = None) -> np.ndarray:
        """(m, D), oldest first, m ≤ window.

        pending: (k, D) steps of the present chunk that are known but not yet executed. They are appended as if
        executed, so that the next step is one step ahead instead of k + 1.
        """
        if pending is None or not len(pending):
            return self._stacked
        known = np.concatenate([self._stacked, np.asarray(pending, dtype=np.float64)])
        return known[-(self._actions.maxlen or 0) :]


@dataclass(frozen=True)
class Noise:
    """Noise of a Kalman filter per DoF; entries of strict DoFs are not used, because those are held.

    q: variance of the random acceleration (order 2) or change of acceleration (order 3) in one step. r: variance of
    the observation. Only their ratio matters, because the prior is scaled by r. damping: share of the velocity that is
    left after one step; 1 is the paper's constant velocity, less is *ours*.

    Raises:
        UsageError: a number out of range, or another count of numbers.
    """

    q: tuple[float, ...]
    r: tuple[float, ...]
    damping: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.q) == len(self.r) == len(self.damping):
            raise UsageError("kinematics: q, r and damping need one number per DoF")
        if any(not (np.isfinite(x) and x >= 0) for x in self.q) or any(not (np.isfinite(x) and x > 0) for x in self.r):
            raise UsageError("kinematics: q must be 0 or more and r above 0")
        if any(not 0 <= x <= 1 for x in self.damping):
            raise UsageError("kinematics: damping must lie between 0 and 1")

    @classmethod
    def uniform(cls, dofs: int, q: float, r: float = 1.0, damping: float = 1.0) -> Noise:
        """The same q, r and damping for all DoFs."""
        return cls((q,) * dofs, (r,) * dofs, (damping,) * dofs)


def motion_model(order: int, damping: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """(F, Q / q) of the state [a, ȧ] (order 2) or [a, ȧ, ä] (order 3), discrete white noise, dt = 1.

    Raises:
        ValueError: another order, or damping with order 3.
    """
    if order == 2:
        return np.array([[1.0, damping], [0.0, damping]]), np.outer([0.5, 1.0], [0.5, 1.0])
    if order == 3 and damping == 1.0:
        return np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]), np.outer([0.5, 1, 1], [0.5, 1, 1])
    raise ValueError(f"no motion model of order {order} with damping {damping}")


@functools.lru_cache(maxsize=64)
def filter_states(ratio: float, window: int, order: int, damping: float) -> tuple[np.ndarray, ...]:
    """The filter's state after 1, 2, … `window` actions, each (order, m): column i is what action i contributes.

    ratio: q / r. The filter begins on the first action with state [a₀, 0(, 0)] and covariance r · I; it then predicts
    and updates once per further action.
    """
    from filterpy.kalman import KalmanFilter

    transition, noise = motion_model(order, damping)
    model = KalmanFilter(dim_x=order, dim_z=1)
    model.F, model.H = transition, np.eye(1, order)
    model.P, model.Q, model.R = np.eye(order), ratio * noise, np.eye(1)  # in units of r
    state = np.eye(order, 1)
    states = [state]
    for i in range(1, window):
        state = transition @ np.pad(state, ((0, 0), (0, 1)))
        model.predict()
        model.update(0.0)  # the gain does not depend on what is measured
        innovation = -state[0]
        innovation[i] += 1.0
        state = state + model.K @ innovation[None]
        states.append(state)
    return tuple(states)


def kalman_weights(q: float, r: float, window: int, horizon: int, order: int = 2, damping: float = 1.0) -> np.ndarray:
    """(horizon, window): row h − 1 times the window, oldest first, is the filter's prediction h steps ahead."""
    transition, _ = motion_model(order, damping)
    state = filter_states(q / r, window, order, damping)[-1]
    return np.stack([(np.linalg.matrix_power(transition, h) @ state)[0] for h in range(1, horizon + 1)])


class Predictor:
    """Predicts the next actions from the last ones; strict DoFs are held at their last value."""

    name = ""
    least = 1  # actions without which the weights are not defined

    def __init__(self, held: np.ndarray, minimum: int = MINIMUM, window: int = WINDOW, horizon: int = HORIZON) -> None:
        """held: (D,) bool, DoFs that are never extrapolated. minimum: actions without which predict() gives None.

        Raises:
            UsageError: minimum or window out of range.
        """
        if not self.least <= minimum <= window:
            raise UsageError(f"{self.name}: a minimum history of {minimum} does not lie in {self.least}…{window}")
        self.held, self.dofs = np.asarray(held, dtype=bool), len(held)
        self.minimum, self.window, self.horizon = minimum, window, horizon
        self.tables = {m: self._table(m) for m in range(minimum, window + 1)}

    def weights(self, dof: int, window: int) -> np.ndarray:
        """(horizon, window) of one DoF."""
        raise NotImplementedError

    def _table(self, window: int) -> np.ndarray:
        """(D, horizon, window)."""
        rows = [
            hold_weights(window, self.horizon) if self.held[dof] else self.weights(dof, window)
            for dof in range(self.dofs)
        ]
        return np.stack(rows)

    def predict(self, history: np.ndarray, steps: int) -> np.ndarray | None:
        """history (m, D) in [-1, 1], oldest first, its last `window` count -> (steps, D) in [-1, 1].

        None when the history is shorter than `minimum`.

        Raises:
            ValueError: more steps than `horizon`, or another number of DoFs.
        """
        if len(history) < self.minimum:
            return None
        return self.predict_many(np.asarray(history, dtype=np.float64)[None], steps)[0]

    def predict_many(self, histories: np.ndarray, steps: int) -> np.ndarray:
        """(B, m, D) with m ≥ `minimum` -> (B, steps, D)."""
        if not 0 <= steps <= self.horizon or histories.shape[-1] != self.dofs:
            asked = f"{steps} steps of {histories.shape[-1]} DoFs"
            raise ValueError(f"{self.name}: {asked}; weights are for {self.horizon} of {self.dofs}")
        past = histories[:, -self.window :]
        table = self.tables[past.shape[1]][:, :steps]
        predicted: np.ndarray = np.einsum("dhm,bmd->bhd", table, past)
        return np.clip(predicted, -1.0, 1.0)


def hold_weights(window: int, horizon: int) -> np.ndarray:
    """(horizon, window): all weight on the newest action."""
    weights = np.zeros((horizon, window))
    weights[:, -1] = 1.0
    return weights


class Hold(Predictor):
    """The last action again: the baseline of every prediction."""

    name = "hold"

    def weights(self, dof: int, window: int) -> np.ndarray:
        """(horizon, window), all weight on the newest action."""
        return hold_weights(window, self.horizon)


class Linear(Predictor):
    """The line through the last two actions."""

    name = "linear"
    least = 2

    def weights(self, dof: int, window: int) -> np.ndarray:
        """(horizon, window): 1 + h on the newest action, −h on the one before, for h steps ahead."""
        ahead = np.arange(1, self.horizon + 1)
        weights = np.zeros((self.horizon, window))
        weights[:, -1], weights[:, -2] = 1 + ahead, -ahead
        return weights


class Kalman(Predictor):
    """A Kalman filter per DoF (docs/methods.md §3.1), run from the window's first action; see `kalman_weights`."""

    name = "kalman"
    least = 2
    order = 2

    def __init__(
        self,
        held: np.ndarray,
        noise: Noise,
        minimum: int = MINIMUM,
        window: int = WINDOW,
        horizon: int = HORIZON,
    ) -> None:
        self.noise = noise
        super().__init__(held, minimum, window, horizon)

    def weights(self, dof: int, window: int) -> np.ndarray:
        """(horizon, window) of the filter with this DoF's noise, see `kalman_weights`."""
        q, r, damping = self.noise.q[dof], self.noise.r[dof], self.noise.damping[dof]
        return kalman_weights(q, r, window, self.horizon, self.order, damping)


class Damped(Kalman):
    """Kalman filter whose velocity is damped in every step (*ours*): actions are bounded, so no slope lasts."""

    name = "damped"


class Acceleration(Kalman):
    """Kalman filter with a constant-acceleration state (ablation)."""

    name = "acceleration"
    least = 3
    order = 3


FILTERS: dict[str, type[Kalman]] = {kind.name: kind for kind in (Kalman, Damped, Acceleration)}
PREDICTORS = (Hold.name, Linear.name, *FILTERS)


def build_predictor(
    kind: str,
    held: np.ndarray,
    noise: Mapping[str, Noise],
    minimum: int = MINIMUM,
    window: int = WINDOW,
    horizon: int = HORIZON,
) -> Predictor:
    """The predictor `kind`; held: (D,) bool, DoFs that keep their last value; `noise` holds the fitted noise of each
    kind of filter.

    Raises:
        UnknownName: no such predictor.
        UsageError: a filter without its noise, or a number out of range.
    """
    if kind == Hold.name:
        return Hold(held, minimum, window, horizon)
    if kind == Linear.name:
        return Linear(held, minimum, window, horizon)
    if kind not in FILTERS:
        raise UnknownName("predictor", kind, PREDICTORS)
    if kind not in noise:
        raise UsageError(f"predictor '{kind}' has no fitted noise: run 'kerv calibrate'")
    return FILTERS[kind](held, noise[kind], minimum, window, horizon)
