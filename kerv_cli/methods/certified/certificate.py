"""The certificate of success: what a test of skip rules found, and the file that records it (docs/methods.md §4.6)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from kerv_cli.base.durations import count
from kerv_cli.base.errors import UsageError
from kerv_cli.base.manifests import read
from kerv_cli.base.registry import part_of
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.methods.artifacts import Artifact, MadeFor, Use


@dataclass(frozen=True)
class Candidate:
    """A skip rule and its draft, tested against autoregressive decoding (AR) for a certificate.

    The test compares pairs of episodes with the same seed: one episode by the candidate, one by AR. Candidates are
    tested in a fixed order, until one fails.

    Attributes:
        label: Name of the candidate.
        skip: Settings of the skip rule.
        pairs: Number of pairs of episodes.
        ar: Number of episodes that AR solved.
        successes: Number of episodes that the candidate solved.
        lost: Number of pairs that only AR solved.
        won: Number of pairs that only the candidate solved.
        p: p-value of the hypothesis that the candidate loses the margin or more. None if it was not tested, because an
            earlier candidate failed or AR solved too few episodes.
        draft: Settings of the proposer whose drafts the rule executes. Old certificates do not store these settings.
            All their drafts came from the scout, a drafter that reads the image itself.
    """

    label: str
    skip: dict[str, Any]
    pairs: int = 0
    ar: int = 0
    successes: int = 0
    lost: int = 0
    won: int = 0
    p: float | None = None
    draft: dict[str, Any] = field(default_factory=lambda: {"kind": "scout"})

    @property
    def rule(self) -> Any:
        """Settings of the skip rule, as an instance of the rule's dataclass."""
        return _part_settings("skip", self.skip)

    @property
    def source(self) -> Any:
        """Settings of the proposer that drafts before the prefill. The skip rule executes this proposer's drafts."""
        return _part_settings("prefill_draft", self.draft)


def _part_settings(kind: str, plain: dict[str, Any]) -> Any:
    return read(part_of(kind, plain["kind"]).settings, plain, f"the certificate's {kind}")


@dataclass(frozen=True)
class Attempt:
    """Summary of one test of a policy. Each certificate lists the policy's earlier tests.

    Attributes:
        made: Time of the test, ISO 8601. Empty if not recorded.
        test: Hash of the test's set-up: `Certificate.test`.
        order: Labels of the candidates in the order of the tests.
        seeds: Seeds of the episodes, as text such as `1000-1049;1100`.
        margin: Percentage points of success that may be lost.
        delta: Level of the test: an upper bound of the probability that the test certifies falsely.
        pairs: Number of pairs of episodes.
        certified: Label of the last candidate in `order` that was certified. Empty if no candidate was certified.
    """

    made: str
    test: str
    order: list[str]
    seeds: str
    margin: float
    delta: float
    pairs: int
    certified: str

    @property
    def seeds_served(self) -> set[int]:
        """Seeds of the test's episodes, as numbers."""
        seeds: set[int] = set()
        for part in self.seeds.split(";"):
            first, _, last = part.partition("-")
            seeds.update(range(int(first), int(last or first) + 1))
        return seeds


@dataclass(frozen=True)
class Certificate:
    """A certificate states that on `tasks` the chosen candidate loses at most `margin` points of AR's success.

    Attributes:
        target: Hash of the target's weights.
        actions: Action space of the target.
        chunk: Number of control steps per chunk.
        environment: Name of the environment.
        tasks: Full names of the tasks.
        drafts: Hashes of the artifacts that made the drafts, by kind.
        method: Settings of the method's parts, by kind. Prefill draft and skip rule are in `candidates` instead.
        world: Camera and horizon (maximum episode length).
        dtype: Number format of the models.
        margin: Percentage points of success that may be lost.
        delta: Level of this test: an upper bound of the probability that the test certifies falsely.
        seeds: Seeds of the test episodes, as text such as `1000-1049;1100`.
        candidates: All candidates in the order of the tests, from cautious to bold.
        chosen: Index of the last, and so the boldest, certified candidate. None if no candidate was certified.
        provenance: How the certificate was made.
        made: Time of the test, ISO 8601. Empty in certificates of older versions.
        earlier: All earlier tests of the same policy, oldest first.
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
    made: str = ""
    earlier: list[Attempt] = field(default_factory=list)

    @property
    def is_tested(self) -> bool:
        """Whether any candidate was tested. No candidate is tested if AR solved too few episodes."""
        return any(one.p is not None for one in self.candidates)

    @property
    def test(self) -> str:
        """Hash of the test's set-up: tasks, seeds, margin, drafts, method, chunk, world, dtype and candidates.

        Results and delta are left out, so a repeated test has the same hash.
        """
        names = ("tasks", "seeds", "margin", "drafts", "method", "chunk", "world", "dtype")
        order = [(one.label, one.skip, one.draft) for one in self.candidates]
        text = json.dumps([*(getattr(self, name) for name in names), order], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def attempt(self) -> Attempt:
        """Summary of this test, for the list in later certificates."""
        return Attempt(
            self.made,
            self.test,
            [one.label for one in self.candidates],
            self.seeds,
            self.margin,
            self.delta,
            self.candidates[0].pairs,
            self.certified.label if self.certified else "",
        )

    @property
    def certified(self) -> Candidate | None:
        """The boldest certified candidate. None if no candidate was certified."""
        return None if self.chosen is None else self.candidates[self.chosen]

    def check_method(self, method: Mapping[str, Any], dtype: str) -> None:
        """Refuse a method that decodes differently from the certified method.

        Args:
            method: Settings of the method's parts, by kind.
            dtype: Number format of the models.

        Raises:
            UsageError: The draft, another part or the number format differs. The message names both values.
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
        """Return what the certificate states, as one sentence for the user."""
        chosen = self.certified
        first, tests = self.candidates[0], len(self.earlier) + 1
        if not self.is_tested:
            return (
                f"nothing is certified: AR solved {first.ar} of {first.pairs} episodes, and a certificate needs half "
                "of them. Train the policy further"
            )
        if chosen is None:
            return "nothing is certified: every draft is verified"
        # upper bound of the probability that this test, or any earlier test of this policy, certified falsely
        risk = self.delta + sum(one.delta for one in self.earlier)
        instructions = count(len(self.tasks), "instruction")
        return (
            f"{chosen.label}: not more than {self.margin:g} points below AR on these {instructions}, "
            f"{100 * (1 - risk):g} % confidence, {chosen.pairs} pairs"
            + (f"; the confidence is that of all {tests} tests of this policy" if tests > 1 else "")
        )


class CertificateArtifact(Artifact[Certificate]):
    """Finds, checks and loads certificates. A certificate is a folder with a single JSON file."""

    kind, noun, made = "certificate", "certificate", "issued"
    command = ("calibrate", "success")
    schema = Certificate

    def made_for(self, description: Certificate) -> MadeFor:
        """Return hash and action space of the certified target. The chunk length is checked when a decoder is built."""
        return MadeFor(description.target, description.actions)

    def sources(self, description: Certificate) -> Mapping[str, str]:
        """Return the hashes of the drafters whose drafts were certified, by kind."""
        return description.drafts

    def check_use(self, description: Certificate, use: Use) -> None:
        """Refuse an environment, camera or horizon that was not certified.

        If any task is one of the certificate's tasks, also refuse a method that decodes differently from the certified
        method (see `Certificate.check_method`). On other tasks, and if no candidate was certified, every method is
        allowed. A stressed world is allowed, although the certificate says nothing about stress.

        Raises:
            UsageError: The use differs from the certified one. The message names both values.
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
        """Return the kinds of artifacts that the certified draft needs. Empty if no candidate was certified."""
        if description.certified is None:
            return ()
        source = description.certified.source
        return part_of("prefill_draft", source.kind).needed(source)
