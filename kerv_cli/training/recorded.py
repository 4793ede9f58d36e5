"""Recorded observations for any target, and its own decodes of them: the one interface between demonstrations and what
is trained from a target.

A demonstration holds frames, states and a task. `observations_of` turns its control steps into the observations that a
target gets in an episode, and the target encodes them.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.spaces import Observation, ObservationSpace
from kerv_cli.engine.batched import greedy
from kerv_cli.engine.protocol import EncodesMany, Target
from kerv_cli.training.observations import Rows, check_frames, held_out_every
from kerv_cli.worlds import instruction_of
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.episode_file import DemoEpisode

BATCH = 64
"""Observations that a target encodes and decodes together."""


def steps_of(target: Target, episode: DemoEpisode) -> np.ndarray:
    """Control steps (n,) whose observation is recorded: those with a frame; without cameras all."""
    return episode.frame_steps if target.cameras else np.arange(episode.steps)


def observations_of(
    target: Target, episode: DemoEpisode, steps: np.ndarray, space: ObservationSpace
) -> list[Observation]:
    """The observations at some control steps (n,) of a demonstration, as the target takes them; all its cameras see the
    recorded frame. space: the demonstrations'.

    Raises:
        CheckpointError: cameras, but no frame of one of the steps, or frames of another size than `frame_shape`.
    """
    pictures: list[dict[str, np.ndarray]] = [{} for _ in steps]
    if target.cameras:
        if frame_shape := getattr(target, "frame_shape", None):
            check_frames(episode, frame_shape[0])
        rows = np.searchsorted(episode.frame_steps, steps).clip(max=len(episode.frame_steps) - 1)
        missing = steps[episode.frame_steps[rows] != steps]
        if len(missing):
            raise CheckpointError(f"step {missing[0]} of {episode.task} {episode.seed} has no frame: record every step")
        pictures = [dict.fromkeys(target.cameras, frame) for frame in np.asarray(episode.frames[rows])]
    states, instruction = episode.states[steps].astype(np.float64), instruction_of(episode.task)
    felt = len(space.proprioception)
    return [
        Observation(state[:felt], state, instruction, images) for state, images in zip(states, pictures, strict=True)
    ]


def prompts_of(target: Target, observations: Iterable[Observation], size: int = BATCH) -> Iterator[Tensor]:
    """The prompts (B, P, E) of the observations, in order, at most `size` together and those of one length alone."""
    remaining = iter(observations)
    while batch := list(itertools.islice(remaining, size)):
        if isinstance(target, EncodesMany):
            yield target.encode_many(batch)
            continue
        prompts = (target.encode(observation) for observation in batch)
        yield from (torch.cat(list(equal)) for _, equal in itertools.groupby(prompts, lambda prompt: prompt.shape[1]))


@dataclass(frozen=True)
class TeacherStates(Rows):
    """The target's greedy decodes of n observations whose prompts are equally long."""

    prompt: Tensor  # (n, P, E) float16
    hidden: Tensor  # (n, P + N − 1, E) float16
    tokens: Tensor  # (n, N) int64

    def prompts(self, count: int) -> list[Tensor]:
        """At most `count` prompts (1, P, E), evenly spread."""
        chosen = torch.linspace(0, len(self) - 1, min(count, len(self))).long().tolist()
        return [self.prompt[i : i + 1] for i in chosen]


@dataclass(frozen=True)
class StatesByLength:
    """Teacher states: a group per length of the prompt, rows counted through all groups."""

    groups: tuple[TeacherStates, ...]

    def __len__(self) -> int:
        return sum(map(len, self.groups))

    def parts(self, indices: Tensor) -> list[TeacherStates]:
        """The rows at `indices` (B,), in batches of one prompt length."""
        batches, first = [], 0
        for group in self.groups:
            rows = indices[(indices >= first) & (indices < first + len(group))] - first
            if len(rows):
                batches.append(group.where(rows))
            first += len(group)
        return batches

    def prompts(self, count: int) -> list[Tensor]:
        """About `count` prompts (1, P, E): from every group in proportion to its rows, evenly spread."""
        return [x for group in self.groups for x in group.prompts(max(1, round(count * len(group) / len(self))))]


@torch.inference_mode()
def teach(
    target: Target, dataset: DemoDataset, limit: int, held_out: float, on_progress: OnProgress
) -> tuple[StatesByLength, StatesByLength]:
    """The target's greedy decodes of at most `limit` observations, evenly spread -> (training, held out) by whole
    episodes, as `observations.split` divides them.

    Raises:
        CheckpointError: a single episode, or a damaged one.
    """
    every = held_out_every(len(dataset.episodes), held_out)
    sides: tuple[list[tuple[int, int]], ...] = ([], [])
    for index in range(len(dataset.episodes)):
        sides[index % every == every - 1].extend((index, int(t)) for t in steps_of(target, dataset.load(index)))
    states = _decodes(target, dataset, sides[0], limit, on_progress)
    return states, _decodes(target, dataset, sides[1], max(60, limit // 50), lambda done, total: None)


def _decodes(
    target: Target,
    dataset: DemoDataset,
    rows: Sequence[tuple[int, int]],
    limit: int,
    on_progress: OnProgress,
) -> StatesByLength:
    """The decodes of at most `limit` of the rows, (episode, control step), evenly spread."""
    chosen = [rows[i] for i in torch.linspace(0, len(rows) - 1, min(limit, len(rows))).long().tolist()]
    groups, done = defaultdict[int, list[TeacherStates]](list), 0

    def observations() -> Iterator[Observation]:
        for index, group in itertools.groupby(chosen, lambda row: row[0]):
            steps = np.array([step for _, step in group])
            yield from observations_of(target, dataset.load(index), steps, dataset.manifest.observation)

    for prompt in prompts_of(target, observations()):
        tokens, hidden = greedy(target, prompt)
        groups[prompt.shape[1]].append(TeacherStates(prompt.half().cpu(), hidden.half().cpu(), tokens.cpu()))
        done += len(prompt)
        on_progress(done, len(chosen))
    return StatesByLength(tuple(map(TeacherStates.joined, groups.values())))
