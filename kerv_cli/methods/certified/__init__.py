"""Success, certified (docs/methods.md §4.7, ours): trusts drafts on the tasks that a certificate covers. Settings and
registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from kerv_cli.base.limits import number
from kerv_cli.base.registry import PREFILL, add, part_of


@dataclass
class CertifiedSkipSettings:
    """On the certificate's tasks the rule that it certifies; elsewhere a streak of at most `most` (§4.5)."""

    kind: str = "certified"
    most: int = number(8, 1)


@dataclass
class ScopedSettings:
    """Drafts by whether the certificate covers the task."""

    kind: str = "scoped"
    inside: str = "scout"
    outside: str = "merged"


def _needs(settings: Any) -> tuple[str, ...]:
    """The certificate, and what both sources read."""
    sources = (part_of("prefill_draft", name) for name in (settings.inside, settings.outside))
    return "certificate", *(need for part in sources for need in part.needs(part.default))


_CERTIFICATE = "kerv_cli.methods.certified.certificate:"

add("artifact", "certificate", _CERTIFICATE + "CertificateArtifact")
add("proposer", "scoped", _CERTIFICATE + "scoped", ScopedSettings, _needs, when=PREFILL, chains=True)
add(
    "skip",
    "certified",
    _CERTIFICATE + "certified",
    CertifiedSkipSettings,
    needs=("certificate",),
    colour=0x2E8B57,
    takes_draft=True,
    merges=True,
)
