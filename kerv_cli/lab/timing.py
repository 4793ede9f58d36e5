"""Checks `rollout.*` of a rollout's settings and builds the latency that they name (docs/methods.md §8)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kerv_cli.base.errors import UsageError
from kerv_cli.base.settings import CONSTANT, MEASURED, PROFILE, REAL, RolloutSettings, TimingSettings
from kerv_cli.lab import latency
from kerv_cli.lab.clock import CHUNK
from kerv_cli.methods.compose import Method
from kerv_cli.worlds.spec import EnvironmentSpec

if TYPE_CHECKING:
    from kerv_cli.targets.checkpoint import TargetDescription


def check_numbers(settings: RolloutSettings, spec: EnvironmentSpec) -> None:
    """Refuses a constant latency in which an episode ends before its first action.

    Raises:
        UsageError: it does.
    """
    timing = settings.rollout
    horizon = spec.control_steps(settings.world.horizon)
    if _is_constant(timing) and _steps(timing, spec) >= horizon:
        raise UsageError(
            f"rollout.latency_ms={timing.latency_ms:g}: {_steps(timing, spec)} control steps, but an episode of "
            f"{spec.name} has {horizon}"
        )


def check_expert(settings: RolloutSettings, spec: EnvironmentSpec) -> None:
    """Refuses what an expert's decodes do not have.

    Raises:
        UsageError: forwards or AR's time are asked for, or a chunk of one step is to be shortened.
    """
    timing = settings.rollout
    if timing.clock != REAL:
        return
    if timing.latency == PROFILE or (timing.ar_ms and timing.latency != CONSTANT):
        override = "rollout.latency=profile" if timing.latency == PROFILE else f"rollout.ar_ms={timing.ar_ms:g}"
        raise UsageError(f"policy=expert with {override}: it has no forwards; use rollout.latency=constant or measured")
    _check_chunk(timing, spec, 1)


def check_method(settings: RolloutSettings, spec: EnvironmentSpec, target: TargetDescription) -> None:
    """Refuses a profile that does not know what the method does, and a latency that leaves nothing of a chunk.

    Raises:
        UsageError: the profile lacks a phase of the method, the target measures no AR, or all of a chunk is stale.
    """
    timing = settings.rollout
    if timing.clock != REAL:
        return
    latency_of(settings, target, 1.0)
    if calibrates(settings):
        target.check_autoregressive(f"rollout.ar_ms={timing.ar_ms:g} of rollout.latency=measured", "no AR to measure")
    _check_chunk(timing, spec, settings.chunk or target.chunk)


def _check_chunk(timing: TimingSettings, spec: EnvironmentSpec, steps: int) -> None:
    if _is_constant(timing) and timing.delay_compensation == CHUNK and _steps(timing, spec) >= steps:
        raise UsageError(
            f"rollout.latency_ms={timing.latency_ms:g} with rollout.delay_compensation=chunk: all {steps} control "
            f"steps of a chunk are stale after {_steps(timing, spec)}"
        )


def _is_constant(timing: TimingSettings) -> bool:
    return timing.clock == REAL and timing.latency == CONSTANT


def _steps(timing: TimingSettings, spec: EnvironmentSpec) -> int:
    return latency.steps_of(timing.latency_ms / 1000.0, spec.actions.control_hz)


def calibrates(settings: RolloutSettings) -> bool:
    """Whether AR's time on this machine must be measured first."""
    timing = settings.rollout
    return timing.clock == REAL and timing.latency == MEASURED and timing.ar_ms > 0


def identity_of(settings: RolloutSettings) -> dict[str, str]:
    """Hash of the profile, where one is read. Raises UsageError where it is missing."""
    timing = settings.rollout
    if timing.clock != REAL or timing.latency != PROFILE:
        return {}
    return {"profile": latency.profile_hash(settings.results, timing.profile)}


def latency_of(settings: RolloutSettings, target: TargetDescription | None, measured: float) -> latency.Latency:
    """The source of latencies. target: None for the expert. measured: seconds of AR's decode here, where it
    `calibrates`.

    Raises:
        UsageError: a profile that is missing, impossible, or lacks a phase that the method needs.
    """
    timing = settings.rollout
    ar_seconds = timing.ar_ms / 1000.0
    if timing.latency == CONSTANT:
        return latency.Constant(timing.latency_ms / 1000.0)
    if timing.latency == MEASURED:
        return latency.Measured(ar_seconds / measured if ar_seconds else 1.0)
    assert target is not None
    drafter = latency.DRAFTER if "drafter" in Method.of(settings).needs else ()
    profile = latency.open_profile(settings.results, timing.profile, (*latency.FORWARDS, *drafter))
    if not ar_seconds:
        return latency.Profiled(profile)
    whole = profile.decode((settings.chunk or target.chunk) * target.actions.dofs)
    if not whole:
        raise UsageError(f"rollout.profile={timing.profile}: AR takes no time in it: nothing can be in proportion")
    return latency.Profiled(profile, ar_seconds / whole)
