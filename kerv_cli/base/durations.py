"""How long something takes, in the words of plans."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """Whole minutes; seconds below two of them."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def about(seconds: float, source: str = "a guess") -> str:
    """An estimate and where it comes from, e.g. `about 96 min (a guess)`."""
    return f"about {duration(seconds)} ({source})"
