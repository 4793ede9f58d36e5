"""The scripted expert as a policy: the reference of success tables (docs/methods.md §6)."""

from __future__ import annotations

import numpy as np
import torch

from kerv_cli.base.errors import KervError
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.record import DecodeRecord
from kerv_cli.engine.stopwatch import Stopwatch
from kerv_cli.worlds import spec_of
from kerv_cli.worlds.spec import Expert

MODE = "expert"


class ExpertDecoder:
    """The environment's scripted controller of the episode's task; it decodes one control step at a time.

    It reads the privileged state, as `observation=state` does. Without a target its records have no forwards, rounds
    and tokens, and measures per verification are undefined. Its time is that of a few scalar formulas and is not
    compared with a decoding method's.
    """

    cameras: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.task: str | None = None
        self.expert: Expert | None = None
        self.dofs = 0

    def reset(self, task: str, seed: int, end_effector: np.ndarray) -> None:
        """Begins an episode. Raises UnknownName for a task that no environment has."""
        if self.expert is None or task != self.task:
            spec = spec_of(task)
            self.task, self.expert, self.dofs = task, spec.expert(task), spec.actions.dofs

    def decode(self, observation: Observation) -> DecodeRecord:
        """The state -> one control step's action (1, D) in environment units.

        Raises:
            KervError: before the first reset, or the answer is not D finite numbers.
        """
        if self.expert is None:
            raise KervError("the expert does not know its task yet: reset it before decoding")
        stopwatch = Stopwatch(torch.device("cpu"))
        action = self.expert(observation)
        seconds = stopwatch.stop()
        if action.shape != (self.dofs,) or not np.isfinite(action).all():
            raise KervError(f"the expert of {self.task} answered {action} to a state it cannot read")
        return DecodeRecord(
            tokens=(),
            actions=action[None].astype(np.float32),
            forwards=0,
            rounds=(),
            mode=MODE,
            seconds=seconds,
            phases=stopwatch.phases,
        )

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        """It needs no history."""

    def finish(self, success: bool) -> None:
        """It learns nothing."""
