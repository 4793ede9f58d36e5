"""Success, certified (docs/methods.md §4.6, ours): trust drafts on the tasks that a certificate covers."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import number
from kerv_cli.base.registry import PREFILL, add, find, part_of


@dataclass
class CertifiedSkipSettings:
    """The rule that the certificate names on its tasks; elsewhere a streak of at most `most` (§4.5)."""

    kind: str = "certified"
    most: int = number(8, 1)


@dataclass
class ScopedSettings:
    """The draft that the certificate names on its tasks; elsewhere another one."""

    kind: str = "scoped"
    outside: str = "merged"

    def check_together(self, prefix: str) -> None:
        """Refuse a draft for other tasks that cannot draft whole chunks before the prefill."""
        outside = find("proposer", self.outside, "prefill_draft.outside")
        if not (outside.traits.get("merged") or outside.traits.get("chains")):
            raise UsageError(
                f"prefill_draft.outside={outside.name}: it does not draft whole chunks from the prompt; set "
                "prefill_draft.outside=merged, or a source of merged drafts, e.g. early"
            )


def _needs(settings: ScopedSettings) -> tuple[str, ...]:
    """Return the certificate, which names what its own draft reads, and what the other draft reads."""
    outside = part_of("prefill_draft", settings.outside)
    return "certificate", *outside.needs(outside.default)


_CERTIFICATE = "kerv_cli.methods.certified.certificate:"

add(
    "artifact",
    "certificate",
    _CERTIFICATE + "CertificateArtifact",
    sees=True,
    by_task=True,
    names_more=True,
    study="certify",
)
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
