"""Certified success (docs/methods.md §4.6, ours): execute drafts without verification on certified tasks.

A certificate states that on its tasks a skip rule loses little of the success of autoregressive decoding (AR).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import number
from kerv_cli.base.registry import PREFILL, ArtifactPart, ProposerPart, SkipPart
from kerv_cli.methods.unverified import StreakSkip, StreakSkipSettings

if TYPE_CHECKING:
    from kerv_cli.engine.parts import Skip
    from kerv_cli.engine.proposer import Proposer
    from kerv_cli.methods.certified.certificate import Certificate
    from kerv_cli.methods.context import Context


@dataclass
class CertifiedSkipSettings:
    """On the certificate's tasks, use the certified skip rule. On other tasks, use a streak.

    A streak executes drafts without verification, as long as verified drafts agree with the target
    (docs/methods.md §4.5).
    """

    kind: str = "certified"
    most: int = number(8, 1)  # on other tasks: maximum number of decodes in a row without verification


@dataclass
class ScopedSettings:
    """On the certificate's tasks, draft with the certified proposer. On other tasks, use another proposer."""

    kind: str = "scoped"
    outside: str = "merged"  # name of the proposer for other tasks

    def check_together(self, prefix: str) -> None:
        """Refuse a proposer for other tasks (setting `outside`) that cannot draft whole chunks before the prefill.

        Raises:
            UsageError: That proposer cannot draft whole chunks before the prefill.
            UnknownName: No proposer has the name in the setting `outside`.
        """
        outside = ProposerPart.find(self.outside, "prefill_draft.outside")
        if not (outside.merged or outside.chains):
            raise UsageError(
                f"prefill_draft.outside={outside.name}: it does not draft whole chunks from the prompt; set "
                "prefill_draft.outside=merged, or a source of merged drafts, e.g. early"
            )


@ArtifactPart("certificate", sees=True, by_task=True, names_more=True, study="certify")
def artifact() -> type:
    """Import and return the class that finds, checks and loads certificates."""
    from kerv_cli.methods.certified.certificate import CertificateArtifact

    return CertificateArtifact


def covering(context: Context) -> Certificate | None:
    """Return the certificate if it covers the decoder's task, else None.

    A decoder has one task, so this is checked once, when the decoder is built.
    """
    certificate: Certificate = context.artifact("certificate")
    return certificate if context.task in certificate.tasks else None


def needs_outside(settings: ScopedSettings) -> tuple[str, ...]:
    """Return the kinds of artifacts needed: the certificate, and those of the proposer for other tasks.

    The certificate itself lists what the certified proposer needs (`CertificateArtifact.needs`).
    """
    outside = ProposerPart.find(settings.outside)
    return "certificate", *outside.needed(outside.default)


@ProposerPart("scoped", ScopedSettings, needs=needs_outside, when=PREFILL, chains=True)
def scoped(settings: ScopedSettings, context: Context) -> Proposer:
    """Build the proposer for the decoder's task.

    It is the certified proposer if the certificate covers the task and certifies a candidate. Otherwise it is the
    proposer that the setting `outside` names.
    """
    certificate = covering(context)
    if certificate is not None and certificate.certified is not None:
        source = certificate.certified.source
    else:
        source = ProposerPart.find(settings.outside).default
    proposer: Proposer = ProposerPart.find(source.kind).built(source, context)
    return proposer


@SkipPart("certified", CertifiedSkipSettings, needs=("certificate",), colour=0x2E8B57, takes_draft=True, merges=True)
def certified(settings: CertifiedSkipSettings, context: Context) -> Skip | None:
    """Build the certified rule on the certificate's tasks, and a streak on other tasks.

    Returns:
        The skip rule. None if the certificate covers the task but certifies no rule. Then every draft is verified.

    Raises:
        UsageError: The method, the number format or the chunk length is not the certified one.
    """
    certificate = covering(context)
    if certificate is None:
        return StreakSkip.build(StreakSkipSettings(most=settings.most), context)
    if certificate.certified is None:
        return None
    certificate.check_method(context.method, str(context.target.dtype).removeprefix("torch."))
    chunk = context.chunk or context.target.chunk
    if chunk != certificate.chunk:
        raise UsageError(f"skip=certified with chunk={chunk}: the certificate is of {certificate.chunk}")
    rule = certificate.certified.rule
    skip: Skip = SkipPart.find(rule.kind).built(rule, context)
    return skip
