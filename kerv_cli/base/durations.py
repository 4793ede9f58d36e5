"""Durations and numbers as text, for plans and progress."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """Return whole minutes; below two minutes, seconds."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def left(seconds: float, done: float, total: float) -> str:
    """Return the time left after `done` of `total` took so many seconds: `about 3 min left`."""
    return f"about {duration(seconds * (total / done - 1))} left"


def about(seconds: float, source: str = "a guess") -> str:
    """Return an estimate and its source: `about 96 min (a guess)`."""
    return f"about {duration(seconds)} ({source})"


def count(number: int, noun: str) -> str:
    """Return a number with its noun: `1 task`, `2 tasks`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
