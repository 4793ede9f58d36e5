"""Parse the name of a camera, which may stand for several views side by side.

`corner4+gripperPOV:75` means two cameras. The second camera has its own field of view of 75 degrees.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from kerv_cli.base.errors import UsageError

VIEWS = "+"  # joins the views in a camera's name
_VIEW = re.compile(r"(?P<camera>[^:@]+)(:(?P<fovy>\d{1,3}(\.\d{1,3})?))?", re.ASCII)


class View(NamedTuple):
    """One of the views of an image."""

    name: str  # this view's part of the full camera name, such as `gripperPOV:75` in `corner4+gripperPOV:75`
    camera: str
    fovy: float | None  # vertical field of view in degrees. If None, the camera settings decide.


def views_of(name: str) -> list[View]:
    """Parse a camera's name into its views, from left to right. An empty name is one view of the first camera."""
    views = [] if name else [View("", "", None)]
    for part in name.split(VIEWS) if name else ():
        match = _VIEW.fullmatch(part)
        fovy = float(match["fovy"]) if match and match["fovy"] else None
        if match is None or (fovy is not None and not 0 < fovy < 180):
            raise UsageError(
                f"camera name '{name}': '{part}' is no view; write NAME or NAME:DEGREES (above 0, below 180), joined "
                "with +, e.g. front+wrist:75"
            )
        views.append(View(part, match["camera"], fovy))
    return views


def frame_shape(name: str, size: int) -> tuple[int, int, int]:
    return size, size * len(views_of(name)), 3
