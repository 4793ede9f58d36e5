"""What the decode loop asks of a method's parts besides its proposers (`proposer.py`) and acceptance rule
(`acceptance.py`). Nothing heavy is imported here."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    import numpy as np

    from kerv_cli.engine.chunk import Choice, Chunk
    from kerv_cli.engine.protocol import Cache


class Threshold(Protocol):
    """Gives the acceptance radius r of every decode, from the variability K of the decodes before it."""

    def reset(self) -> None:
        """A new episode begins."""

    def radius(self) -> int:
        """r of the next decode, in bins."""

    def update(self, variability: float | None) -> None:
        """A decode ended; its kinematic variability K in normalised action units, None where nothing was compared."""


class Fixed:
    """One radius r for all decodes (Spec-VLA)."""

    def __init__(self, r: int) -> None:
        self.r = r

    def reset(self) -> None:
        """Nothing to reset."""

    def radius(self) -> int:
        """r."""
        return self.r

    def update(self, variability: float | None) -> None:
        """K is not used."""


class Rectifier(Protocol):
    """Ends a chunk after a rejection, by what it predicts."""

    @property
    def uses_target_token(self) -> bool:
        """Whether the target's token at the rejected position stays committed."""

    def reset(self) -> None:
        """A new episode begins."""

    def next_decode(self) -> None:
        """A decode ended."""

    def close(self, chunk: Chunk) -> bool:
        """Ends the chunk after a rejection, if what is missing can be predicted -> whether it did."""


class Boundary(Protocol):
    """Chooses the side of a hybrid proposer that drafts the next chunk."""

    def choose(self, path: np.ndarray, rng: np.random.Generator) -> Choice:
        """path (n, 3): the episode's measured positions up to now, metres, oldest first; the newest `window` count."""

    def numbers(self, task: str, seed: int) -> np.random.Generator:
        """Generator for one episode; depends on the boundary's seed, the task and the episode's seed alone."""


class Skip(ABC):
    """Decides, before the target verifies anything, whether a chunk is executed without a verification. phase: of
    `PHASES`, the one that the time of `take` is added to."""

    phase = "propose"

    def begin(self, task: str, seed: int) -> None:  # noqa: B027 - most rules keep nothing between decodes
        """A new episode begins."""

    def finish(self, success: bool) -> None:  # noqa: B027
        """An episode ended."""

    @abstractmethod
    def take(self, chunk: Chunk) -> bool:
        """Completes the chunk, if it may be executed unverified -> whether it did."""

    def verified(self, chunk: Chunk) -> None:  # noqa: B027
        """The prefill of a chunk that was not taken has judged the in-prefill draft."""


@runtime_checkable
class TakesMany(Protocol):
    """A skip rule that can take the chunks of several episodes together."""

    def take_many(self, chunks: Sequence[Chunk], cache: Callable[[int], Cache]) -> None:
        """Completes B chunks. cache: rows -> an empty one."""
