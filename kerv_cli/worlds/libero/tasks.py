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
INSTRUCTIONS = {
    f"bowl-{where.replace(' the', '').replace('the ', '').replace(' ', '-')}": (
        f"pick up the black bowl {where} and place it on the plate"
    )
    for where in _WHERE
}
"""Name of a task -> its instruction."""

SUITE = "LIBERO_SPATIAL"
NAMES = (SUITE, *INSTRUCTIONS)
"""Names of the suite and its tasks, for shell completion."""
