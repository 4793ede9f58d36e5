"""The clock of a world that goes on while the policy decodes (docs/methods.md §8).

The latency of a decode can come from a profile: a file of `kerv bench` with the seconds that each phase of a decode
(encode, prefill, verify, …) takes on some machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.files import sha256_of
from kerv_cli.base.paths import results_dir
from kerv_cli.base.registry import DRAFTING
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.cost import Profile, prices, read_profile, work_of_record
from kerv_cli.engine.record import DecodeRecord, Delay
from kerv_cli.episodes.settings import CONSTANT, MEASURED, PROFILE, REAL, RolloutSettings
from kerv_cli.methods.compose import Method
from kerv_cli.worlds.spec import EnvironmentSpec

if TYPE_CHECKING:
    from kerv_cli.targets.checkpoint import TargetDescription

CHUNK = "chunk"
"""Value of `rollout.delay_compensation`: do not execute actions of a new chunk that are already too old."""

Latency = Callable[[DecodeRecord], float]
"""Function that takes a decode's record and returns the seconds from its observation to its first action."""


def steps_during(seconds: float, control_hz: float) -> int:
    """Convert a latency to control steps, rounded up. Rounding errors just above a whole number are ignored.

    Args:
        seconds: The latency.
        control_hz: Control steps per second.

    Raises:
        KervError: The latency is negative or not finite.
    """
    if not 0 <= seconds < math.inf:
        raise KervError(f"the latency of a decode is {seconds} seconds, which cannot be")
    return math.ceil(round(seconds * control_hz, 6))


class RealClock:
    """Tells an episode how long each decode takes, and which of its actions are too old by then.

    Attributes:
        expected: Number of control steps that the next decode will probably take: as many as the last decode took.
    """

    def __init__(self, latency: Latency, space: ActionSpace, compensation: str = "none") -> None:
        self.latency, self.space, self.compensation = latency, space, compensation
        self.expected = 0

    def delay(self, decode: DecodeRecord, observed: int) -> Delay:
        """Return how long a decode takes in control steps, and how many of its actions are then too old to execute.

        Args:
            decode: Record of the decode.
            observed: Control step at which its observation was taken.

        Raises:
            KervError: The latency is negative or not finite.
        """
        seconds = self.latency(decode)
        steps = self.expected = steps_during(seconds, self.space.control_hz)
        stale = min(steps, len(decode.actions) - 1) if self.compensation == CHUNK else 0
        return Delay(seconds, steps, observed, dropped=stale)


def check(settings: RolloutSettings, spec: EnvironmentSpec, target: TargetDescription | None) -> dict[str, str]:
    """Refuse settings of the clock that cannot work.

    Args:
        settings: The rollout's settings.
        spec: The environment.
        target: The policy's description; None for the expert.

    Returns:
        `{"profile": HASH}` with the SHA-256 of the profile that the rollout reads; empty if it reads none.

    Raises:
        UsageError: An episode would end before its first action, or all actions of a chunk are too old when they
            arrive. Or the profile is missing, damaged, or lacks a phase that the method needs. Or the policy is the
            expert, for which a profile has no latencies.
    """
    timing = settings.rollout
    if timing.clock != REAL:
        return {}
    if target is not None:
        latency_of(settings, target)
    elif timing.latency == PROFILE:
        raise UsageError(
            "policy=expert with rollout.latency=profile: it has no forwards; use rollout.latency=constant or measured"
        )
    if timing.latency != CONSTANT:
        return {"profile": sha256_of(_profile_path(settings))} if timing.latency == PROFILE else {}
    late = steps_during(timing.latency_ms / 1000.0, spec.actions.control_hz)
    horizon = spec.control_steps(settings.world.horizon)
    if late >= horizon:
        raise UsageError(
            f"rollout.latency_ms={timing.latency_ms:g}: {late} control steps, but an episode of {spec.name} has "
            f"{horizon}"
        )
    steps = 1 if target is None else settings.chunk or target.chunk
    if timing.delay_compensation == CHUNK and late >= steps:
        raise UsageError(
            f"rollout.latency_ms={timing.latency_ms:g} with rollout.delay_compensation=chunk: all {steps} control "
            f"steps of a chunk are stale after {late}"
        )
    return {}


def latency_of(settings: RolloutSettings, target: TargetDescription | None) -> Latency:
    """Return a function that takes the record of a decode and returns its latency in seconds.

    `rollout.latency` chooses the source: a constant, the measured time, or a profile.

    Args:
        settings: The rollout's settings.
        target: The policy's description; None for the expert.

    Raises:
        UsageError: The profile is missing or damaged, or it lacks a phase that the method needs.
    """
    timing = settings.rollout
    if timing.latency == CONSTANT:
        return lambda decode: timing.latency_ms / 1000.0
    if timing.latency == MEASURED:
        return lambda decode: decode.seconds
    assert target is not None
    profile, ar_seconds = _open_profile(settings), timing.ar_ms / 1000.0
    whole = profile.decode((settings.chunk or target.chunk) * target.actions.dofs)
    if ar_seconds and not whole:
        raise UsageError(f"rollout.profile={timing.profile}: its AR decode takes no time; leave out rollout.ar_ms")
    return profiled(profile, ar_seconds / whole if ar_seconds else 1.0)


def profiled(profile: Profile, scale: float = 1.0) -> Latency:
    """Return a function that computes the latency of a decode from the costs in `profile`, multiplied by `scale`."""
    return lambda decode: scale * float(prices(work_of_record(decode), profile)[0])


def _profile_path(settings: RolloutSettings) -> Path:
    """Return the path of `rollout.profile`, which is a file or a name in <results>/bench."""
    name, results = settings.rollout.profile, settings.results
    for path in (Path(name).expanduser(), results_dir(results) / "bench" / f"{name}.json"):
        if path.is_file():
            return path
    raise UsageError(f"rollout.profile={name}: no such document, nor in {results}/bench: 'kerv bench' writes one")


def _open_profile(settings: RolloutSettings) -> Profile:
    """Read the rollout's latency profile, and check that it has all phases of the method."""
    path, name = _profile_path(settings), settings.rollout.profile
    try:
        profile = read_profile(path)
    except CheckpointError as error:
        raise UsageError(f"rollout.profile={name}: {error}") from error
    method = Method.of(settings)
    costs = method.prefill_draft.cost, method.proposer.cost
    drafter = (DRAFTING, "feed") if DRAFTING in costs else ()
    if lacks := profile.lacks(("encode", "prefill", "verify", *drafter)):
        raise UsageError(f"rollout.profile={name}: {path} has no phase '{lacks[0]}', which this method needs")
    return profile
