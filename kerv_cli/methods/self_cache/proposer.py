"""Drafts from a decoder's past: every verified chunk is kept with a key of its scene, and the chunk of the nearest key
is the next draft (docs/methods.md §5.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.engine.record import Round
from kerv_cli.methods.context import Context
from kerv_cli.methods.heisd.datastore import prompt_key
from kerv_cli.methods.self_cache import SelfCacheSettings

KEY = ("scene", "proprioception")
"""Parts of the prompt that a key is made of, where the target's prompt has them."""


class Chunks:
    """The newest `most` verified chunks of a task: keys (m, d) float32 of length 1, and N tokens of each."""

    def __init__(self, most: int) -> None:
        self.most, self.episodes = most, 0
        self.keys, self.tokens = np.zeros((0, 0), np.float32), list[list[int]]()

    def add(self, keys: list[np.ndarray], tokens: list[list[int]]) -> None:
        """Keeps an episode."""
        self.episodes += 1
        if keys:
            earlier = [self.keys] if len(self.keys) else []
            self.keys = np.concatenate([*earlier, np.stack(keys)])[-self.most :]
            self.tokens = [*self.tokens, *tokens][-self.most :]

    def nearest(self, key: np.ndarray) -> list[int]:
        """The tokens of the nearest key; none where there is none."""
        return self.tokens[int(np.argmax(self.keys @ key))] if len(self.keys) else []


class SelfCacheProposer(ChainProposer):
    """The nearest verified chunk of earlier episodes; the present episode is kept when it ends."""

    name = "self_cache"

    def __init__(self, settings: SelfCacheSettings, target: ReadableTarget) -> None:
        self.settings, self.target = settings, target
        self.segments = [name for name in KEY if name in target.segments] or list(target.segments)
        self.tasks: dict[str, Chunks] = {}  # by full name
        self.present: list[tuple[np.ndarray, Chunk]] = []  # keys and chunks of the present episode
        self._drafted: tuple[Chunk, list[int]] | None = None

    @classmethod
    def build(cls, settings: SelfCacheSettings, context: Context) -> SelfCacheProposer:
        """proposer=self_cache."""
        return cls(settings, context.target)

    def reset(self) -> None:
        """An episode begins; nothing is kept of one before it that did not end, as a warm-up."""
        self.present = []

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """The nearest chunk's tokens behind the committed ones; nothing before `least` episodes of the task."""
        if self._drafted is None or self._drafted[0] is not chunk:
            self._drafted = chunk, self._draft(chunk)
        rest = self._drafted[1][len(chunk.tokens) : chunk.size][:depth]
        return [rest] if rest else []

    def _draft(self, chunk: Chunk) -> list[int]:
        key = prompt_key(chunk.prompt, self.target, self.segments)[0]
        self.present.append((key, chunk))
        kept = self.tasks.get(chunk.situation.task)
        return kept.nearest(key) if kept is not None and kept.episodes >= self.settings.least else []

    def finish(self, success: bool) -> None:
        """Keeps what the target decoded in the episode, whole chunks only."""
        if not self.present:
            return
        task = self.present[0][1].situation.task
        decoded = [(key, target_tokens(chunk.rounds), chunk.size) for key, chunk in self.present]
        whole = [(key, tokens) for key, tokens, size in decoded if len(tokens) == size]
        kept = self.tasks.setdefault(task, Chunks(self.settings.most))
        kept.add([key for key, _ in whole], [tokens for _, tokens in whole])
        self.present = []


def target_tokens(rounds: Sequence[Round]) -> list[int]:
    """The target's own tokens at the committed places of a chunk's rounds: fewer than the chunk has where some were
    never verified."""
    return [token for record in rounds if record.mode != "skip" for token in record.target_tokens[: record.committed]]
