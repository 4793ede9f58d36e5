"""The errors that kerv raises deliberately. The command line prints one line for each and exits with its code."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from kerv_cli.base.near import nearest, question


class KervError(Exception):
    """A failure while a command ran. The message names cause, place and remedy in one line."""

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled, (type(self), str(self))  # worker processes hand it on, whatever arguments its class takes


def _unpickled(kind: type[KervError], message: str) -> KervError:
    return kind.__new__(kind, message)


class UsageError(KervError):
    """The request itself is wrong: unknown name, wrong key, impossible value."""

    exit_code = 2


_GATE = (
    "the calibrated gate is gone, commit 72e42ef is the last with it: method=one_pass_streak needs no calibration and "
    "was nowhere shown to be slower per episode; 'kerv calibrate success' certifies success instead (docs/methods.md)"
)
GONE = {
    ("calibrate", "risk"): _GATE,
    ("method", "one_pass_risk"): _GATE,
    ("skip", "risk"): _GATE,
    ("study", "risk_h8"): _GATE,
    ("study", "scores"): _GATE,
    ("train command", "score"): _GATE,
}
"""Kind and name of what an older kerv had -> what replaces it; of a command its name and the next word."""


class UnknownName(UsageError):
    """A name that no registry knows; the message lists the nearest ones, or says what replaces it. more: behind
    them, in brackets."""

    def __init__(self, kind: str, name: str, names: Iterable[str], more: str = "") -> None:
        names = list(names)
        hint = question(nearest(name, names)) or f"known: {', '.join(names)}"
        gone = GONE.get((kind.split(".")[0], name))
        hint = f"{hint} ({more})" if more else hint
        super().__init__(f"{kind} '{name}': {gone}" if gone else f"unknown {kind} '{name}': {hint}")


class Interrupted(KervError):
    """Ctrl-C. The message says what is kept and from where the same command goes on."""

    exit_code = 130


class RenderingUnavailable(KervError):
    """No OpenGL backend can draw a frame here."""


class CheckpointError(KervError):
    """A checkpoint, drafter, dataset or manifest is missing, damaged or belongs to something else."""


class StorageError(KervError):
    """Writing failed: the disk is full or read-only, or permission is missing."""
