"""What happens after a rejection (docs/methods.md §3.1): decode on, or fill the missing DoFs with a prediction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kerv_cli.engine.chunk import Chunk
from kerv_cli.methods.kinematics import Predictor
from kerv_cli.methods.parts import CompensateSettings

DRAFT = "draft"
"""`rectifier.predictor` that fills from the rejected draft instead of from a kinematic predictor."""


class Compensation:
    """KERV: keep what was accepted, predict the rest of that control step, drop the rest of the chunk.

    With `use_target_token` (ours) the target token at the rejected position is kept too; the verification has computed
    it already. `steps` (PL) lets the prediction fill further control steps. With `predictor: draft` (ours) the rejected
    draft's remaining tokens fill first and the prediction only what they lack: unlike a filter, the draft knows the
    observation. After a compensation there is none for `rest` decodes.
    """

    def __init__(self, settings: CompensateSettings, predictor: Predictor) -> None:
        self.settings, self.predictor = settings, predictor
        self.resting = 0

    def reset(self) -> None:
        """A new episode begins."""
        self.resting = 0

    def next_decode(self) -> None:
        """A decode ended."""
        self.resting = max(0, self.resting - 1)

    def close(self, chunk: Chunk) -> bool:
        """Ends the chunk after a rejection, if a prediction can fill what is missing -> whether it did."""
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
    """Known tokens, then `drafted` ones, then the prediction -> (steps, D) normalised actions; None where the history
    is too short to predict what is still missing.

    A step of which fewer than `min_verified` DoFs are known is dropped, unless nothing would be left.
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
