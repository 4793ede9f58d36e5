"""EAGLE-style drafting from the target's hidden states (docs/methods.md §2.2)."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import MOST_TOKENS, choice, number
from kerv_cli.base.registry import DRAFTING, STATES, DrafterPart


@dataclass
class DrafterSettings:
    """Shapes and loss of the EAGLE-style drafter, which reads the target's hidden states (docs/methods.md §2.2)."""

    kind: str = "drafter"
    layers: int = number(1, 0, 1024)  # decoder layers of the target's width
    final_norm: bool = True  # an RMSNorm after the last layer (ours); EAGLE-2's and Spec-VLA's public drafters: false
    unroll: int = number(3, 1, 64)  # passes per training step; later ones read the drafter's own states; public code: 1
    samples: int = number(12_000, 1, 10**8)  # maximum number of observations whose greedy decodes it is trained on
    state_weight: float = number(1.0, 0, 1e6)  # weight of the smooth L1 loss on the hidden state
    token_weight: float = number(0.1, 0, 1e6)  # weight of the cross-entropy with the target's token distribution


@dataclass
class DrafterProposerSettings:
    """Shape of an EAGLE-style draft (docs/methods.md §2.2): EAGLE-2's tree, or a greedy chain.

    On a CPU the chain is faster. Every verified node costs time, and with relaxed acceptance a tree accepts little more
    than its best path. On a GPU a tree of 50 nodes costs about as much as a chain.
    """

    kind: str = "drafter"
    shape: str = choice("chain", "chain", "tree", help="a greedy path, or the most probable paths")
    depth: int = number(15, 1, MOST_TOKENS)  # maximum number of tokens on a path
    top_k: int = number(8, 1, MOST_TOKENS)  # tree: nodes expanded per depth, and children of each
    nodes: int = number(50, 1, MOST_TOKENS)  # tree: maximum number of nodes; the most probable ones are kept


def only_of_trees(settings: DrafterProposerSettings, *names: str) -> dict[str, str]:
    return dict.fromkeys(names, "a chain is a single path") if settings.shape == "chain" else {}


@DrafterPart(
    "drafter",
    DrafterProposerSettings,
    trained=DrafterSettings,
    colour=0x56B4E9,
    when=STATES,
    cost=DRAFTING,
    any_code=True,
    idle=lambda settings: only_of_trees(settings, "top_k", "nodes"),
)
def artifact() -> type:
    from kerv_cli.methods.eagle.drafter import EagleDrafter

    return EagleDrafter
