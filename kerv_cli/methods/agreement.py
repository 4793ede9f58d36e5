"""Two sources of drafts that are compared: agreement (docs/methods.md §4.8, ours) executes a draft unverified where a
second source drafts nearly the same; watch (§6.2) executes the target's plan for as long as the source would still act
nearly so. Nothing heavy is imported here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

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
class AgreementSettings:
    """A draft is executed unverified where another source drafts nearly the same."""

    kind: str = "agreement"
    source: str = "early"  # the other view: a proposer that drafts whole chunks before the prefill
    tolerance: float = number(0.1, 0, FARTHEST)  # mean abs difference of two drafts that agree, normalised


@dataclass
class WatchSettings:
    """The target decodes; while its chunk is executed, a source of drafts says what it would do now."""

    kind: str = "watch"
    source: str = "early"  # what looks: a proposer that drafts whole chunks before the prefill
    every: int = number(1, 1, 1024)  # control steps between two looks
    tolerance: float = number(0.1, 0, FARTHEST)  # mean abs difference of two actions that still agree, normalised


def check_source(settings: AgreementSettings | WatchSettings) -> None:
    """Raises UnknownName for a source that is not there, UsageError for one that cannot look."""
    traits = find("proposer", settings.source, "skip.source").traits
    if not traits.get("chains"):
        raise UsageError(f"skip.source={settings.source}: it does not draft whole chunks from an observation")
    if traits.get("remembers"):
        raise UsageError(
            f"skip.source={settings.source}: it remembers episodes, of which a skip rule tells its source nothing; set "
            f"prefill_draft={settings.source}, or another source, e.g. hold"
        )


def needs_of_source(settings: AgreementSettings | WatchSettings) -> tuple[str, ...]:
    """The artifacts that the source reads."""
    part = find("proposer", settings.source)
    return part.needs(part.default)


def source_of(settings: AgreementSettings | WatchSettings, context: Context) -> ChainProposer:
    """The source, with its default settings."""
    part = find("proposer", settings.source)
    source: ChainProposer = part.built(part.default, context)
    return source


def is_near(chunk: Chunk, tokens: Sequence[int], others: Sequence[int], tolerance: float) -> bool:
    """Whether tokens of the chunk differ from others by at most `tolerance`: the mean absolute difference, normalised;
    FARTHEST where a strict DoF differs."""
    return min(FARTHEST, chunk.distance(tokens, others)) <= tolerance


class AgreementSkip(Skip):
    """Executes the in-prefill draft unverified where `other` drafts a chunk at most `tolerance` away, strict DoFs
    equal."""

    def __init__(self, draft: ChainProposer, other: ChainProposer, tolerance: float) -> None:
        self.draft, self.other, self.tolerance = draft, other, tolerance

    @classmethod
    def build(cls, settings: AgreementSettings, context: Context) -> AgreementSkip:
        """skip=agreement."""
        return cls(context.built["prefill_draft"], source_of(settings, context), settings.tolerance)

    def take(self, chunk: Chunk) -> bool:
        """Fills the chunk with the draft where both sources agree -> whether it did."""
        chains = [source.chains(chunk, chunk.size) for source in (self.draft, self.other)]
        if any(not chain or len(chain[0]) < chunk.size for chain in chains):
            return False
        (draft, *_), (other, *_) = chains
        if not is_near(chunk, draft, other, self.tolerance):
            return False
        chunk.skip(draft, self.draft.name)
        return True


class Watch(Skip):
    """Leaves every chunk to the target, and keeps it for as long as the source's action is near the planned one."""

    def __init__(self, source: ChainProposer, every: int, tolerance: float) -> None:
        self.source, self.every, self.tolerance = source, every, tolerance

    @classmethod
    def build(cls, settings: WatchSettings, context: Context) -> Watch:
        """skip=watch."""
        return cls(source_of(settings, context), settings.every, settings.tolerance)

    def take(self, chunk: Chunk) -> bool:
        """Never: the target decodes."""
        return False

    def keeps(self, chunk: Chunk, planned: Sequence[int]) -> bool:
        """See `Watches.keeps`. A source without a draft keeps every plan."""
        chains = self.source.chains(chunk, len(planned))
        return not chains or is_near(chunk, chains[0], planned, self.tolerance)


_FILE, _SOURCE = "kerv_cli.methods.agreement:", (needs_of_source, check_source)
add("skip", "agreement", _FILE + "AgreementSkip.build", AgreementSettings, *_SOURCE, colour=0x4C9F70, takes_draft=True)
add("skip", "watch", _FILE + "Watch.build", WatchSettings, *_SOURCE, colour=0x5F7FA8, watches=True)
