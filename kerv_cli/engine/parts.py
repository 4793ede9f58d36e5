"""Interfaces of the parts of a method that the decode loop calls: threshold, rectifier, boundary and skip rule.

Proposers are in `proposer.py`, acceptance rules in `acceptance.py`. This file imports nothing heavy.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np

    from kerv_cli.engine.chunk import Choice, Chunk


class Threshold(Protocol):
    """Chooses the acceptance radius r of every decode (docs/methods.md §3.2).

    r is the largest accepted distance, in bins, between a draft token and the target's token.
    """

    def reset(self) -> None:
        """Start a new episode."""

    def radius(self) -> int:
        """Return the radius r for the next decode, in bins."""

    def update(self, variability: float | None) -> None:
        """Learn from a decode that has ended.

        Args:
            variability: The decode's kinematic variability K: the mean difference between draft and target tokens, in
                normalised action units. None if no draft token was compared.
        """


class Fixed:
    """A threshold that keeps one radius r for all decodes (Spec-VLA)."""

    def __init__(self, r: int) -> None:
        self.r = r

    def reset(self) -> None:
        """Do nothing: the acceptance radius r is constant."""

    def radius(self) -> int:
        """Return the constant radius r, in bins."""
        return self.r

    def update(self, variability: float | None) -> None:
        """Do nothing: r is constant."""


class Rectifier(Protocol):
    """Completes a chunk with a prediction after a draft token was rejected (docs/methods.md §3.1)."""

    @property
    def uses_target_token(self) -> bool:
        """Whether the target's own token at the rejected position is executed. Else the rectifier predicts it, too."""

    def reset(self) -> None:
        """Start a new episode."""

    def next_decode(self) -> None:
        """Count a decode that has ended. A rectifier may pause for some decodes after it has predicted values."""

    def close(self, chunk: Chunk) -> bool:
        """Fill the rejected control step with predicted values, if they can be predicted.

        The rectifier calls either `Chunk.close`, which drops the later control steps, or `Chunk.fill`, after which the
        target decodes the later steps.

        Returns:
            Whether the step was filled. If not, the target decodes on after its own token at the rejected position.
        """


class Boundary(ABC):
    """Decides whether retrieval or the drafter drafts the next chunk (docs/methods.md §4.4)."""

    def reset(self, task: str, seed: int) -> None:  # noqa: B027 - most boundaries draw no random numbers
        """Start a new episode of `task` with this seed."""

    @abstractmethod
    def choose(self, path: np.ndarray) -> Choice:
        """Return whether retrieval or the drafter drafts the next chunk.

        Args:
            path: Positions (n, 3) of the end effector measured in this episode so far, metres, oldest first.
        """


class Skip(ABC):
    """Decides before the target runs whether a draft is executed without verification (docs/methods.md §4.3)."""

    phase = "propose"  # entry of `PHASES` that the time of `take` counts for

    def begin(self, task: str, seed: int) -> None:  # noqa: B027 - most rules keep nothing between decodes
        """Start a new episode of `task` with this seed."""

    def finish(self, success: bool) -> None:  # noqa: B027
        """End the episode. `success` says whether the task was solved."""

    @abstractmethod
    def take(self, chunk: Chunk) -> bool:
        """Complete the chunk with an unverified draft, if the rule allows that. Return whether it did."""

    def verified(self, chunk: Chunk) -> None:  # noqa: B027
        """Learn how the target judged the prefill draft.

        Called after the prefill of each chunk that `take` did not complete.
        """
