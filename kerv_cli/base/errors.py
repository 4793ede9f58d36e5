"""Errors that kerv raises deliberately. The command line prints each as one line and exits with its code."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any


class KervError(Exception):
    """A failure while a command ran. The message is one line: what is wrong, where, what to type."""

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled, (type(self), str(self))  # worker processes hand it on, whatever arguments its class takes


def _unpickled(kind: type[KervError], message: str) -> KervError:
    return kind.__new__(kind, message)


class UsageError(KervError):
    """The request itself is wrong: unknown name, wrong key, impossible value.

    Args:
        message: One line.
        key: The dotted setting that is wrong, if the message is about one.
    """

    exit_code = 2
    key = ""

    def __init__(self, message: str, key: str = "") -> None:
        super().__init__(message)
        self.key = key


class UnknownName(UsageError):
    """A name that nothing has. The message names the nearest ones."""

    def __init__(self, kind: str, name: str, names: Iterable[str]) -> None:
        names = list(names)
        hint = did_you_mean(name, names) or f"known: {', '.join(names)}"
        super().__init__(f"unknown {kind} '{name}': {hint}", kind)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return `did you mean a or b?` with at most three known names that look alike, or an empty string."""
    names = {one.lower(): one for one in known}
    near = [names[one] for one in difflib.get_close_matches(name.lower(), names)]
    return f"did you mean {' or '.join(near)}?" if near else ""


class Interrupted(KervError):
    """Ctrl-C. The message says what is kept and that the same command goes on."""

    exit_code = 130


class RenderingUnavailable(KervError):
    """No OpenGL backend can draw a frame here."""


class CheckpointError(KervError):
    """A checkpoint, drafter, dataset or manifest is missing, damaged or belongs to something else."""


class StorageError(KervError):
    """Writing failed: the disk is full or read-only, or permission is missing."""
