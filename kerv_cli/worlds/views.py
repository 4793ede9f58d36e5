"""Parse the name of a camera, which may stand for several views side by side.

`corner4+gripperPOV:75` means two cameras. The second has its own field of view of 75 degrees.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from kerv_cli.base.errors import UsageError

VIEWS = "+"
"""Joins the views in a camera's name."""
_VIEW = re.compile(r"(?P<camera>[^:@]+)(:(?P<fovy>\d{1,3}(\.\d{1,3})?))?", re.ASCII)


@dataclass(frozen=True)
class View:
    """One of the views of an image.

    Attributes:
        camera: Name of the camera.
        fovy: Vertical field of view in degrees. None: that of the camera settings.
    """

    camera: str
    fovy: float | None = None

    @property
    def name(self) -> str:
        """The camera's name, followed by the field of view if the view has its own."""
        return self.camera if self.fovy is None else f"{self.camera}:{self.fovy:g}"


def views_of(name: str) -> tuple[View, ...]:
    """Parse a camera's name into its views, from left to right.

    Args:
        name: Views joined by `+`. Empty: one view of the environment's first camera.

    Raises:
        UsageError: A view has no camera or an impossible field of view.
    """
    return tuple(_view(part, name) for part in name.split(VIEWS)) if name else (View(""),)


def frame_shape(name: str, size: int) -> tuple[int, int, int]:
    """Return the shape (size, size x views, 3) of an image: height, width, colours.

    Args:
        name: Name of the camera, with its views joined by `+`.
        size: Height and width of each view in pixels.
    """
    return size, size * len(views_of(name)), 3


def _view(part: str, name: str) -> View:
    match = _VIEW.fullmatch(part)
    fovy = float(match["fovy"]) if match and match["fovy"] else None
    if match is None or (fovy is not None and not 0 < fovy < 180):
        raise UsageError(
            f"camera name '{name}': '{part}' is no view; write NAME or NAME:DEGREES (above 0, below 180), joined "
            "with +, e.g. front+wrist:75"
        )
    return View(match["camera"], fovy)
