"""The certificate of success, and what deploys it (docs/methods.md §4.6, ours).

Decoders are put together for one task, so whether the certificate covers the task is decided there, once, and the parts
that come of it are ordinary ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.manifests import read
from kerv_cli.base.registry import part_of
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.parts import Skip
from kerv_cli.engine.proposer import Proposer
from kerv_cli.methods.artifacts import Artifact, MadeFor, Use
from kerv_cli.methods.certified import CertifiedSkipSettings, ScopedSettings
from kerv_cli.methods.context import Context
from kerv_cli.methods.streak import StreakSkipSettings


@dataclass(frozen=True)
class Candidate:
    """One rule of the fixed order. skip, draft: settings of its skip rule and of its in-prefill draft. pairs: episodes
    paired with AR's on the same seeds, of which AR solved `ar`, the rule `successes`; lost, won: pairs that only one of
    both solved. p: of the hypothesis that the rule loses more than the margin; None: not tested, because one before it
    was not certified."""

    label: str
    skip: dict[str, Any]
    pairs: int
    ar: int
    successes: int
    lost: int
    won: int
    p: float | None
    needed: int = 0  # pairs more that would certify it at these rates; 0: none, −1: never
    draft: dict[str, Any] = field(default_factory=lambda: {"kind": "scout"})  # the only one of the first certificates

    @property
    def rule(self) -> Any:
        """Settings of the skip rule."""
        return _part_settings("skip", self.skip)

    @property
    def source(self) -> Any:
        """Settings of the draft."""
        return _part_settings("prefill_draft", self.draft)


def _part_settings(kind: str, plain: dict[str, Any]) -> Any:
    """Settings of a part from plain values."""
    return read(part_of(kind, plain["kind"]).settings, plain, f"the certificate's {kind}")


@dataclass(frozen=True)
class Certificate:
    """What was certified: over `tasks`, the rule `chosen` (index of `candidates`) loses at most `margin` points of AR's
    success, with confidence 1 − delta.

    drafts: kind -> hash of the artifacts that drafted. method: kind -> settings of the other parts. chunk: H. world:
    camera and horizon. dtype: number format. seeds: the selection seeds, as text.
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
    def certified(self) -> Candidate | None:
        """The boldest rule of those that were certified; None: none was."""
        return None if self.chosen is None else self.candidates[self.chosen]

    def check_method(self, method: Mapping[str, Any], dtype: str) -> None:
        """Refuses a method that decodes otherwise than what was certified. method: kind -> settings of its parts.

        Raises:
            UsageError: the draft, another part or the number format differs; names both values.
        """
        draft = method["prefill_draft"]
        if self.certified is not None and draft.kind != "scoped" and draft != self.certified.source:
            raise UsageError(
                f"skip=certified with prefill_draft={draft.kind}: the certificate is of the draft of "
                f"'{self.certified.label}'; set prefill_draft=scoped"
            )
        for kind, certified in self.method.items():
            used = asdict(method[kind])
            for key in sorted({*certified, *used}, key=lambda key: key != "kind"):
                if certified.get(key) != used.get(key):
                    raise UsageError(
                        f"skip=certified with {kind}.{key}={used.get(key)}: the certificate is of "
                        f"{certified.get(key)}; set that, or run 'kerv calibrate success' anew"
                    )
        if dtype != self.dtype:
            raise UsageError(f"skip=certified with runtime.dtype={dtype}: the certificate is of {self.dtype}")

    def check_world(self, world: Mapping[str, Any]) -> None:
        """Refuses another camera or horizon. A stressed world is not refused: the certificate says nothing of it.

        Raises:
            UsageError: another one; names both values.
        """
        for key, certified in self.world.items():
            if world.get(key) != certified:
                raise UsageError(f"skip=certified with world.{key}={world.get(key)}: the certificate is of {certified}")

    def check_environment(self, name: str) -> None:
        """Refuses to be served with a policy of another environment. Camera and horizon are the client's.

        Raises:
            UsageError: another one; names both.
        """
        if name != self.environment:
            raise UsageError(f"skip=certified with a policy of {name}: the certificate is of {self.environment}")

    def sentence(self) -> str:
        """The certificate in one sentence."""
        chosen = self.certified
        if chosen is None:
            return "nothing is certified: every draft is verified"
        return (
            f"{chosen.label}: not more than {self.margin:g} points below AR on these {len(self.tasks)} instructions, "
            f"{100 * (1 - self.delta):.0f} % confidence, {chosen.pairs} pairs"
        )


class CertificateArtifact(Artifact[Certificate]):
    """`certificate/` beside the target: certificate.json."""

    kind, noun, made, seconds = "certificate", "certificate", "issued", 120.0
    command = ("calibrate", "success")
    schema = Certificate

    def made_for(self, description: Certificate) -> MadeFor:
        """Its target; the chunk is the method's, see `certified`."""
        return MadeFor(description.target, description.actions)

    def sources(self, description: Certificate) -> Mapping[str, str]:
        """The drafters whose drafts were certified."""
        return description.drafts

    def check_use(self, description: Certificate, use: Use) -> None:
        """Refuse another environment, world or, on its tasks, method."""
        description.check_environment(use.environment)
        if use.world is not None:
            description.check_world(use.world)
        if description.certified is not None and not set(use.tasks).isdisjoint(description.tasks):
            description.check_method(use.method, use.dtype)

    def needs(self, description: Certificate) -> tuple[str, ...]:
        """Return what the certified draft reads."""
        if description.certified is None:
            return ()
        source = description.certified.source
        return part_of("prefill_draft", source.kind).needs(source)


def covering(context: Context) -> Certificate | None:
    """The certificate, where it covers the decoder's task."""
    certificate: Certificate = context.artifact("certificate")
    return certificate if context.task in certificate.tasks else None


def scoped(settings: ScopedSettings, context: Context) -> Proposer:
    """prefill_draft=scoped: the draft for the task at hand."""
    certificate = covering(context)
    if certificate is not None and certificate.certified is not None:
        source = certificate.certified.source
    else:
        source = part_of("prefill_draft", settings.outside).default
    return part_of("prefill_draft", source.kind).built(source, context)


def certified(settings: CertifiedSkipSettings, context: Context) -> Skip | None:
    """skip=certified: the certified rule, or a streak outside the certificate."""
    certificate = covering(context)
    if certificate is None:
        return _built(StreakSkipSettings(most=settings.most), context)
    if certificate.certified is None:
        return None
    certificate.check_method(context.method, str(context.target.dtype).removeprefix("torch."))
    chunk = context.chunk or context.target.chunk
    if chunk != certificate.chunk:
        raise UsageError(f"skip=certified with chunk={chunk}: the certificate is of {certificate.chunk}")
    return _built(certificate.certified.rule, context)


def _built(rule: Any, context: Context) -> Skip:
    skip: Skip = part_of("skip", rule.kind).built(rule, context)
    return skip
