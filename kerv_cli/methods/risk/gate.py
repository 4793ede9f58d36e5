"""Risk-controlled verification: a calibrated gate with its audits (docs/methods.md §4.6, ours)."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from kerv_cli.base.registry import NoSettings, find
from kerv_cli.base.settings import LOSS_SCALE
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.loss import chunk_loss, executed_loss, judged_tokens
from kerv_cli.engine.parts import Skip
from kerv_cli.engine.proposer import DraftsChunks
from kerv_cli.engine.record import ALARM, AUDIT, DOUBT, GATE, NO_DRAFT, OPENING, TRUSTED, Trust
from kerv_cli.methods.context import Context
from kerv_cli.methods.heisd.rules import retrieval_of
from kerv_cli.methods.merged.proposer import first_source
from kerv_cli.methods.risk import RiskSkipSettings
from kerv_cli.methods.risk.alarm import Audit
from kerv_cli.methods.risk.recording import RiskRecording, decoding_of
from kerv_cli.methods.risk.scores import Draft, Score


def episode_numbers(purpose: str, task: str, seed: int) -> np.random.Generator:
    """Generator of an episode for one purpose; depends on purpose, task and seed alone."""
    digest = hashlib.sha256(f"{purpose} {task} {seed}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8]))


class RiskSkip(Skip):
    """Executes drafts unverified where their score reaches the certified level, and audits a random share of them.

    An episode's first `opening` decodes are verified, and so is everything after an alarm, until the audit ends it. A
    verified draft with a loss of `doubt` or more, for whatever reason it was verified, is followed by another
    verification, so that trust does not outlast what contradicts it.
    level: least score that is trusted. scale: ε_a, normalised action units, of the loss. alarm: evidence at which the
    alarm is raised; None: 1/δ.
    """

    def __init__(
        self,
        settings: RiskSkipSettings,
        source: DraftsChunks,
        score: Score,
        level: float,
        scale: float,
        alarm: float | None = None,
    ) -> None:
        self.settings, self.source, self.score, self.level, self.scale = settings, source, score, level, scale
        self.audit = Audit(settings.epsilon, settings.delta, alarm)
        self.chain: tuple[int, ...] = ()  # the source's draft of this chunk
        self.decodes = 0  # of this episode
        self.suspicious = False  # the last decode was verified with a loss of `doubt` or more
        self.random = np.random.default_rng(0)

    @classmethod
    def build(cls, settings: RiskSkipSettings, context: Context) -> RiskSkip:
        """skip=risk.

        Raises:
            CheckpointError: the recording does not know the source or the score, was decoded otherwise, or is too small
                to certify anything.
        """
        draft = context.built["prefill_draft"]
        source = retrieval_of(context) if draft is None else first_source(draft)
        score = find("score", settings.score).built(NoSettings(settings.score), context)
        if settings.level is not None:
            return cls(settings, source, score, settings.level, LOSS_SCALE)
        recording: RiskRecording = context.artifact("risk")
        recording.check_decoding(decoding_of(context.method, context.chunk, context.target))
        recording.check_size(source.name, settings.epsilon, settings.delta)
        level = recording.certified(source.name, settings.score, settings.epsilon, settings.delta).level
        alarm = recording.alarm_level(source.name, settings, level)
        return cls(settings, source, score, level, recording.manifest.scale, alarm)

    def begin(self, task: str, seed: int) -> None:
        """An episode begins. Which decodes are audited depends on task and seed alone."""
        self.random = episode_numbers("audit", task, seed)
        self.audit.reset()
        self.decodes, self.suspicious = 0, False

    def take(self, chunk: Chunk) -> bool:
        """Fills the chunk with the source's draft if it is trusted and not audited -> whether it did."""
        chains = self.source.chains(chunk, chunk.size)
        self.chain = tuple(chains[0]) if chains and len(chains[0]) == chunk.size else ()
        score = self.score.of(Draft(chunk, self.source, self.chain)) if self.chain else -np.inf
        chunk.trust = Trust(score, self.level, self._reason(score), alarm=self.audit.alarm)
        self.decodes += 1
        if chunk.trust.reason != TRUSTED:
            return False
        chunk.skip(self.chain, self.source.name)
        return True

    def _reason(self, score: float) -> str:
        """Why this draft is verified, or TRUSTED. A random number is drawn for every decode, so that the audits of an
        episode do not depend on its scores."""
        audit = self.random.random() < self.settings.audit
        if not self.chain:
            return NO_DRAFT
        if self.audit.alarm:
            return ALARM
        if score < self.level:
            return GATE
        if self.decodes < self.settings.opening:
            return OPENING
        if self.suspicious:
            return DOUBT
        return AUDIT if audit else TRUSTED

    def verified(self, chunk: Chunk) -> None:
        """The prefill verified the chunk: adds the loss, where the first verification judged this very draft."""
        targets = judged_tokens(chunk, self.chain) if self.chain else None
        if targets is not None:
            self._judge(chunk, chunk_loss(chunk.space, self.chain[: len(targets)], targets, self.scale))

    def completed(self, chunk: Chunk) -> None:
        """The chunk is complete: adds the loss of a draft that no verification judged, against the chunk's actions."""
        if self.chain and chunk.trust is not None and chunk.trust.loss is None:
            self._judge(chunk, executed_loss(chunk, self.chain, self.scale))

    def _judge(self, chunk: Chunk, loss: float) -> None:
        trust = chunk.trust
        assert trust is not None
        chunk.trust = replace(trust, loss=loss)
        self.suspicious = loss >= self.settings.doubt
        if trust.score >= self.level:  # the gate would have trusted it: this is what the certificate speaks of
            self.audit.add(loss)
            if self.audit.alarm and not trust.alarm:
                chunk.trust = replace(chunk.trust, alarm=True)
