"""Drafts of several sources as one tree (docs/methods.md §5, ours), e.g. of `one_pass`."""

from __future__ import annotations

from dataclasses import dataclass, field

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import MOST_TOKENS, number
from kerv_cli.base.registry import PREFILL, add, find


@dataclass
class MergedProposerSettings:
    """Merges whole drafts of several sources into one prefix tree (§5, ours).

    The fallback sources draft only if no other is sure of its chunk, because every node costs time.
    """

    kind: str = "merged"
    sources: list[str] = field(default_factory=lambda: ["early"])
    fallback: list[str] = field(default_factory=lambda: ["hold"])
    nodes: int = number(48, 1, MOST_TOKENS)  # the last sources' chains are dropped first
    neighbours: int = number(1, 1, MOST_TOKENS)  # retrieval: stored chunks

    def check_together(self, prefix: str) -> None:
        """Refuse settings without a source, or with one that cannot draft whole chains before the prefill."""
        if not self.sources:
            raise UsageError("merged: name at least one of sources")
        for name in (*self.sources, *self.fallback):
            if not find("proposer", name, "source of a merged draft").traits.get("chains"):
                raise UsageError(f"source '{name}' of a merged draft: it does not draft whole chunks from the prompt")


def needs_of_sources(settings: MergedProposerSettings) -> tuple[str, ...]:
    """Return the artifacts that the sources need together."""
    names = (*settings.sources, *settings.fallback)
    return tuple(dict.fromkeys(kind for name in names for kind in find("proposer", name).needs(None)))


_BUILD = "kerv_cli.methods.merged.proposer:MergedProposer.build"
_parts = (_BUILD, MergedProposerSettings, needs_of_sources)
add("proposer", "merged", *_parts, colour=0xCC79A7, when=PREFILL, merged=True, cost="early")
