"""Run checks for `kerv doctor` and collect their results."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from kerv_cli.base.errors import KervError


@dataclass(frozen=True)
class Finding:
    """Result of one check. `says` is what the check saw, or the error message."""

    what: str
    ok: bool
    says: str


def need(holds: object, message: str) -> None:
    if not holds:
        raise KervError(message)


def find(what: str, check: Callable[[], str]) -> Finding:
    """Run a check, which returns what it saw. Any exception makes it fail."""
    try:
        return Finding(what, True, check())
    except Exception as error:  # noqa: BLE001 - the code under test is anybody's
        raised = f"raises {type(error).__name__}: {' '.join(str(error).split())[:200]}"
        return Finding(what, False, str(error) if isinstance(error, KervError) else raised)
