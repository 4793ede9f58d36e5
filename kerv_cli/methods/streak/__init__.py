"""Trust for as long as verification agrees (docs/methods.md §4.5, ours). Settings and registration."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import number
from kerv_cli.base.registry import add


@dataclass
class StreakSkipSettings:
    """Verified chunks that agree with their draft allow 1, 2, 4, … unverified decodes (§4.5). The draft is the
    in-prefill one, of `merged` its first source's."""

    kind: str = "streak"
    most: int = number(8, 1)  # decodes in a row without a verification
    opening: int = number(0, 0)  # decodes that an episode begins with, unverified
    tolerance: float = number(0.05, 0)  # mean abs difference that still agrees, normalised; 0: accepted whole


_BUILD = "kerv_cli.methods.streak.skip:StreakSkip.build"
add("skip", "streak", _BUILD, StreakSkipSettings, colour=0xE8C547, takes_draft=True, merges=True)
