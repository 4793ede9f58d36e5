"""The environments and kinds of stress that kerv has itself; imported for what they register."""

from __future__ import annotations

from kerv_cli.base.registry import add

_NAMES = "kerv_cli.worlds.metaworld.tasks:NAMES"
add("environment", "metaworld", "kerv_cli.worlds.metaworld.spec:SPEC", names=_NAMES)
for _name, _made_by, _needed in (
    ("push", "push:Push", ("actions", "position")),
    ("actuation", "actuation:Actuation", ("actions",)),
    ("sensor", "sensor:Sensor", ("images",)),
    ("light", "light:Light", ("model",)),
    ("colour", "colour:Colour", ("model",)),
    ("camera", "camera:CameraJitter", ("model",)),
    ("object", "objects:Objects", ("model", "range")),
):
    add("stress", _name, f"kerv_cli.worlds.stress.{_made_by}", needed=_needed)
add("stress", "none", needed=())
