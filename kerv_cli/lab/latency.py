"""The latency of a decode in a world that does not wait: as measured, constant, or by a latency profile of another
model and device (docs/methods.md §8)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.files import sha256_of
from kerv_cli.base.places import results_dir
from kerv_cli.engine.cost import Profile, predicted, read_profile, sequence_of_record
from kerv_cli.engine.record import DecodeRecord

FORWARDS = ("encode", "prefill", "verify")
DRAFTER = ("draft", "feed")


class Latency(Protocol):
    """Seconds that a decode lasts."""

    def seconds(self, decode: DecodeRecord) -> float:
        """From its observation to its first action."""


@dataclass(frozen=True)
class Measured:
    """The decode's own inference time, times `scale`."""

    scale: float = 1.0

    def seconds(self, decode: DecodeRecord) -> float:
        """As `Latency.seconds`."""
        return self.scale * decode.seconds


@dataclass(frozen=True)
class Constant:
    """A constant latency of every decode, seconds."""

    latency: float

    def seconds(self, decode: DecodeRecord) -> float:
        """As `Latency.seconds`."""
        return self.latency


@dataclass(frozen=True)
class Profiled:
    """The cost model's seconds for the decode's forwards, its host seconds as measured, all times `scale`."""

    profile: Profile
    scale: float = 1.0

    def seconds(self, decode: DecodeRecord) -> float:
        """As `Latency.seconds`."""
        return self.scale * predicted(sequence_of_record(decode), self.profile)


def steps_of(seconds: float, control_hz: float) -> int:
    """A latency in control steps, rounded up; float noise of a whole number of steps does not count.

    Raises:
        KervError: it is negative or not finite.
    """
    if not 0 <= seconds < math.inf:
        raise KervError(f"a decode cannot last {seconds} seconds: the latency's source is wrong")
    return math.ceil(round(seconds * control_hz, 6))


def profile_path(results: str, name: str) -> Path:
    """The document of `rollout.profile`: a path, or a name in <results>/bench.

    Raises:
        UsageError: there is none.
    """
    for path in (Path(name).expanduser(), results_dir(results) / "bench" / f"{name}.json"):
        if path.is_file():
            return path
    raise UsageError(f"rollout.profile={name}: no such document of 'kerv bench', neither here nor in {results}/bench")


def profile_hash(results: str, name: str) -> str:
    """SHA-256 of a profile's document; raises as `profile_path`."""
    return sha256_of(profile_path(results, name))


def open_profile(results: str, name: str, kinds: Sequence[str]) -> Profile:
    """The profile of that name, which must know these kinds of phases.

    Raises:
        UsageError: no such document, none of a bench, a phase is missing, or a time is negative or no number.
    """
    path = profile_path(results, name)
    try:
        profile = read_profile(path)
    except CheckpointError as error:
        raise UsageError(f"rollout.profile={name}: {error}") from error
    for kind in kinds:
        rows, seconds = profile.phases.get(kind, ((), ()))
        if not rows or len(rows) != len(seconds):
            raise UsageError(f"rollout.profile={name}: {path} has no phase '{kind}', which this method needs")
        if list(rows) != sorted(set(rows)) or not all(_is_time(value) for value in seconds):
            raise UsageError(f"rollout.profile={name}: {path} has impossible times of the phase '{kind}'")
    return profile


def _is_time(value: object) -> bool:
    return isinstance(value, int | float) and 0 <= value < math.inf
