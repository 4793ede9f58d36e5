"""Risk-controlled verification: a calibrated gate and its audit (docs/methods.md §4.6, ours)."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from kerv_cli.engine.chunk import Chunk, DraftsChunks
from kerv_cli.engine.loss import chunk_loss, executed_loss, judged_tokens
from kerv_cli.engine.record import ALARM, AUDIT, DOUBT, GATE, NO_DRAFT, OPENING, TRUSTED, Trust
from kerv_cli.methods.audit import Audit
from kerv_cli.methods.parts import RiskSkipSettings
from kerv_cli.methods.scores import Draft, Score
from kerv_cli.methods.verify_skip import Skip


def episode_numbers(purpose: str, task: str, seed: int) -> np.random.Generator:
    """Generator of an episode for one purpose; depends on purpose, task and seed alone."""
    digest = hashlib.sha256(f"{purpose} {task} {seed}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8]))


class RiskSkip(Skip):
    """Executes drafts unverified where their score reaches the certified level, and audits a random share of them.

    An episode's first `opening` decodes are verified, and so is everything after an alarm, until the audit ends it. A
    verified draft with a loss of `doubt` or more, for whatever reason it was verified, is followed by another
    verification, so that trust does not outlast what contradicts it.
    level: least score that is trusted. scale: ε_a, normalised action units, of the loss.
    """

    def __init__(
        self, settings: RiskSkipSettings, source: DraftsChunks, score: Score, level: float, scale: float
    ) -> None:
        self.settings, self.source, self.score, self.level, self.scale = settings, source, score, level, scale
        self.audit = Audit(settings.epsilon, settings.delta)
        self.chain: tuple[int, ...] = ()  # the source's draft of this chunk
        self.decodes = 0  # of this episode
        self.suspicious = False  # the last decode was verified with a loss of `doubt` or more
        self.random = np.random.default_rng(0)

    def begin(self, task: str, seed: int) -> None:
        """As `Skip.begin`: which decodes are audited depends on task and seed alone."""
        self.random = episode_numbers("audit", task, seed)
        self.audit.reset()
        self.decodes, self.suspicious = 0, False

    def take(self, chunk: Chunk) -> bool:
        """As `Skip.take`."""
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
        drawn = self.random.random() < self.settings.audit
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
        return AUDIT if drawn else TRUSTED

    def verified(self, chunk: Chunk) -> None:
        """As `Skip.verified`: the loss, where the first verification judged this very draft."""
        wanted = judged_tokens(chunk, self.chain) if self.chain else None
        if wanted is not None:
            self._judge(chunk, chunk_loss(chunk.space, self.chain[: len(wanted)], wanted, self.scale))

    def completed(self, chunk: Chunk) -> None:
        """As `Skip.completed`: the loss against what is executed, for drafts that were not judged along their path."""
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
