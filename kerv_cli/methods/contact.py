"""A threshold that shrinks the acceptance radius near the object (*ours*; docs/methods.md §3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import MOST_BINS, number
from kerv_cli.base.registry import ThresholdPart
from kerv_cli.engine.parts import Threshold
from kerv_cli.methods.kerv import RadiusRange, nearest

if TYPE_CHECKING:
    from kerv_cli.methods.context import Context


@dataclass
class ContactThresholdSettings(RadiusRange):
    """The radius grows with the distance from hand to object, as the policy itself estimates it."""

    kind: str = "contact"
    r_min: int = number(3, 0, MOST_BINS)  # radius at the object, bins
    r_max: int = number(15, 0, MOST_BINS)  # radius from the distance `near` on, bins
    near: float = number(0.1, above=0, most=100)  # metres


@ThresholdPart("contact", ContactThresholdSettings)
class Contact(Threshold):
    """The acceptance radius r grows linearly from r_min at the object to r_max at the distance `near` and beyond.

    The policy itself estimates the distance from hand to object, whenever it encodes an observation. The last estimate
    is used, which comes from an earlier decode. The first decode of an episode uses r_min.
    """

    def __init__(self, settings: ContactThresholdSettings, context: Context) -> None:
        """Read the settings.

        Raises:
            UsageError: The policy estimates no positions. Or the largest radius is larger than the largest distance
                between two tokens.
        """
        context.check_radius("r_max", settings.r_max)
        if not hasattr(context.target, "hand_and_object"):
            raise UsageError("threshold=contact: this policy estimates no position of an object. Use another threshold")
        self.settings, self.target = settings, context.target

    def reset(self) -> None:
        """Begin an episode: forget the last observation."""
        self.target.hand_and_object = None

    def radius(self) -> int:
        """Return the acceptance radius r, rounded to whole bins."""
        seen, s = self.target.hand_and_object, self.settings
        distance = float((seen[0] - seen[1]).norm()) if seen is not None else 0.0
        return nearest(s.r_min + (s.r_max - s.r_min) * min(1.0, distance / s.near))
