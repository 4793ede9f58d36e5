"""Format durations and counts as text, for plans and progress."""

from __future__ import annotations


def duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def left(seconds: float, done: float, total: float) -> str:
    return f"about {duration(seconds * (total / done - 1))} left"


def about(seconds: float, source: str = "a guess") -> str:
    return f"about {duration(seconds)} ({source})"


def count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
