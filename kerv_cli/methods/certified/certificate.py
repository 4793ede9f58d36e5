"""The certificate of success, and the parts that apply it (docs/methods.md §4.6, ours).

A decoder is built for one task. So whether the certificate covers the task is decided once, when it is built.
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
    """One rule of the fixed order.

    Attributes:
        skip: Settings of its skip rule.
        draft: Settings of its in-prefill draft.
        pairs: Episodes paired with AR's on the same seeds.
        ar: Those that AR solved.
        successes: Those that the rule solved.
        lost: Those that only AR solved.
        won: Those that only the rule solved.
        p: Of the hypothesis that the rule loses more than the margin. None if an earlier rule was not certified.
        needed: About how many more pairs would certify it; 0: none, −1: never.
    """

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
    return read(part_of(kind, plain["kind"]).settings, plain, f"the certificate's {kind}")


@dataclass(frozen=True)
class Certificate:
    """What was certified: on `tasks`, the rule `chosen` loses at most `margin` points of AR's success.

    Attributes:
        chunk: H.
        drafts: Kind -> hash of the artifacts that drafted.
        method: Kind -> settings of the other parts.
        world: Camera and horizon.
        dtype: Number format.
        delta: 1 − the confidence.
        seeds: The selection seeds, as text.
        candidates: The rules in their order.
        chosen: Index of the certified rule; None if there is none.
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
        """The boldest certified rule; None if none was certified."""
        return None if self.chosen is None else self.candidates[self.chosen]

    def check_method(self, method: Mapping[str, Any], dtype: str) -> None:
        """Refuse a method that decodes differently from the certified one.

        Args:
            method: Kind -> settings of its parts.
            dtype: Number format.

        Raises:
            UsageError: The draft, another part or the number format differs; the message names both values.
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
                        f"{certified.get(key)}; set that, or run 'kerv calibrate success' again"
                    )
        if dtype != self.dtype:
            raise UsageError(f"skip=certified with runtime.dtype={dtype}: the certificate is of {self.dtype}")

    def sentence(self) -> str:
        """Return the certificate in one sentence."""
        chosen = self.certified
        if chosen is None:
            return "nothing is certified: every draft is verified"
        return (
            f"{chosen.label}: not more than {self.margin:g} points below AR on these {len(self.tasks)} instructions, "
            f"{100 * (1 - self.delta):.0f} % confidence, {chosen.pairs} pairs"
        )


class CertificateArtifact(Artifact[Certificate]):
    """The certificate's single file."""

    kind, noun, made = "certificate", "certificate", "issued"
    command = ("calibrate", "success")
    schema = Certificate

    def made_for(self, description: Certificate) -> MadeFor:
        """Return its target. Its chunk is checked with the method."""
        return MadeFor(description.target, description.actions)

    def sources(self, description: Certificate) -> Mapping[str, str]:
        """Return the drafters whose drafts were certified."""
        return description.drafts

    def check_use(self, description: Certificate, use: Use) -> None:
        """Refuse another environment, camera or horizon and, on its tasks, another method.

        A stressed world is allowed: the certificate says nothing about stress.
        """
        if use.environment != description.environment:
            raise UsageError(
                f"skip=certified with a policy of {use.environment}: the certificate is of {description.environment}"
            )
        world = use.world or description.world
        for key, certified in description.world.items():
            if world.get(key) != certified:
                raise UsageError(f"skip=certified with world.{key}={world.get(key)}: the certificate is of {certified}")
        if description.certified is not None and not set(use.tasks).isdisjoint(description.tasks):
            description.check_method(use.method, use.dtype)

    def needs(self, description: Certificate) -> tuple[str, ...]:
        """Return what the certified draft reads."""
        if description.certified is None:
            return ()
        source = description.certified.source
        return part_of("prefill_draft", source.kind).needs(source)


def covering(context: Context) -> Certificate | None:
    """Return the certificate if it covers the decoder's task."""
    certificate: Certificate = context.artifact("certificate")
    return certificate if context.task in certificate.tasks else None


def scoped(settings: ScopedSettings, context: Context) -> Proposer:
    """Build prefill_draft=scoped: the draft for the task at hand."""
    certificate = covering(context)
    if certificate is not None and certificate.certified is not None:
        source = certificate.certified.source
    else:
        source = part_of("prefill_draft", settings.outside).default
    return part_of("prefill_draft", source.kind).built(source, context)


def certified(settings: CertifiedSkipSettings, context: Context) -> Skip | None:
    """Build skip=certified: the certified rule, or a streak on other tasks."""
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
