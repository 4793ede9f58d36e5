"""Jacobi decoding, as in PD-VLA (docs/methods.md §6). Settings and registration."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import MOST_TOKENS, number
from kerv_cli.base.registry import STATES, add


@dataclass
class JacobiProposerSettings:
    """PD-VLA: the parallel argmax of the guess before, over the rest of the chunk (§6)."""

    kind: str = "jacobi"
    depth: int = number(0, 0, MOST_TOKENS)  # tokens guessed at once; 0: all that are left


_BUILD = "kerv_cli.methods.jacobi.proposer:JacobiProposer.build"
add("proposer", "jacobi", _BUILD, JacobiProposerSettings, colour=0x8A7FD4, when=STATES)
