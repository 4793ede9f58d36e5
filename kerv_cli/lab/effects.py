"""Settings of a rollout that change nothing, because no part of its method reads them."""

from __future__ import annotations

from collections.abc import Iterable

from kerv_cli.base.registry import METHOD_KINDS, part_of
from kerv_cli.base.settings import CONSTANT, EXPERT, PROFILE, WAITS, RolloutSettings, TimingSettings

_JUDGED = ("acceptance", "threshold", "rectifier")
"""The parts that judge drafts."""
_ARTIFACTS = ("drafter", "early", "datastore", "calibration")
_OF_SWEEPS = ("runtime.workers", "runtime.executor", "runtime.executor_options")


def without_effect(settings: RolloutSettings, overrides: Iterable[str], sweep: bool = False) -> dict[str, str]:
    """Those of the overrides `key=value` that have no effect on the rollout -> why. sweep: it is one of a sweep's.

    An expert's are left out: it refuses the settings of a method.
    """
    if settings.policy.kind == EXPERT:
        return {}
    idle = idle_keys(settings) | ({} if sweep else dict.fromkeys(_OF_SWEEPS, "a rollout runs in one process"))
    reasons = {}
    for word in overrides:
        key = word.partition("=")[0].lstrip("+")
        reason = next((why for name, why in idle.items() if key == name or key.startswith(f"{name}.")), None)
        if reason is not None:
            reasons[word] = reason
    return reasons


def _idle_timing(timing: TimingSettings) -> dict[str, str]:
    if timing.clock == WAITS:
        names = ("latency", "latency_ms", "profile", "ar_ms", "delay_compensation")
        return {f"rollout.{name}": "rollout.clock=waits: the world waits for every decode" for name in names}
    idle = {}
    if timing.latency != CONSTANT:
        idle["rollout.latency_ms"] = f"rollout.latency={timing.latency}"
    if timing.latency != PROFILE:
        idle["rollout.profile"] = f"rollout.latency={timing.latency} reads no profile"
    if timing.latency == CONSTANT:
        idle["rollout.ar_ms"] = "rollout.latency=constant scales nothing"
    return idle


def idle_keys(settings: RolloutSettings) -> dict[str, str]:
    """Key of a setting that has no effect -> why."""
    method = settings.parts()
    names = {kind: method[kind].kind for kind in METHOD_KINDS}
    idle: dict[str, str] = {}
    if names["proposer"] == names["prefill_draft"] == "none":
        idle |= dict.fromkeys(_JUDGED, f"method {settings.method} drafts nothing")
    elif names["skip"] == "always":
        idle["rectifier"] = "skip=always verifies nothing, so nothing is rejected"
    elif names["acceptance"] in ("strict", "sequence"):
        idle["threshold"] = f"acceptance={names['acceptance']} has no threshold"
    needed = {need for kind in METHOD_KINDS for need in part_of(kind, names[kind]).needs(method[kind])}
    for kind in _ARTIFACTS:
        if kind not in needed:
            idle[f"policy.{kind}"] = f"method {settings.method} reads no {kind}"
    if "datastore" not in needed:
        idle["datastore"] = f"method {settings.method} reads no datastore"
    idle |= _idle_timing(settings.rollout)
    batch = settings.rollout.batch
    if batch > 1:
        idle |= dict.fromkeys(("record", "record_size"), f"rollout.batch={batch}: episodes of a batch are not recorded")
    if not settings.record:
        idle["record_size"] = "record=0 saves no recording"
    return idle
