"""Decode the observations of several episodes at once, for runs that measure success but no times.

Only methods that never verify a draft can be batched (docs/measuring.md).

Shapes: B prompts, P prompt tokens, N tokens of a chunk, E width of the target's embeddings and hidden states.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.chunk import Chunk, Follower, TargetSide
from kerv_cli.engine.decoder import Decoder
from kerv_cli.engine.protocol import Cache, EncodesMany, Target
from kerv_cli.engine.record import UNTIMED, DecodeRecord


class BatchDecoder:
    """Decodes one chunk for each of several episodes, with the target and the method of a decoder.

    In float32 it decodes the same tokens as `Decoder`, unless two logits are equal up to rounding. The records have no
    times.
    """

    def __init__(self, decoder: Decoder) -> None:
        """Use the target and the method of `decoder`. `Method.check` tests whether the method can be batched."""
        self.decoder, self.target = decoder, decoder.target
        self.limits = decoder.acceptance.limits(decoder.threshold.radius())
        self.skip, self.size = decoder.parts.skip, decoder.target.actions.longest(decoder.steps)
        self._caches: dict[int, Cache] = {}

    def new_episode(self) -> Follower:
        """Return a `Follower` for one more episode of the batch.

        A `Follower` stores the actions and the positions of the hand during one episode. This one is still empty.
        """
        return Follower(self.target.actions, self.target.cameras)

    @torch.inference_mode()
    def decode(self, episodes: Sequence[Follower], observations: Sequence[Observation]) -> list[DecodeRecord]:
        """Decode one observation per episode. Return one record per episode, with the actions to execute."""
        prompts = functools.cache(lambda: self._encode(observations))  # encoded only if some part reads a prompt
        steps, space, cache = self.decoder.steps, self.target.actions, self.decoder.cache
        chunks = []
        for i, episode in enumerate(episodes):
            target = TargetSide(lambda i=i: prompts()[i], cache)  # type: ignore[misc]
            chunk = Chunk(steps, space, episode.situation, target, self.limits, observation=observations[i])
            if self.skip is not None:
                cache.length = 0
                chunk.take(self.skip.take(chunk))
            chunks.append(chunk)
        groups: dict[int, list[Chunk]] = {}  # chunks with equally long prompts are decoded together, unpadded
        for chunk in chunks:
            if chunk.remaining:
                groups.setdefault(chunk.target.prompt_length, []).append(chunk)
        for group in groups.values():
            prompt = torch.cat([chunk.target.prompt for chunk in group])
            decoded, _ = greedy(self.target, prompt, self._cache(len(group)), self.size)
            for chunk, tokens in zip(group, decoded.tolist(), strict=True):
                for token in chunk.until_end(tokens):
                    chunk.commit_token(token)
        for chunk in chunks:
            chunk.situation.last[:] = chunk.tokens
        similarity = self.decoder.parts.similarity
        return [chunk.record(chunk.actions(), math.nan, dict(UNTIMED), similarity(chunk)) for chunk in chunks]

    def _encode(self, observations: Sequence[Observation]) -> list[Tensor]:
        """Return each prompt's embeddings (1, P, E).

        On a CPU the observations are encoded one by one, because kerv's compiled encoders are faster that way.
        """
        if isinstance(self.target, EncodesMany) and self.target.device.type != "cpu":
            return list(self.target.encode_many(observations).split(1))
        return list(map(self.target.encode, observations))

    def _cache(self, rows: int) -> Cache:
        """Return an empty cache for `rows` sequences.

        The last cache is used again if it has this number of sequences. Otherwise a new cache replaces it. The number
        of sequences often changes, and keeping a cache for each number would fill the memory.
        """
        if rows not in self._caches:
            self._caches = {rows: self.target.new_cache(rows, self.target.max_prompt + self.size)}
        self._caches[rows].length = 0
        return self._caches[rows]


@torch.inference_mode()
def greedy(target: Target, prompt: Tensor, cache: Cache | None = None, size: int = 0) -> tuple[Tensor, Tensor]:
    """Decode a batch of prompts autoregressively.

    Args:
        target: The policy.
        prompt: The prompts' embeddings (B, P, E).
        cache: An empty cache with room for P + N tokens. If None, a new cache is made.
        size: N, number of tokens to decode. If 0, the largest number that a chunk of the target can have.

    Returns:
        Two tensors. The decoded tokens (B, N), which after an end token are all end tokens. The hidden states
        (B, P + N − 1, E) of the prompt and of all decoded tokens but the last.
    """
    length, size = prompt.shape[1], size or target.actions.longest(target.chunk)
    cache = cache or target.new_cache(len(prompt), length + size)
    positions = torch.arange(length + size - 1, device=prompt.device)
    hidden = [target.forward(prompt, positions[:length], cache)]
    tokens = [target.head(hidden[0][:, -1]).argmax(-1)]
    for position in positions[length:].split(1):
        hidden.append(target.forward(target.embed(tokens[-1][:, None]), position, cache))
        tokens.append(target.head(hidden[-1][:, -1]).argmax(-1))
    found, end = torch.stack(tokens, 1), target.actions.end
    if end is not None:
        is_end = (found == end).long()
        found = found.masked_fill(is_end.cumsum(1) > is_end, end)
    return found, torch.cat(hidden, 1)
