"""Interfaces of the parts of a method that the decode loop calls: threshold, rectifier, boundary and skip rule.

Proposers are in `proposer.py`, acceptance rules in `acceptance.py`. This file imports neither torch nor numpy.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.decisions import Choice, Rectified, SkipDecision


class Buildable(ABC):  # noqa: B024 - its subclasses are the interfaces
    """Base of all parts of a method. kerv builds a part with `build`."""

    def __init__(self, settings: Any = None, context: Any = None) -> None:
        """Keep the settings. A subclass whose constructor takes other arguments overrides `build`.

        Args:
            settings: Settings of the part.
            context: The `Context` (`kerv_cli/methods/context.py`): target, artifacts, task, parts built so far.
        """
        self.settings = settings

    @classmethod
    def build(cls, settings: Any, context: Any) -> Any:
        """Return the part that these settings choose. None if the method works without the part."""
        return cls(settings, context)


class Threshold(Buildable):
    """Chooses the acceptance radius r of every decode (docs/methods.md §3.2).

    r is the largest accepted distance, in bins, between a draft token and the target's token.

    Attributes:
        measure: How the variability K, the argument of `update`, is computed: one of `MEASURES` (`record.py`).
    """

    measure = "mean of compared"

    def reset(self) -> None:
        """Start a new episode."""

    @abstractmethod
    def radius(self) -> int:
        """Return the radius r for the next decode, in bins."""

    def update(self, variability: float | None) -> None:
        """Learn from a decode that has ended.

        Args:
            variability: The decode's kinematic variability K: by default the mean difference between draft and target
                tokens, in normalised action units. None if no draft token was compared.
        """


class Fixed(Threshold):
    """A threshold that keeps one radius r for all decodes (Spec-VLA)."""

    def __init__(self, r: int) -> None:
        self.r = r

    @classmethod
    def build(cls, settings: Any, context: Any) -> Fixed:
        return cls(settings.r)

    def radius(self) -> int:
        return self.r


class Rectifier(Buildable):
    """Completes a chunk with a prediction after a draft token was rejected (docs/methods.md §3.1).

    Attributes:
        uses_target_token: Whether the target's own token at the rejected position is executed. If False, the rectifier
            also predicts the value at this position.
    """

    uses_target_token = True

    def reset(self) -> None:
        """Start a new episode."""

    def next_decode(self) -> None:
        """Called after every decode. A rectifier that pauses after a prediction counts the paused decodes here."""

    @abstractmethod
    def rectify(self, chunk: Chunk) -> Rectified | None:
        """Predict the missing values of the control step in which a draft token was rejected.

        Return None to predict nothing. The target then goes on decoding after its own token at the rejected position.
        """


class Boundary(Buildable):
    """Decides whether retrieval or the drafter drafts the next chunk (docs/methods.md §4.4)."""

    def reset(self, task: str, seed: int) -> None:
        """Start a new episode."""

    @abstractmethod
    def choose(self, path: np.ndarray) -> Choice:
        """Return whether retrieval or the drafter drafts the next chunk.

        Args:
            path: Positions (n, 3) of the end effector measured in this episode so far, metres, oldest first.
        """


class Skip(Buildable):
    """Decides, before the target runs, whether a chunk is executed without verification (docs/methods.md §4.3)."""

    phase = "propose"  # entry of `PHASES` that the time of `take` counts for

    def begin(self, task: str, seed: int) -> None:
        """Start a new episode."""

    def finish(self, success: bool) -> None:
        """End the episode. `success` says whether the task was solved."""

    @abstractmethod
    def take(self, chunk: Chunk) -> SkipDecision:
        """Decide whether a chunk is executed without verification. Called before the target runs."""

    def verified(self, chunk: Chunk) -> None:
        """Learn how the target judged the prefill draft. Called after each prefill, so never after a skip."""
