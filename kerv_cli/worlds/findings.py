"""Run checks for `kerv doctor` and collect their results."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from kerv_cli.base.errors import KervError


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes:
        what: What was checked.
        ok: Whether the check passed.
        says: What the check saw, or the error message.
    """

    what: str
    ok: bool
    says: str


def need(holds: object, message: str) -> None:
    """Raise a KervError with this message if `holds` is false."""
    if not holds:
        raise KervError(message)


def find(what: str, check: Callable[[], str]) -> Finding:
    """Run a check. It fails if it raises any exception.

    Args:
        what: What is checked.
        check: Function that runs the check. It returns a text that describes the result.
    """
    try:
        return Finding(what, True, check())
    except Exception as error:  # noqa: BLE001 - the code under test is anybody's
        raised = f"raises {type(error).__name__}: {' '.join(str(error).split())[:200]}"
        return Finding(what, False, str(error) if isinstance(error, KervError) else raised)
