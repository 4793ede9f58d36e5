"""Certified success (docs/methods.md §4.6, ours): execute drafts without verification on certified tasks.

A certificate states that on its tasks a skip rule loses little of the success of autoregressive decoding (AR).
"""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import number
from kerv_cli.base.registry import PREFILL, add, find, part_of


@dataclass
class CertifiedSkipSettings:
    """On the certificate's tasks, use its skip rule. On other tasks, use a streak.

    A streak executes drafts without verification, as long as verified drafts agree with the target
    (docs/methods.md §4.5).
    """

    kind: str = "certified"
    most: int = number(8, 1)  # on other tasks: maximum number of decodes in a row without verification


@dataclass
class ScopedSettings:
    """On the certificate's tasks, draft with the certified proposer. On other tasks, draft with `outside`."""

    kind: str = "scoped"
    outside: str = "merged"  # prefill draft on other tasks

    def check_together(self, prefix: str) -> None:
        """Refuse a proposer `outside` that cannot draft whole chunks before the prefill.

        Raises:
            UsageError: `outside` cannot draft whole chunks before the prefill.
            UnknownName: No proposer has the name `outside`.
        """
        outside = find("proposer", self.outside, "prefill_draft.outside")
        if not (outside.traits.get("merged") or outside.traits.get("chains")):
            raise UsageError(
                f"prefill_draft.outside={outside.name}: it does not draft whole chunks from the prompt; set "
                "prefill_draft.outside=merged, or a source of merged drafts, e.g. early"
            )


def _needs(settings: ScopedSettings) -> tuple[str, ...]:
    """Return the kinds of artifacts needed: the certificate, and what the proposer for other tasks (`outside`) needs.

    The certificate itself lists what the certified proposer needs (`CertificateArtifact.needs`).
    """
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
