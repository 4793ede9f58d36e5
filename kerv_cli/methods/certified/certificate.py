"""The certificate of success, and what deploys it (docs/methods.md §4.7, ours).

Decoders are put together for one task, so whether the certificate covers the task is decided there, once, and the parts
that come of it are ordinary ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.manifests import read
from kerv_cli.base.registry import part_of
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.parts import Skip
from kerv_cli.engine.proposer import Proposer
from kerv_cli.methods.artifacts import Artifact, MadeFor, Request
from kerv_cli.methods.certified import CertifiedSkipSettings, ScopedSettings
from kerv_cli.methods.context import Context
from kerv_cli.methods.streak import StreakSkipSettings


@dataclass(frozen=True)
class Candidate:
    """One rule of the fixed order. skip: its settings. pairs: episodes paired with AR's on the same seeds, of which AR
    solved `ar`, the rule `successes`; lost, won: pairs that only one of both solved. p: of the hypothesis that the rule
    loses more than the margin; None: not tested, because one before it was not shown."""

    label: str
    skip: dict[str, Any]
    pairs: int
    ar: int
    successes: int
    lost: int
    won: int
    p: float | None


@dataclass(frozen=True)
class Certificate:
    """What was certified: over `tasks`, the rule `chosen` (index of `candidates`) loses at most `margin` points of AR's
    success, with confidence 1 − delta.

    drafts: kind -> hash of the artifacts that drafted. method: kind -> settings of the other parts. chunk: H. world:
    camera, horizon. dtype: number format. seeds: the selection seeds, as text.
    """

    target: str
    actions: ActionSpace
    chunk: int
    environment: str
    tasks: list[str]
    drafts: dict[str, str]
    method: dict[str, dict[str, Any]]
    world: dict[str, Any]
    dtype: str
    margin: float
    delta: float
    seeds: str
    candidates: list[Candidate]
    chosen: int | None
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def rule(self) -> Any:
        """Settings of the certified skip rule; those of `none` where nothing was certified, or verifying always was."""
        plain = {"kind": "none"} if self.chosen is None else self.candidates[self.chosen].skip
        return read(part_of("skip", plain["kind"]).settings, plain, "the certificate's rule")

    def sentence(self) -> str:
        """What it says."""
        if self.chosen is None:
            return "nothing is certified: every draft is verified"
        chosen = self.candidates[self.chosen]
        return (
            f"{chosen.label}: not more than {self.margin:g} points below AR on these {len(self.tasks)} instructions, "
            f"{100 * (1 - self.delta):.0f} % confidence, {chosen.pairs} pairs"
        )


class CertificateArtifact(Artifact[Certificate]):
    """`certificate/` beside the target: certificate.json."""

    kind, noun, made, again, schema = (
        "certificate",
        "certificate",
        "issued",
        "run 'kerv calibrate success'",
        Certificate,
    )

    def load(self, place: Any, request: Request) -> Certificate:
        """See `Artifact.load`."""
        return self.checked(place, request.description)

    def made_for(self, description: Certificate) -> MadeFor:
        """See `Artifact.made_for`."""
        return MadeFor(description.target, description.actions)

    def sources(self, description: Certificate) -> Mapping[str, str]:
        """The drafters whose drafts were certified."""
        return description.drafts


def scoped(settings: ScopedSettings, context: Context) -> Proposer:
    """prefill_draft=scoped: the source for the task at hand."""
    inside = context.task in context.artifact("certificate").tasks
    part = part_of("prefill_draft", settings.inside if inside else settings.outside)
    proposer: Proposer = part.built(part.settings(kind=part.name), context)
    return proposer


def certified(settings: CertifiedSkipSettings, context: Context) -> Skip | None:
    """skip=certified: the certified rule, or a streak outside the certificate."""
    certificate: Certificate = context.artifact("certificate")
    inside = context.task in certificate.tasks
    rule = certificate.rule if inside else StreakSkipSettings(most=settings.most)
    if inside and context.target.chunk != certificate.chunk:
        raise UsageError(f"skip=certified: its certificate is of chunks of {certificate.chunk} steps")
    skip: Skip | None = part_of("skip", rule.kind).built(rule, context)
    return skip
