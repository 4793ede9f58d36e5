"""Register kerv's own families of targets: compact, grown and OpenVLA. Each function imports its module when called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from kerv_cli.base.registry import Part


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


@TargetPart("compact")
def compact(*arguments: Any) -> Any:
    from kerv_cli.targets.compact.target import build

    return build(*arguments)


def _grow(*arguments: Any) -> Any:
    from kerv_cli.targets.grown import grow

    return grow(*arguments)


def _check_grown(*arguments: Any) -> None:
    from kerv_cli.targets.grown import check_weights

    check_weights(*arguments)


@TargetPart("grown", importer=_grow, check_weights=_check_grown)
def grown(*arguments: Any) -> Any:
    from kerv_cli.targets.grown import build

    return build(*arguments)


def _import_openvla(*arguments: Any) -> Any:
    from kerv_cli.targets.openvla.target import import_checkpoint

    return import_checkpoint(*arguments)


def _check_openvla(*arguments: Any) -> None:
    from kerv_cli.targets.openvla.target import check_weights

    check_weights(*arguments)


@TargetPart("openvla", importer=_import_openvla, check_weights=_check_openvla, images_alone=True)  # reads no state
def openvla(*arguments: Any) -> Any:
    from kerv_cli.targets.openvla.target import build

    return build(*arguments)
