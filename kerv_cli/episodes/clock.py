"""The clock of a world that goes on while the policy decodes: latencies as measured, constant, or by a latency profile
of another model and device, compensations of the delay, and what of `rollout.*` is refused (docs/methods.md §8)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.files import sha256_of
from kerv_cli.base.places import results_dir
from kerv_cli.base.registry import DRAFTING
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.cost import Profile, predicted, read_profile, work_of_record
from kerv_cli.engine.record import DecodeRecord, Delay
from kerv_cli.episodes.settings import CONSTANT, MEASURED, PROFILE, REAL, RolloutSettings
from kerv_cli.methods.compose import Method
from kerv_cli.worlds.spec import EnvironmentSpec

if TYPE_CHECKING:
    from kerv_cli.targets.checkpoint import TargetDescription

CHUNK = "chunk"
"""Compensation: drop the new chunk's stale actions."""

Latency = Callable[[DecodeRecord], float]
"""Seconds from a decode's observation to its first action."""


def steps_of(seconds: float, control_hz: float) -> int:
    """A latency in control steps, rounded up; float noise of a whole number of steps does not count.

    Raises:
        KervError: it is negative or not finite.
    """
    if not 0 <= seconds < math.inf:
        raise KervError(f"a decode cannot last {seconds} seconds: the latency's source is wrong")
    return math.ceil(round(seconds * control_hz, 6))


class RealClock:
    """Tells an episode how long each decode takes the world, and which actions are executed then.

    expected: control steps that the next decode is expected to take: as many as the one before, 0 at the beginning
    of an episode.
    """

    def __init__(self, latency: Latency, space: ActionSpace, compensation: str = "none") -> None:
        """space: the environment's. compensation: none or chunk."""
        self.latency, self.space, self.compensation = latency, space, compensation
        self.expected = 0

    def delay(self, decode: DecodeRecord, observed: int) -> Delay:
        """Of a decode whose observation was taken at control step `observed`.

        Raises:
            KervError: a latency that is negative or not finite.
        """
        seconds = self.latency(decode)
        steps = self.expected = steps_of(seconds, self.space.control_hz)
        stale = min(steps, len(decode.actions) - 1) if self.compensation == CHUNK else 0
        return Delay(seconds, steps, observed, dropped=stale)


def check(settings: RolloutSettings, spec: EnvironmentSpec, target: TargetDescription | None) -> None:
    """Refuses settings of the clock that cannot be. target: None for the expert.

    Raises:
        UsageError: an episode would end before its first action, or all of a chunk would be stale; the profile lacks a
            phase of the method; AR's time is asked for where there is none.
    """
    timing = settings.rollout
    if timing.clock != REAL:
        return
    constant = timing.latency == CONSTANT
    late = steps_of(timing.latency_ms / 1000.0, spec.actions.control_hz) if constant else 0
    horizon = spec.control_steps(settings.world.horizon)
    if late >= horizon:
        raise UsageError(
            f"rollout.latency_ms={timing.latency_ms:g}: {late} control steps, but an episode of {spec.name} has "
            f"{horizon}"
        )
    if target is not None:
        latency_of(settings, target, 1.0)
        if calibrates(settings):
            what = f"rollout.ar_ms={timing.ar_ms:g} of rollout.latency=measured"
            target.check_autoregressive(what, "no AR to measure")
    elif timing.latency == PROFILE or (timing.ar_ms and not constant):
        override = "rollout.latency=profile" if timing.latency == PROFILE else f"rollout.ar_ms={timing.ar_ms:g}"
        raise UsageError(f"policy=expert with {override}: it has no forwards; use rollout.latency=constant or measured")
    steps = 1 if target is None else settings.chunk or target.chunk
    if constant and timing.delay_compensation == CHUNK and late >= steps:
        raise UsageError(
            f"rollout.latency_ms={timing.latency_ms:g} with rollout.delay_compensation=chunk: all {steps} control "
            f"steps of a chunk are stale after {late}"
        )


def calibrates(settings: RolloutSettings) -> bool:
    """Whether AR's time on this machine must be measured first."""
    timing = settings.rollout
    return timing.clock == REAL and timing.latency == MEASURED and timing.ar_ms > 0


def profile_identity(settings: RolloutSettings) -> dict[str, str]:
    """Hash of the profile's document, where one is read. Raises UsageError where it is missing."""
    timing = settings.rollout
    if timing.clock != REAL or timing.latency != PROFILE:
        return {}
    return {"profile": sha256_of(_profile_path(settings.results, timing.profile))}


def latency_of(settings: RolloutSettings, target: TargetDescription | None, measured: float) -> Latency:
    """The source of latencies. target: None for the expert. measured: seconds of AR's decode here, where it
    `calibrates`.

    Raises:
        UsageError: a profile that is missing, impossible, or lacks a phase that the method needs.
    """
    timing = settings.rollout
    ar_seconds = timing.ar_ms / 1000.0
    if timing.latency == CONSTANT:
        return lambda decode: timing.latency_ms / 1000.0
    if timing.latency == MEASURED:
        scale = ar_seconds / measured if ar_seconds else 1.0
        return lambda decode: scale * decode.seconds
    assert target is not None
    costs = {part.traits.get("cost") for part in Method.of(settings).parts.values()}
    drafter = (DRAFTING, "feed") if DRAFTING in costs else ()
    profile = _open_profile(settings.results, timing.profile, ("encode", "prefill", "verify", *drafter))
    whole = profile.decode((settings.chunk or target.chunk) * target.actions.dofs)
    if ar_seconds and not whole:
        raise UsageError(f"rollout.profile={timing.profile}: AR takes no time in it: nothing can be in proportion")
    return profiled(profile, ar_seconds / whole if ar_seconds else 1.0)


def profiled(profile: Profile, scale: float = 1.0) -> Latency:
    """The cost model's seconds for a decode's forwards, its host seconds as measured, all times `scale`."""
    return lambda decode: scale * predicted(work_of_record(decode), profile)


def _profile_path(results: str, name: str) -> Path:
    """The document of `rollout.profile`: a path, or a name in <results>/bench."""
    for path in (Path(name).expanduser(), results_dir(results) / "bench" / f"{name}.json"):
        if path.is_file():
            return path
    raise UsageError(f"rollout.profile={name}: no such document of 'kerv bench', neither here nor in {results}/bench")


def _open_profile(results: str, name: str, kinds: Sequence[str]) -> Profile:
    """The profile of that name, which must know these kinds of phases.

    Raises:
        UsageError: no such document, none of a bench, a phase is missing, or a time is negative or no number.
    """
    path = _profile_path(results, name)
    try:
        profile = read_profile(path)
    except CheckpointError as error:
        raise UsageError(f"rollout.profile={name}: {error}") from error
    for kind in kinds:
        rows, seconds = profile.phases.get(kind, ((), ()))
        if not rows or len(rows) != len(seconds):
            raise UsageError(f"rollout.profile={name}: {path} has no phase '{kind}', which this method needs")
        times = all(isinstance(value, int | float) and 0 <= value < math.inf for value in seconds)
        if list(rows) != sorted(set(rows)) or not times:
            raise UsageError(f"rollout.profile={name}: {path} has impossible times of the phase '{kind}'")
    return profile
