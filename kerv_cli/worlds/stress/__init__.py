"""Stress: disturbances of known size, by which the evaluated world differs from that of training (docs/stress.md).

The kinds of stress are in the registry. The module of a kind is imported when it is used.
"""

from __future__ import annotations

from kerv_cli.base.registry import find
from kerv_cli.worlds.settings import StressSettings
from kerv_cli.worlds.stress.base import NO_STRESS, Stress


def build(settings: StressSettings) -> Stress:
    """Return the stress that the settings describe. At level 0 it changes nothing.

    Raises:
        UnknownName: There is no such kind.
    """
    if not settings.active:
        return NO_STRESS
    stress: Stress = find("stress", settings.kind).built(settings.level)
    return stress
