"""EAGLE-style drafting from the target's hidden states (docs/methods.md §2.2)."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import MOST_TOKENS, number
from kerv_cli.base.registry import DRAFTING, STATES, add_drafter


@dataclass
class DrafterSettings:
    """Decoder layers of the target's width after its states, and their training (§2.2)."""

    kind: str = "eagle"
    layers: int = number(1, 0, 1024)
    unroll: int = number(3, 1, 64)  # passes fed with its own predicted states, as drafting does; 1: the paper's
    samples: int = number(12_000, 1, 10**8)  # observations whose greedy decodes it is trained on
    state_weight: float = number(1.0, 0, 1e6)  # smooth-L1 on the hidden state
    token_weight: float = number(0.1, 0, 1e6)  # soft cross-entropy with the target's distribution


@dataclass
class DrafterProposerSettings:
    """EAGLE-style drafter (§2.2). The default is a greedy chain as deep as the chunk.

    On a CPU the chain beats a tree: relaxed acceptance accepts most of what siblings would catch, and every verified
    node costs time.
    """

    kind: str = "drafter"
    depth: int = number(15, 1, MOST_TOKENS)  # tokens
    top_k: int = number(1, 1, MOST_TOKENS)  # children expanded per level
    nodes: int = number(15, 1, MOST_TOKENS)  # tree nodes kept after reranking


add_drafter(
    "drafter",
    "kerv_cli.methods.eagle.drafter:EagleDrafter",
    DrafterSettings,
    DrafterProposerSettings,
    name="eagle",
    colour=0x56B4E9,
    when=STATES,
    cost=DRAFTING,
)
