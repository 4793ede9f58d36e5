"""Decodes the observations of several episodes at once, for runs that ask for success and not for times
(docs/measuring.md).

Only methods whose every decode is the same sequence of forwards can be batched: all episodes are through it at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.spaces import ActionSpace, Observation
from kerv_cli.engine.chunk import ActionHistory, Chunk, Situation
from kerv_cli.engine.decoder import Decoder, actions_of, deviation, record_of
from kerv_cli.engine.parts import TakesMany
from kerv_cli.engine.protocol import Cache, EncodesMany, Target
from kerv_cli.engine.record import UNTIMED, DecodeRecord, Round


class Lane:
    """What a batch keeps of one of its episodes: the actions and positions before the next decode."""

    def __init__(self, actions: ActionSpace, cameras: tuple[str, ...]) -> None:
        self.actions, self.cameras = actions, cameras
        self.situation = Situation("", ActionHistory(actions.dofs))
        self.decodes = 0

    def reset(self, task: str, seed: int, end_effector: np.ndarray) -> None:
        """A new episode begins, with the end effector at (3,) metres."""
        self.situation = Situation(task, ActionHistory(self.actions.dofs), [np.asarray(end_effector)])
        self.decodes = 0

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        """An action (D,) was executed; the end effector is now at (3,) metres."""
        self.situation.history.append(self.actions.normalise(action))
        self.situation.path.append(np.asarray(end_effector))

    def finish(self, success: bool) -> None:
        """The episode ended."""


class BatchDecoder:
    """Decodes one chunk for each of several episodes with the target and parts of a decoder.

    In float32 its tokens are those of the decoder, but for ties that another order of summation rounds differently.
    Its records have no times.
    """

    def __init__(self, decoder: Decoder, deviation_every: int = 0) -> None:
        """decoder: of a method that `Method.check` accepts for a batch. deviation_every: as in RolloutSettings."""
        self.decoder, self.target, self.every = decoder, decoder.target, deviation_every
        self.limits = decoder.acceptance.limits(decoder.threshold.radius())
        self.skip = decoder.parts.skip
        self._caches: dict[int, Cache] = {}

    def lane(self) -> Lane:
        """The state of one more episode of the batch."""
        return Lane(self.target.actions, self.target.cameras)

    @torch.inference_mode()
    def decode(self, lanes: Sequence[Lane], observations: Sequence[Observation]) -> list[DecodeRecord]:
        """One observation of each lane -> its actions and their record."""
        prompts: list[Tensor] = []

        def encode(i: int) -> Tensor:  # the first that asks has all of them encoded
            prompts.extend(() if prompts else self._prompts(observations))
            return prompts[i]

        steps, space, cache = self.decoder.steps, self.target.actions, self.decoder.cache
        chunks = [
            Chunk(partial(encode, i), steps, space, cache, lane.situation, self.limits, observation=observations[i])
            for i, lane in enumerate(lanes)
        ]
        self._complete(chunks)
        records = [self._record(chunk) for chunk in chunks]
        samples = []
        for i, lane in enumerate(lanes):
            lane.decodes += 1
            if self.every and lane.decodes % self.every == 0:
                samples.append(i)
        decoded = [[]] * len(samples) if self.skip is None else self._tokens([chunks[i] for i in samples])
        for i, tokens in zip(samples, decoded, strict=True):
            gap = deviation(space, records[i].actions, actions_of(space, tokens)) if tokens else 0.0
            records[i] = replace(records[i], deviation=gap)
        return records

    def _prompts(self, observations: Sequence[Observation]) -> list[Tensor]:
        """The prompts (1, P, E). On a CPU one by one: packed weights encode one image after the other as fast as eight
        together, and faster than more of them."""
        if isinstance(self.target, EncodesMany) and self.target.device.type != "cpu":
            return list(self.target.encode_many(observations).split(1))
        return [self.target.encode(observation) for observation in observations]

    def _complete(self, chunks: Sequence[Chunk]) -> None:
        """Commits all tokens of every chunk, a round for each token that the target decodes."""
        if isinstance(self.skip, TakesMany):
            self.skip.take_many(chunks, self._cache)
            return
        for chunk, tokens in zip(chunks, self._tokens(chunks), strict=True):
            for start, token in enumerate(tokens):
                mode = "decode" if start else "prefill"
                chunk.commit(Round(mode, "none", start, (), (token,), 0, 1, 0, ()), [token])

    def _tokens(self, chunks: Sequence[Chunk]) -> list[list[int]]:
        """The N tokens of each chunk, decoded one by one; prompts of one length run together, so that none is
        padded."""
        rows: dict[int, list[int]] = {}
        for length in dict.fromkeys(chunk.prompt_length for chunk in chunks):
            group = [i for i, chunk in enumerate(chunks) if chunk.prompt_length == length]
            prompt = torch.cat([chunks[i].prompt for i in group])
            tokens, _ = greedy(self.target, prompt, self._cache(len(group)), self._size)
            rows |= zip(group, tokens.tolist(), strict=True)
        return [rows[i] for i in range(len(chunks))]

    def _record(self, chunk: Chunk) -> DecodeRecord:
        actions, predicted = self.decoder.actions_of(chunk)
        return record_of(chunk, actions, math.nan, dict(UNTIMED), predicted)

    @property
    def _size(self) -> int:
        return self.decoder.steps * self.target.actions.dofs

    def _cache(self, rows: int) -> Cache:
        """An empty cache of so many rows. Only the latest size stays allocated, as episodes end one by one."""
        if rows not in self._caches:
            self._caches = {rows: self.target.new_cache(rows, self.target.max_prompt + self._size)}
        self._caches[rows].length = 0
        return self._caches[rows]


@torch.inference_mode()
def greedy(target: Target, prompt: Tensor, cache: Cache | None = None, size: int = 0) -> tuple[Tensor, Tensor]:
    """prompt (B, P, E) -> greedy tokens (B, N) and the hidden states (B, P + N − 1, E) that predict them. cache: an
    empty one with room for them. size: N; 0: of the target's chunk."""
    length, size = prompt.shape[1], size or target.chunk * target.actions.dofs
    cache = cache or target.new_cache(len(prompt), length + size)
    hidden = [target.forward(prompt, torch.arange(length, device=prompt.device), cache)]
    tokens = [target.head(hidden[0][:, -1]).argmax(-1)]
    for at in range(length, length + size - 1):
        position = torch.tensor([at], device=prompt.device)
        hidden.append(target.forward(target.embed(tokens[-1][:, None]), position, cache))
        tokens.append(target.head(hidden[-1][:, -1]).argmax(-1))
    return torch.stack(tokens, 1), torch.cat(hidden, 1)
