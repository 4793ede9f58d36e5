"""The 50 tasks of Meta-World v3: names, instructions, difficulty groups, suites.

Join tasks by name, never by index: published tables order them differently.
"""

from __future__ import annotations

from collections.abc import Mapping

from kerv_cli.worlds.task import Task

SUFFIX = "-v3"
DIFFICULTIES = ("easy", "medium", "hard", "very_hard")
"""The groups of published macro averages."""

# Difficulty -> task name without suffix -> instruction of at most ten lower-case words. The public table has the same
# sentence for push and push-back. These 50 differ and describe what the experts do.
_INSTRUCTIONS: dict[str, dict[str, str]] = {
    "easy": {
        "button-press": "press the button",
        "button-press-topdown": "press the button from above",
        "button-press-topdown-wall": "bypass the wall and press the button from above",
        "button-press-wall": "bypass the wall and press the button",
        "coffee-button": "press the button of the coffee machine",
        "dial-turn": "turn the dial",
        "door-close": "close the door",
        "door-lock": "turn the lock to lock the door",
        "door-open": "open the door",
        "door-unlock": "turn the lock to unlock the door",
        "drawer-close": "push the drawer closed",
        "drawer-open": "pull the drawer open",
        "faucet-close": "turn the faucet off clockwise",
        "faucet-open": "turn the faucet on counterclockwise",
        "handle-press": "press the handle down",
        "handle-press-side": "press the sideways handle down",
        "handle-pull": "pull the handle up",
        "handle-pull-side": "pull the sideways handle up",
        "lever-pull": "pull the lever up",
        "peg-unplug-side": "unplug the peg sideways",
        "plate-slide": "slide the plate into the net",
        "plate-slide-back": "slide the plate back out of the net",
        "plate-slide-back-side": "slide the plate sideways out of the net",
        "plate-slide-side": "slide the plate sideways into the net",
        "reach": "reach the goal position",
        "reach-wall": "bypass the wall and reach the goal position",
        "window-close": "slide the window closed",
        "window-open": "slide the window open",
    },
    "medium": {
        "basketball": "drop the basketball into the basket",
        "bin-picking": "move the cube from one bin into the other",
        "box-close": "put the lid on the box",
        "coffee-pull": "pull the mug away from the coffee machine",
        "coffee-push": "push the mug under the coffee machine",
        "hammer": "hit the nail with the hammer",
        "peg-insert-side": "insert the peg into the hole from the side",
        "push-wall": "push the puck around the wall to the goal",
        "soccer": "push the soccer ball into the net",
        "sweep": "sweep the cube off the table",
        "sweep-into": "sweep the cube into the hole",
    },
    "hard": {
        "assembly": "put the ring onto the peg",
        "hand-insert": "put the cube down into the hole",
        "pick-out-of-hole": "pick the puck out of the hole",
        "pick-place": "pick up the puck and place it at the goal",
        "push": "push the puck forward to the goal",
        "push-back": "drag the cube back to the goal",
    },
    "very_hard": {
        "disassemble": "take the ring off the peg",
        "pick-place-wall": "lift the puck over the wall to the goal",
        "shelf-place": "place the cube on the shelf",
        "stick-pull": "grasp the stick and pull the thermos with it",
        "stick-push": "grasp the stick and push the thermos with it",
    },
}

_MT10 = (
    "reach push pick-place door-open drawer-open drawer-close button-press-topdown peg-insert-side window-open "
    "window-close"
)

TASKS: Mapping[str, Task] = {
    name: Task(name, instruction, difficulty)
    for name, instruction, difficulty in sorted(
        (f"{stem}{SUFFIX}", instruction, difficulty)
        for difficulty, group in _INSTRUCTIONS.items()
        for stem, instruction in group.items()
    )
}
"""All 50 tasks by full name, in alphabetical order."""

SUITES: Mapping[str, tuple[str, ...]] = {
    "MT10": tuple(f"{stem}{SUFFIX}" for stem in _MT10.split()),
    "MT50": tuple(TASKS),
}
"""Suite name to full task names."""

NAMES = (*SUITES, *TASKS)
"""Suites and tasks, for completion."""
