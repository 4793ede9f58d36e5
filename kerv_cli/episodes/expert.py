"""The scripted expert as a policy, the reference of success tables (docs/methods.md §6)."""

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
    """Decodes one control step at a time with the environment's scripted controller of the task.

    It reads the privileged state, as `observation=state` does. It has no target: its records have no forwards, rounds
    and tokens. Its time is not compared with a decoding method's.
    """

    cameras: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.task: str | None = None
        self.expert: Expert | None = None
        self.dofs = 0

    def reset(self, task: str, seed: int, end_effector: np.ndarray) -> None:
        """Begin an episode."""
        if self.expert is None or task != self.task:
            spec = spec_of(task)
            self.task, self.expert, self.dofs = task, spec.expert(task), spec.actions.dofs

    def decode(self, observation: Observation) -> DecodeRecord:
        """Return one control step's action (1, D), environment units.

        Raises:
            KervError: There was no reset, or the expert's answer is not D finite numbers.
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
        """Do nothing: it needs no history."""

    def finish(self, success: bool) -> None:
        """Do nothing: it does not learn."""
