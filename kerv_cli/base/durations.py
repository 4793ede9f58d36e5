"""Format durations and counts as text, for plans and progress."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """Return a duration as text: `90 s` below two minutes, else whole minutes as in `5 min`."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def left(seconds: float, done: float, total: float) -> str:
    """Estimate the remaining time, as in `about 3 min left`.

    Args:
        seconds: Time that the work took so far.
        done: Number of finished units of work, above 0.
        total: Number of all units of work.
    """
    return f"about {duration(seconds * (total / done - 1))} left"


def about(seconds: float, source: str = "a guess") -> str:
    """Return an estimated duration and where it comes from, as in `about 96 min (a guess)`."""
    return f"about {duration(seconds)} ({source})"


def count(number: int, noun: str) -> str:
    """Return a number and a noun in singular or plural: `1 task`, `2 tasks`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
