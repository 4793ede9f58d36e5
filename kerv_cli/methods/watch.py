"""Watching (docs/methods.md §6.2): settings and registration, and the part, which needs nothing heavy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import number
from kerv_cli.base.registry import add, find
from kerv_cli.engine.parts import Skip

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.proposer import ChainProposer
    from kerv_cli.methods.context import Context

FARTHEST = 2.0
"""The largest difference of two actions, normalised; what a strict DoF that differs counts."""


@dataclass
class WatchSettings:
    """The target decodes; while its chunk is executed, a source of drafts says what it would do now."""

    kind: str = "watch"
    source: str = "early"  # what looks: a proposer that drafts whole chunks before the prefill
    every: int = number(1, 1, 1024)  # control steps between two looks
    tolerance: float = number(0.1, 0, FARTHEST)  # mean abs difference of two actions that still agree, normalised


def check_source(settings: Any) -> None:
    """Raises UnknownName for a source that is not there, UsageError for one that cannot look."""
    if not find("proposer", settings.source, "skip.source").traits.get("chains"):
        raise UsageError(f"skip.source={settings.source}: it does not draft whole chunks from an observation")


def is_near(chunk: Chunk, tokens: Sequence[int], others: Sequence[int], tolerance: float) -> bool:
    """Whether tokens of the chunk differ from others by at most `tolerance`: the mean absolute difference, normalised;
    FARTHEST where a strict DoF differs."""
    from kerv_cli.engine.loss import chunk_loss

    return FARTHEST * chunk_loss(chunk.space, tokens, others, FARTHEST) <= tolerance


class Watch(Skip):
    """Leaves every chunk to the target, and keeps it for as long as the source's own action is near the planned one."""

    def __init__(self, source: ChainProposer, every: int, tolerance: float) -> None:
        self.source, self.every, self.tolerance = source, every, tolerance

    @classmethod
    def build(cls, settings: WatchSettings, context: Context) -> Watch:
        """skip=watch."""
        part = find("proposer", settings.source)
        return cls(part.built(part.default, context), settings.every, settings.tolerance)

    def take(self, chunk: Chunk) -> bool:
        """Never: the target decodes."""
        return False

    def keeps(self, chunk: Chunk, planned: Sequence[int]) -> bool:
        """See `Watches.keeps`. A source without a draft keeps every plan."""
        chains = self.source.chains(chunk, len(planned))
        return not chains or is_near(chunk, chains[0], planned, self.tolerance)


def needs_of_source(settings: Any) -> tuple[str, ...]:
    """What the source reads."""
    part = find("proposer", settings.source)
    return part.needs(part.default)


add(
    "skip",
    "watch",
    "kerv_cli.methods.watch:Watch.build",
    WatchSettings,
    needs_of_source,
    check_source,
    0x5F7FA8,
    watches=True,
)
