"""EAGLE-style drafting from the target's hidden states (docs/methods.md §2.2). Settings and registration."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import MOST_TOKENS, number
from kerv_cli.base.registry import STATES, add

_DRAFTER = "kerv_cli.methods.eagle.drafter:"


@dataclass
class DrafterProposerSettings:
    """EAGLE-style drafter (§2.2). The default is a greedy chain as deep as the chunk: on a CPU it beats a tree, because
    relaxed acceptance accepts most of what siblings would catch, and every verified node costs time (study=tree)."""

    kind: str = "drafter"
    depth: int = number(15, 1, MOST_TOKENS)  # tokens
    top_k: int = number(1, 1, MOST_TOKENS)  # children expanded per level
    nodes: int = number(15, 1, MOST_TOKENS)  # tree nodes kept after reranking


add("artifact", "drafter", _DRAFTER + "DrafterArtifact")
_build = (_DRAFTER + "DrafterProposer.build", DrafterProposerSettings)
add("proposer", "drafter", *_build, needs=("drafter",), colour=0x56B4E9, when=STATES)
