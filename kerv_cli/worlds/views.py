"""The views of a frame: one camera, or several views side by side, named by the cameras joined with `+`.

`corner4+gripperPOV:75` is two cameras, the second with a field of view of its own.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from kerv_cli.base.errors import UsageError

VIEWS = "+"
"""Between the cameras of a joined name."""
_PART = re.compile(r"(?P<camera>[^:@]+)(:(?P<fovy>\d{1,3}(\.\d{1,3})?))?", re.ASCII)


@dataclass(frozen=True)
class View:
    """One part of a frame. fovy: degrees; None: as all others."""

    camera: str
    fovy: float | None = None

    @property
    def name(self) -> str:
        """The camera, with the field of view where the view states one."""
        return self.camera if self.fovy is None else f"{self.camera}:{self.fovy:g}"


def views_of(name: str) -> tuple[View, ...]:
    """The views of a frame of that name, from left to right; of the empty name one, of the environment's first camera.

    Raises:
        UsageError: a part without a camera, or an impossible field of view.
    """
    return tuple(_view(part, name) for part in name.split(VIEWS)) if name else (View(""),)


def frame_shape(name: str, size: int) -> tuple[int, int, int]:
    """(size, size x views, 3): height, width and colours of a frame of that name; size: of one view, pixels."""
    return size, size * len(views_of(name)), 3


def _view(part: str, name: str) -> View:
    match = _PART.fullmatch(part)
    fovy = float(match["fovy"]) if match and match["fovy"] else None
    if match is None or (fovy is not None and not 0 < fovy < 180):
        raise UsageError(
            f"camera name '{name}': '{part}' is no view; write NAME or NAME:DEGREES (above 0, below 180), joined "
            "with +, e.g. front+wrist:75"
        )
    return View(match["camera"], fovy)
