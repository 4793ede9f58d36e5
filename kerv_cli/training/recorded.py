"""Recorded observations for any target, and its own decodes of them: the one interface between demonstrations and what
is trained from them.

A demonstration holds frames, states and a task. `observation_at` turns one of its control steps into the observation
that a target gets in an episode, and `Target.encode` does the rest. The compact target has a faster reader, in batches
(`observations.py`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.spaces import Observation, ObservationSpace
from kerv_cli.engine.protocol import Target
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.training.imitation import Samples, load_samples
from kerv_cli.training.observations import Rows, instruction_of, split
from kerv_cli.worlds.demos.dataset import DemoDataset
from kerv_cli.worlds.demos.episode_file import DemoEpisode


def steps_of(target: Target, episode: DemoEpisode) -> np.ndarray:
    """Control steps (n,) whose observation is recorded: those with a frame; without cameras all."""
    return episode.frame_steps if target.cameras else np.arange(episode.steps)


def spread_steps(target: Target, episode: DemoEpisode, count: int) -> np.ndarray:
    """At most `count` of `steps_of`, evenly spread."""
    steps = steps_of(target, episode)
    return steps[np.unique(np.linspace(0, len(steps) - 1, min(count, len(steps))).round().astype(int))]


def observation_at(
    episode: DemoEpisode, step: int, space: ObservationSpace, cameras: Sequence[str], instruction: str
) -> Observation:
    """The observation at a control step of a demonstration. space: the demonstrations'. cameras: names that the target
    gives to the recorded frame.

    Raises:
        CheckpointError: cameras, but no frame of that step.
    """
    images = {}
    if cameras:
        rows = np.flatnonzero(episode.frame_steps == step)
        if not len(rows):
            raise CheckpointError(f"step {step} of {episode.task} {episode.seed} has no frame: record every step")
        images = dict.fromkeys(cameras, episode.frames[rows[0]])
    state = episode.states[step].astype(np.float64)
    return Observation(state[: len(space.proprioception)], state, instruction, images)


def prompts_of(
    target: Target, episode: DemoEpisode, space: ObservationSpace, steps: Sequence[int] | np.ndarray
) -> Iterator[Tensor]:
    """The prompt (1, P, E) of every one of these control steps."""
    instruction = instruction_of(episode.task)
    for step in steps:
        yield target.encode(observation_at(episode, int(step), space, target.cameras, instruction))


@dataclass(frozen=True)
class TeacherStates(Rows):
    """The target's greedy decodes of n observations."""

    prompt: Tensor  # (n, P, E) float16
    hidden: Tensor  # (n, P + N − 1, E) float16
    tokens: Tensor  # (n, N) int64

    def parts(self, indices: Tensor) -> list[TeacherStates]:
        """The rows at `indices` (B,), in batches of one prompt length: here one."""
        return [self.where(indices)]

    def prompts(self, count: int) -> list[Tensor]:
        """At most `count` prompts (1, P, E), evenly spread."""
        chosen = torch.linspace(0, len(self) - 1, min(count, len(self))).long().tolist()
        return [self.prompt[i : i + 1] for i in chosen]


@dataclass(frozen=True)
class StatesByLength:
    """Teacher states whose prompts differ in length: a group per length, rows counted through all groups."""

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
def greedy(target: Target, prompt: Tensor) -> tuple[Tensor, Tensor]:
    """prompt (B, P, E) -> greedy tokens (B, N) and the hidden states (B, P + N − 1, E) that predict them."""
    length, size = prompt.shape[1], target.chunk * target.actions.dofs
    cache = target.new_cache(len(prompt), length + size)
    hidden = [target.forward(prompt, torch.arange(length, device=prompt.device), cache)]
    tokens = [target.head(hidden[0][:, -1]).argmax(-1)]
    for i in range(size - 1):
        position = torch.tensor([length + i], device=prompt.device)
        hidden.append(target.forward(target.embed(tokens[-1][:, None]), position, cache))
        tokens.append(target.head(hidden[-1][:, -1]).argmax(-1))
    return torch.stack(tokens, 1), torch.cat(hidden, 1)


@torch.inference_mode()
def teach(
    target: Target, dataset: DemoDataset, limit: int, held_out: float, on_progress: Callable[[int, int], None]
) -> tuple[TeacherStates | StatesByLength, TeacherStates | StatesByLength]:
    """The target's greedy decodes of about `limit` observations, evenly spread -> (training, held out) by whole
    episodes, as `observations.split` divides them.

    Raises:
        UsageError: a share out of range. CheckpointError: a single episode, or a damaged one.
    """
    if not isinstance(target, CompactTarget):
        return teach_recorded(target, dataset, limit, held_out, on_progress)
    tasks = tuple(dict.fromkeys(e.task for e in dataset.episodes))
    training, validation = split(load_samples(dataset, target.settings, target.words, tasks), held_out)
    states = _in_batches(target, training, limit, on_progress)
    return states, _in_batches(target, validation, max(60, limit // 50), lambda done, total: None)


def _in_batches(
    target: CompactTarget, samples: Samples, limit: int, on_progress: Callable[[int, int], None]
) -> TeacherStates:
    """The decodes of at most `limit` of the samples, evenly spread."""
    chosen = torch.linspace(0, len(samples) - 1, min(limit, len(samples))).long()
    parts = []
    for indices in chosen.split(64):
        prompt, _ = target.encode_batch(samples.inputs(indices, target.device))
        tokens, hidden = greedy(target, prompt)
        parts.append(TeacherStates(prompt.half().cpu(), hidden.half().cpu(), tokens.cpu()))
        on_progress(sum(map(len, parts)), len(chosen))
    return TeacherStates.joined(parts)


@torch.inference_mode()
def teach_recorded(
    target: Target,
    dataset: DemoDataset,
    limit: int,
    held_out: float,
    on_progress: Callable[[int, int], None],
) -> tuple[StatesByLength, StatesByLength]:
    """`teach` for a target of any family, one observation at a time. Prompts of one length lie together."""
    count = len(dataset.episodes)
    if count < 2:
        raise CheckpointError("one demonstration cannot be both trained on and held out: record at least two")
    if not 0 < held_out <= 0.5:
        raise UsageError(f"train.held_out={held_out}: more than 0, at most 0.5")
    every, share = min(max(2, round(1 / held_out)), count), -(-limit // count)
    sides: tuple[dict[int, list[TeacherStates]], ...] = (defaultdict(list), defaultdict(list))
    for index in range(count):
        episode = dataset.load(index)
        chosen = spread_steps(target, episode, share)
        prompts = torch.cat(list(prompts_of(target, episode, dataset.manifest.observation, chosen)))
        tokens, hidden = greedy(target, prompts)
        states = TeacherStates(prompts.half().cpu(), hidden.half().cpu(), tokens.cpu())
        sides[index % every == every - 1][prompts.shape[1]].append(states)
        on_progress(index + 1, count)
    training, validation = (StatesByLength(tuple(map(TeacherStates.joined, side.values()))) for side in sides)
    return training, validation
