"""Recorded observations for any target: the one interface between demonstrations and what is trained from them.

A demonstration holds frames, states and a task. `observation_at` turns one of its control steps into the observation
that a target gets in an episode, and `Target.encode` does the rest. The compact target has a faster reader, in batches
(`observations.py`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.spaces import Observation, ObservationSpace
from kerv_cli.engine.protocol import Target
from kerv_cli.training.distillation import StatesByLength, TeacherStates, greedy
from kerv_cli.training.observations import instruction_of
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


@torch.inference_mode()
def teach_recorded(
    target: Target,
    dataset: DemoDataset,
    limit: int,
    held_out: float,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[StatesByLength, StatesByLength]:
    """The target's greedy decodes of about `limit` observations, spread over all episodes -> (training, held out) by
    whole episodes, as `observations.split` divides them. Prompts of one length lie together.

    Raises:
        UsageError: a share out of range. CheckpointError: a single episode, or a damaged one.
    """
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
