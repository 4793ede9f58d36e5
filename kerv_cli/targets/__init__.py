"""Register kerv's own families of targets: compact, grown and OpenVLA. Their modules are imported when needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from kerv_cli.base.registry import Part, load


@dataclass(frozen=True, kw_only=True)
class TargetPart(Part):
    """A family of targets. It decorates the function (folder, description, device, dtype) that loads a target.

    Args:
        importer: Function (settings, folder) that writes a target of this family into an empty folder, for `kerv build
            target`. It returns numbers to print, by name. None if such targets are made only by training.
        check_weights: Function (folder, description) that checks weights stored outside the target's folder. None if
            the weights are in the target's folder.
        images_alone: Whether targets of this family read only images, and no proprioception or state.
    """

    kind = "target"
    importer: Callable[[Any, Any], Any] | None = None
    check_weights: Callable[[Any, Any], None] | None = None
    images_alone: bool = False


def _at(name: str) -> Callable[..., Any]:
    return lambda *arguments: load(f"kerv_cli.targets.{name}")(*arguments)


TargetPart("compact")(_at("compact.target:build"))
TargetPart("grown", importer=_at("grown:grow"), check_weights=_at("grown:check_weights"))(_at("grown:build"))
TargetPart(
    "openvla",
    importer=_at("openvla.target:import_checkpoint"),
    check_weights=_at("openvla.target:check_weights"),
    images_alone=True,  # it reads no state
)(_at("openvla.target:build"))
