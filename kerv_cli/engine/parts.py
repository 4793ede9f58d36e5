"""What the decode loop asks of a threshold, a rectifier, a boundary and a skip rule. This file imports nothing heavy.

Proposers are in `proposer.py`, acceptance rules in `acceptance.py`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    import numpy as np

    from kerv_cli.engine.chunk import Choice, Chunk
    from kerv_cli.engine.protocol import Cache


class Threshold(Protocol):
    """Chooses the acceptance radius r of every decode, from the variability K of the decodes before it."""

    def reset(self) -> None:
        """Begin an episode."""

    def radius(self) -> int:
        """Return r of the next decode, in bins."""

    def update(self, variability: float | None) -> None:
        """End a decode, whose kinematic variability K is in normalised action units; None if nothing was compared."""


class Fixed:
    """One radius r for all decodes (Spec-VLA)."""

    def __init__(self, r: int) -> None:
        self.r = r

    def reset(self) -> None:
        """Do nothing."""

    def radius(self) -> int:
        """Return r, in bins."""
        return self.r

    def update(self, variability: float | None) -> None:
        """Do nothing."""


class Rectifier(Protocol):
    """Ends a chunk after a rejection, with what it predicts."""

    @property
    def uses_target_token(self) -> bool:
        """Whether the target's token at the rejected position stays committed."""

    def reset(self) -> None:
        """Begin an episode."""

    def next_decode(self) -> None:
        """End a decode."""

    def close(self, chunk: Chunk) -> bool:
        """End the chunk after a rejection if what is missing can be predicted, and return whether it did."""


class Boundary(Protocol):
    """Chooses the side of a hybrid proposer that drafts the next chunk."""

    def choose(self, path: np.ndarray, rng: np.random.Generator) -> Choice:
        """Choose by the measured positions (n, 3) of the episode up to now, metres, oldest first."""

    def numbers(self, task: str, seed: int) -> np.random.Generator:
        """Return the generator of an episode. It depends on the boundary's seed, the task and the seed alone."""


class Skip(ABC):
    """Decides before the prefill whether a chunk is executed without a verification."""

    phase = "propose"  # of `PHASES`, for the time of `take`

    def begin(self, task: str, seed: int) -> None:  # noqa: B027 - most rules keep nothing between decodes
        """Begin an episode."""

    def finish(self, success: bool) -> None:  # noqa: B027
        """End the episode."""

    @abstractmethod
    def take(self, chunk: Chunk) -> bool:
        """Complete the chunk if it may be executed unverified, and return whether it did."""

    def verified(self, chunk: Chunk) -> None:  # noqa: B027
        """Learn from the verdict, after the prefill has verified a draft that was not skipped."""


@runtime_checkable
class TakesMany(Protocol):
    """A skip rule that can complete the chunks of several episodes together."""

    def take_many(self, chunks: Sequence[Chunk], cache: Callable[[int], Cache]) -> None:
        """Complete B chunks. `cache` returns an empty cache of so many rows."""
