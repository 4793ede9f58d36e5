"""What the parts of a method return to the decoder. This file imports neither torch nor numpy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np


@dataclass(frozen=True)
class Choice:
    """What a boundary decides about the next chunk: who drafts it, and how many tokens to decode."""

    mode: str  # the proposer's name
    metric: float | None = None  # F (docs/methods.md §4.4); None if the decision does not use it
    most: int | None = None  # largest number of tokens to decode; None: the whole chunk


class Rectified(NamedTuple):
    """What a rectifier predicted after a rejection.

    Attributes:
        values: Normalised actions (S, D) of the chunk's first S control steps: first the values of the committed
            tokens, then predicted values.
        ends: Whether the chunk ends with these actions, so that later control steps are dropped. If False, the target
            decodes the later steps.
    """

    values: np.ndarray
    ends: bool = True


class SkipDecision(NamedTuple):
    """What a skip rule decides about a chunk.

    Attributes:
        tokens: The N tokens of the chunk, to execute without verification. None if the target decodes the chunk.
        proposer: Name of the proposer that drafted `tokens`. PARALLEL (`record.py`) if a parallel target computed them.
        reason: The rule's reason to skip or to verify, which `DecodeRecord.reason` stores. None if there is no reason.
    """

    tokens: Sequence[int] | None = None
    proposer: str = ""
    reason: str | None = None
