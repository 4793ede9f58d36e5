"""The environments and kinds of stress that kerv has itself; imported for what they register."""

from __future__ import annotations

from kerv_cli.base.registry import Part, register

register(
    Part(
        "environment",
        "metaworld",
        "kerv_cli.worlds.metaworld.spec:SPEC",
        traits={"names": "kerv_cli.worlds.metaworld.tasks:NAMES"},
    )
)
for _name, _made_by, _needed in (
    ("push", "push:Push", ("actions", "position")),
    ("actuation", "actuation:Actuation", ("actions",)),
    ("sensor", "sensor:Sensor", ("images",)),
    ("light", "light:Light", ("model",)),
    ("colour", "colour:Colour", ("model",)),
    ("camera", "camera:CameraJitter", ("model",)),
    ("object", "objects:Objects", ("model", "range")),
):
    register(Part("stress", _name, f"kerv_cli.worlds.stress.{_made_by}", traits={"needed": _needed}))
register(Part("stress", "none"))
