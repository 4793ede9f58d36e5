"""Errors that kerv raises deliberately. The command line prints each as one line and exits with its code."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any


class KervError(Exception):
    """A failure while a command ran. The message is one line: what is wrong, where, what to type."""

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled, (type(self), str(self))  # so that workers can send any subclass, whatever its arguments


def _unpickled(kind: type[KervError], message: str) -> KervError:
    return kind.__new__(kind, message)


class UsageError(KervError):
    """The user asked for something impossible. `key` is the name of the wrong setting, if any."""

    exit_code = 2
    key = ""

    def __init__(self, message: str, key: str = "") -> None:
        super().__init__(message)
        self.key = key


_LISTED = 24  # names that a message lists


class UnknownName(UsageError):
    """A name does not exist. The message suggests similar names, else lists up to 24 known ones, and adds `remedy`."""

    def __init__(self, kind: str, name: str, names: Iterable[str], remedy: str = "") -> None:
        names = list(names)
        more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
        hint = did_you_mean(name, names) or (f"known: {', '.join(names[:_LISTED])}{more}" if names else "there is none")
        super().__init__(f"unknown {kind} '{name}': {hint}{remedy}", kind)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    names = {one.lower(): one for one in known}
    near = [names[one] for one in difflib.get_close_matches(name.lower(), names)]
    return f"did you mean {' or '.join(near)}?" if near else ""


class Interrupted(KervError):
    """The user pressed Ctrl-C. The message says what is kept and how to continue."""

    exit_code = 130


def is_of_an_interrupt(error: BaseException | None) -> bool:
    """Return whether Ctrl-C caused an error. Libraries can replace a KeyboardInterrupt by an error of their own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


class EpisodeError(KervError):
    """One episode failed, for example because a server answered wrongly. The setting's other episodes go on."""


class RenderingUnavailable(KervError):
    """No OpenGL backend of this machine can draw a frame."""


class CheckpointError(KervError):
    """A stored file (checkpoint, drafter, dataset or manifest) is missing, damaged or does not fit other files."""


class StorageError(KervError):
    """Writing failed: the disk is full or read-only, or permission is missing."""
