"""How long something takes, in the words of plans."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """Whole minutes; seconds below two of them."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def left(seconds: float, done: float, total: float) -> str:
    """The time left where `done` of `total` took so many seconds, e.g. `about 3 min left`."""
    return f"about {duration(seconds * (total / done - 1))} left"


def about(seconds: float, source: str = "a guess") -> str:
    """An estimate and where it comes from, e.g. `about 96 min (a guess)`."""
    return f"about {duration(seconds)} ({source})"
