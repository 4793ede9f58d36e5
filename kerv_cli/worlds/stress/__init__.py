"""Stress: shifts of a stated size between the world that a policy was trained in and the one that it acts in
(docs/stress.md). A kind is a file here and an entry of the registry; its levels stand in that file.

Imports nothing heavy: a kind's module is imported when it is built.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from kerv_cli.base.errors import UsageError
from kerv_cli.base.registry import find, load
from kerv_cli.worlds.settings import StressSettings
from kerv_cli.worlds.stress.base import NO_STRESS, Stress

if TYPE_CHECKING:
    from kerv_cli.worlds.spec import EnvironmentSpec

KIND = "stress"
NEEDED = "needed"
"""Trait of a kind: its needs, keys of `_MISSING`."""
STRESSABLE = "stressable"
"""Attribute of a world's class: the needs that it meets, keys of `_MISSING`."""

_MISSING = {
    "actions": "its world takes no stress",
    "position": "its actions have no group 'position'",
    "images": "its world takes no stress of images",
    "model": "its world has no MuJoCo model",
    "range": "its world cannot widen the range of initial states",
}
"""Need of a kind of stress -> why an environment does not meet it."""


def build(settings: StressSettings) -> Stress:
    """The stress of these settings; level 0 is none.

    Raises:
        UnknownName: no such kind.
    """
    if not settings.active:
        return NO_STRESS
    built: Stress = find(KIND, settings.kind).built(settings.level)
    return built


def check(settings: StressSettings, spec: EnvironmentSpec) -> None:
    """Refuses a kind of stress that the environment cannot have.

    Raises:
        UsageError: what it lacks.
    """
    if not settings.active:
        return
    able = set(getattr(load(spec.world_class), STRESSABLE, ())) if spec.world_class else set()
    if any(group.name == "position" for group in spec.actions.groups):
        able.add("position")
    for need in find(KIND, settings.kind).traits[NEEDED]:
        if need not in able:
            raise UsageError(f"world.stress.kind={settings.kind}: not possible in {spec.name}: {_MISSING[need]}")
