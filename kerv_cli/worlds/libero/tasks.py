"""The tasks of LIBERO's suite `libero_spatial` and their instructions."""

from __future__ import annotations

_WHERE = (
    "between the plate and the ramekin",
    "next to the ramekin",
    "from table center",
    "on the cookie box",
    "in the top drawer of the wooden cabinet",
    "on the ramekin",
    "next to the cookie box",
    "on the stove",
    "next to the plate",
    "on the wooden cabinet",
)
INSTRUCTIONS: dict[str, str] = {}
"""Instruction of each task, by the task's name."""

for _place in _WHERE:
    _name = _place.replace(" the", "").replace("the ", "").replace(" ", "-")
    INSTRUCTIONS[f"bowl-{_name}"] = f"pick up the black bowl {_place} and place it on the plate"

SUITE = "LIBERO_SPATIAL"
NAMES = (SUITE, *INSTRUCTIONS)
"""Names of the suite and its tasks, for shell completion."""
