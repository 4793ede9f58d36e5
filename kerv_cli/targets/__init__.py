"""Register kerv's own families of targets: compact, grown and OpenVLA."""

from __future__ import annotations

from kerv_cli.base.registry import add

add("target", "compact", "kerv_cli.targets.compact.folder:build")
add(
    "target",
    "grown",
    "kerv_cli.targets.grown:build",
    weights="kerv_cli.targets.grown:check_weights",
    importer="kerv_cli.targets.grown:grow",
)
add(
    "target",
    "openvla",
    "kerv_cli.targets.openvla.target:build",
    weights="kerv_cli.targets.openvla.target:check_weights",
    importer="kerv_cli.targets.openvla.target:import_checkpoint",
    images_alone=True,  # reads no state
)
