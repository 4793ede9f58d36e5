"""Stress: shifts of a stated size between the world of the training and the world of the evaluation (docs/stress.md).

The kinds are parts in the registry. A kind's module is imported when it is built.
"""

from __future__ import annotations

from kerv_cli.base.registry import find
from kerv_cli.worlds.settings import StressSettings
from kerv_cli.worlds.stress.base import NO_STRESS, Stress


def build(settings: StressSettings) -> Stress:
    """Return the stress of these settings. Level 0 is no stress.

    Raises:
        UnknownName: There is no such kind.
    """
    if not settings.active:
        return NO_STRESS
    stress: Stress = find("stress", settings.kind).built(settings.level)
    return stress
