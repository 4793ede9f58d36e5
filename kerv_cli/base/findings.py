"""Results of checks, for `kerv doctor`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from kerv_cli.base.errors import KervError


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    what: str
    ok: bool
    says: str


class Failed(Exception):
    """A check failed; the message says what was expected and what came."""


def run(checks: Iterable[tuple[str, Callable[[], str]]]) -> list[Finding]:
    """Runs checks in order -> one finding each. A check returns what it saw; `Failed`, a KervError and any exception of
    the code under test make it fail, and the next one runs."""
    findings = []
    for what, check in checks:
        try:
            findings.append(Finding(what, True, check()))
        except (Failed, KervError) as error:
            findings.append(Finding(what, False, str(error)))
        except Exception as error:  # noqa: BLE001 - the code under test is anybody's
            findings.append(
                Finding(what, False, f"raises {type(error).__name__}: {' '.join(str(error).split())[:200]}")
            )
    return findings
