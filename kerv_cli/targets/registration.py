"""The families of targets that kerv has itself; imported for what they register."""

from __future__ import annotations

from kerv_cli.base.registry import Part, register

register(Part("target", "compact", "kerv_cli.targets.compact.folder:build"))
register(
    Part(
        "target",
        "openvla",
        "kerv_cli.targets.openvla.target:build",
        traits={
            "weights": "kerv_cli.targets.openvla.target:check_weights",
            "importer": "kerv_cli.targets.openvla.importing:import_checkpoint",
            "images_alone": True,  # reads no state
        },
    )
)
