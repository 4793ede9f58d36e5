"""The views of a frame: one camera, or several views side by side, named by the cameras joined with `+`.

`corner4+gripperPOV:75` is two cameras, the second with a field of view of its own.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from kerv_cli.base.errors import UsageError

VIEWS = "+"
"""Joins the cameras of a frame's name."""
_VIEW = re.compile(r"(?P<camera>[^:@]+)(:(?P<fovy>\d{1,3}(\.\d{1,3})?))?", re.ASCII)


@dataclass(frozen=True)
class View:
    """One part of a frame. `fovy` is its vertical field of view in degrees, None for the frame's own."""

    camera: str
    fovy: float | None = None

    @property
    def name(self) -> str:
        """The camera, with the field of view if the view has its own."""
        return self.camera if self.fovy is None else f"{self.camera}:{self.fovy:g}"


def views_of(name: str) -> tuple[View, ...]:
    """Return the views of a frame, from left to right. An empty name is one view of the environment's first camera.

    Raises:
        UsageError: A part has no camera, or an impossible field of view.
    """
    return tuple(_view(part, name) for part in name.split(VIEWS)) if name else (View(""),)


def frame_shape(name: str, size: int) -> tuple[int, int, int]:
    """Return (size, size x views, 3): height, width and colours of a frame with views of `size` pixels."""
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
