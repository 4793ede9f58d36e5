"""Kinematic prediction of the next actions: as a draft, and after a rejection (docs/methods.md §3.1).

Every predictor is a fixed linear function of its window, for a given noise and window length. The weights are computed
once; a prediction is one small matrix product. Actions are normalised to [-1, 1]. The unit of time is a control step.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kerv_cli.base.registry import NoSettings, load
from kerv_cli.engine.chunk import WINDOW, Chunk
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.methods.context import Context
from kerv_cli.methods.kerv import DRAFT, CompensateSettings, find_predictor

MINIMUM = 4  # actions that a prediction needs; longer windows were not measurably better on the demonstrations
HORIZON = 8  # steps ahead that weights are computed for


@dataclass(frozen=True)
class Noise:
    """Noise of a Kalman filter per DoF. Strict DoFs are held, so their entries are not used.

    Only the ratio of q and r matters, because the prior is scaled by r.

    Attributes:
        q: Variance of the random acceleration in one step.
        r: Variance of the observation.
        damping: Share of the velocity that is left after one step; 1 is the paper's constant velocity, less is *ours*.
    """

    q: tuple[float, ...]
    r: tuple[float, ...]
    damping: tuple[float, ...]


@functools.lru_cache(maxsize=64)
def filter_state(ratio: float, window: int, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the filter's state after `window` actions, and the transition F of the state [a, ȧ] in one step.

    Column i of the state (2, window) is what action i contributes. The filter begins on the first action with state
    [a₀, 0] and covariance r · I. It predicts and updates once per further action. `ratio` is q / r.
    """
    from filterpy.kalman import KalmanFilter

    transition = np.array([[1.0, damping], [0.0, damping]])
    model = KalmanFilter(dim_x=2, dim_z=1)
    model.F, model.H = transition, np.eye(1, 2)
    model.P, model.Q, model.R = np.eye(2), ratio * np.outer([0.5, 1.0], [0.5, 1.0]), np.eye(1)  # in units of r
    state = np.eye(2, 1)
    for i in range(1, window):
        state = transition @ np.pad(state, ((0, 0), (0, 1)))
        model.predict()
        model.update(0.0)  # the gain does not depend on what is measured
        innovation = -state[0]
        innovation[i] += 1.0
        state = state + model.K @ innovation[None]
    return state, transition


def kalman_weights(q: float, r: float, window: int, horizon: int, damping: float = 1.0) -> np.ndarray:
    """Return (horizon, window): row h − 1 times the window, oldest first, is the prediction h steps ahead."""
    state, transition = filter_state(q / r, window, damping)
    return np.stack([(np.linalg.matrix_power(transition, h) @ state)[0] for h in range(1, horizon + 1)])


class Predictor:
    """Predicts the next actions from the last ones. Strict DoFs are held at their last value.

    Attributes:
        least: Actions without which the weights are not defined.
    """

    name = ""
    least = 1  # actions without which the weights are not defined

    def __init__(
        self,
        held: np.ndarray,
        noise: Noise | None = None,
        minimum: int = MINIMUM,
        window: int = WINDOW,
        horizon: int = HORIZON,
    ) -> None:
        """Compute the weights.

        Args:
            held: (D,) bool, DoFs that are never extrapolated.
            noise: Fitted noise, for a filter.
            minimum: Fewer actions give no prediction.
            window: Most actions that count.
            horizon: Most steps ahead.
        """
        self.held, self.dofs, self.noise = np.asarray(held, dtype=bool), len(held), noise
        self.minimum, self.window, self.horizon = minimum, window, horizon
        self.tables = {m: self._table(m) for m in range(minimum, window + 1)}

    def weights(self, dof: int, window: int) -> np.ndarray:
        """Return (horizon, window) of one DoF; here all weight is on the newest action."""
        weights = np.zeros((self.horizon, window))
        weights[:, -1] = 1.0
        return weights

    def _table(self, window: int) -> np.ndarray:
        """Return the weights (D, horizon, window)."""
        last = Predictor.weights(self, 0, window)
        return np.stack([last if self.held[dof] else self.weights(dof, window) for dof in range(self.dofs)])

    def predict(self, history: np.ndarray, steps: int) -> np.ndarray | None:
        """Return the next `steps` actions (steps, D) in [-1, 1]; None for a history shorter than `minimum`.

        history (m, D) is oldest first.
        """
        if len(history) < self.minimum:
            return None
        return self.predict_many(np.asarray(history, dtype=np.float64)[None], steps)[0]

    def predict_many(self, histories: np.ndarray, steps: int) -> np.ndarray:
        """Return (B, steps, D) of histories (B, m, D) with m ≥ `minimum`."""
        past = histories[:, -self.window :]
        table = self.tables[past.shape[1]][:, :steps]
        predicted: np.ndarray = np.einsum("dhm,bmd->bhd", table, past)
        return np.clip(predicted, -1.0, 1.0)


class Hold(Predictor):
    """The last action again: the baseline of every prediction."""

    name = "hold"


class Linear(Predictor):
    """The line through the last two actions."""

    name = "linear"
    least = 2

    def weights(self, dof: int, window: int) -> np.ndarray:
        """Return (horizon, window): 1 + h on the newest action, −h on the one before, for h steps ahead."""
        ahead = np.arange(1, self.horizon + 1)
        weights = np.zeros((self.horizon, window))
        weights[:, -1], weights[:, -2] = 1 + ahead, -ahead
        return weights


class Kalman(Predictor):
    """A Kalman filter per DoF (docs/methods.md §3.1), run from the window's first action."""

    name = "kalman"
    least = 2

    def weights(self, dof: int, window: int) -> np.ndarray:
        """Return (horizon, window) of the filter with this DoF's noise."""
        assert self.noise is not None
        q, r, damping = self.noise.q[dof], self.noise.r[dof], self.noise.damping[dof]
        return kalman_weights(q, r, window, self.horizon, damping)


class Damped(Kalman):
    """A Kalman filter whose velocity is damped in every step (*ours*): actions are bounded, so no slope lasts."""

    name = "damped"


class Ridge(Predictor):
    """SP-VLA: the line through the last `window` actions, by ridge regression on time.

    Attributes:
        penalty: λ, on both coefficients.
    """

    name = "ridge"

    def __init__(self, held: np.ndarray, penalty: float, window: int, horizon: int) -> None:
        self.penalty = penalty
        super().__init__(held, None, window, window, horizon)

    def weights(self, dof: int, window: int) -> np.ndarray:
        """Return (horizon, window): X' (XᵀX + λI)⁻¹ Xᵀ.

        The rows of X are (t, 1) for t = 0, 1, …; X' has later steps.
        """
        times = np.arange(window + self.horizon)
        rows = np.stack([times, np.ones(len(times))], 1)
        past, ahead = rows[:window], rows[window:]
        fitted: np.ndarray = np.linalg.solve(past.T @ past + self.penalty * np.eye(2), past.T)
        return ahead @ fitted


FILTERS = ("kalman", "damped")
PREDICTORS = {kind.name: kind for kind in (Hold, Linear, Kalman, Damped)}


def predictor_of(settings: NoSettings, context: Context) -> Predictor:
    """Return a predictor over the target's chunk. A filter's noise comes from the calibration."""
    kind, held, horizon = PREDICTORS[settings.kind], context.target.actions.is_strict, context.target.chunk
    if kind.name not in FILTERS:
        return kind(held, minimum=kind.least, horizon=horizon)
    fitted = context.calibration
    return kind(held, fitted.noise[kind.name], window=fitted.window, horizon=horizon)


class PredictionProposer(ChainProposer):
    """Drafts a kinematic prediction of the chunk (docs/methods.md §3.1, §6: `hold`, `kalman`).

    Committed steps of the chunk count as executed. It drafts nothing while the history is too short.
    """

    def __init__(self, predictor: Predictor) -> None:
        self.name, self.predictor = predictor.name, predictor

    @classmethod
    def build(cls, settings: NoSettings, context: Context) -> PredictionProposer:
        """Build proposer=hold, linear, kalman or damped."""
        return cls(predictor_of(settings, context))

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """Return the predicted tokens of the chunk's remaining places."""
        whole = len(chunk.tokens) // chunk.dofs
        pending = np.array(chunk.tokens[: whole * chunk.dofs], dtype=np.int64).reshape(whole, chunk.dofs)
        history = chunk.situation.history.values(chunk.space.values_of(pending))
        predicted = self.predictor.predict(history, chunk.steps - whole)
        if predicted is None:
            return []
        tokens: list[int] = chunk.space.bins_of(predicted).flatten().tolist()
        return [tokens[len(chunk.tokens) - whole * chunk.dofs :][:depth]]


class Compensation:
    """KERV: keeps what was accepted, predicts the rest of that control step, drops the rest of the chunk.

    With `use_target_token` (ours) the target token at the rejected position is kept too: it is already computed.
    `steps` (PL) lets the prediction fill further control steps. With `predictor: draft` (ours) the rejected draft's
    remaining tokens fill first, because the draft knows the observation and a filter does not. After a compensation
    there is none for `rest` decodes.
    """

    def __init__(self, settings: CompensateSettings, predictor: Predictor) -> None:
        self.settings, self.predictor = settings, predictor
        self.resting = 0

    @classmethod
    def build(cls, settings: CompensateSettings, context: Context) -> Compensation:
        """Build rectifier=compensate."""
        name = Hold.name if settings.predictor == DRAFT else settings.predictor
        return cls(settings, load(find_predictor(name).traits["predictor"])(NoSettings(name), context))

    @property
    def uses_target_token(self) -> bool:
        """Whether the target's token at the rejected position stays committed."""
        return self.settings.use_target_token

    def reset(self) -> None:
        """Begin an episode."""
        self.resting = 0

    def next_decode(self) -> None:
        """End a decode."""
        self.resting = max(0, self.resting - 1)

    def close(self, chunk: Chunk) -> bool:
        """End the chunk after a rejection, if a prediction can fill what is missing -> whether it did."""
        if self.resting:
            return False
        tokens = chunk.tokens if self.settings.use_target_token else chunk.tokens[:-1]
        drafted = chunk.rejection.draft if self.settings.predictor == DRAFT else ()
        values = assemble(tokens, chunk, self.predictor, self.settings, drafted)
        if values is None or 0 <= self.settings.max_dropped < chunk.steps - len(values):
            return False
        chunk.close(values, self.settings.use_target_token)
        # + 1, because `next_decode` also counts the decode that compensated
        self.resting = self.settings.rest + 1
        return True


def assemble(
    tokens: list[int],
    chunk: Chunk,
    predictor: Predictor,
    settings: CompensateSettings,
    drafted: Sequence[int] = (),
) -> np.ndarray | None:
    """Return known tokens, then drafted ones, then the prediction as normalised actions (steps, D).

    None if the history is too short to predict what is still missing. A step with fewer than `min_verified` known DoFs
    is dropped, unless nothing would be left.
    """
    dofs, horizon = chunk.dofs, chunk.steps
    whole, part = divmod(len(tokens), dofs)
    filled = 1 if whole == 0 or (part and part >= settings.min_verified) else 0
    steps = min(horizon, whole + max(filled, settings.steps - 1 + filled))
    values = chunk.space.values_of(np.array([*tokens, *drafted][: steps * dofs], dtype=np.int64))
    flat = np.full(steps * dofs, np.nan)
    flat[: len(values)] = values
    actions: np.ndarray = flat.reshape(steps, dofs)
    history = chunk.situation.history.values(actions[:whole])
    if len(history):  # strict DoFs are held, whoever drafted; without a last value the draft's is the best there is
        flat[len(tokens) :][chunk.space.strict_tokens(flat.size)[len(tokens) :]] = np.nan
    if np.isnan(actions).any():
        predicted = predictor.predict(history, steps - whole)
        if predicted is None:
            return None
        gap = np.isnan(actions[whole:])
        actions[whole:][gap] = predicted[gap]
    return actions
