"""Read demonstrations as observations: for training a compact target in batches, or as any target sees them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.spaces import Observation, ObservationSpace
from kerv_cli.engine.protocol import EncodesMany, Target
from kerv_cli.targets.compact.settings import TargetSettings
from kerv_cli.targets.compact.target import Inputs
from kerv_cli.targets.compact.text import WordTokenizer
from kerv_cli.worlds import instruction_of
from kerv_cli.worlds.demos.episode_file import DemoEpisode
from kerv_cli.worlds.demos.frames import EncodedFrames

BATCH = 64
"""Observations that a target encodes and decodes together."""


@dataclass(frozen=True)
class Rows:
    """Base of dataclasses with one row per sample: tensors, encoded frames, or None for frames that are not seen."""

    def __len__(self) -> int:
        return next(len(x) for x in vars(self).values() if x is not None)

    def where(self, chosen: Tensor) -> Self:
        """Return the rows that a mask (n,) or indices select."""
        return type(self)(*(None if x is None else x[chosen] for x in vars(self).values()))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return all rows of `parts`, in order."""
        return cls(*(_joined([getattr(part, field.name) for part in parts]) for field in fields(cls)))


def _joined(column: list[Any]) -> Any:
    if isinstance(column[0], EncodedFrames):
        return EncodedFrames.joined(column)
    return None if column[0] is None else torch.cat(column)


@dataclass(frozen=True)
class Observations(Rows):
    """n observations, in the order of episodes and control steps."""

    frames: EncodedFrames | None  # (n, size, size x views, 3) uint8; None for a state policy
    proprioception: Tensor  # (n, p) float32
    states: Tensor  # (n, s) float32, privileged
    words: Tensor  # (n, L) int64
    steps: Tensor  # (n,) int64, control steps since the start of the episode

    def inputs(self, indices: Tensor, device: torch.device) -> Inputs:
        """Return the observations at `indices` (B,) as a batch on `device`."""
        images = None
        if self.frames is not None:
            images = torch.from_numpy(self.frames[indices].pixels()).to(device).permute(0, 3, 1, 2)
        return Inputs(images, *(x[indices].to(device) for x in (self.proprioception, self.states, self.words)))


def read_observations(
    episode: DemoEpisode,
    settings: TargetSettings,
    space: ObservationSpace,
    words: WordTokenizer,
    chosen: slice | np.ndarray = slice(None),
) -> Observations:
    """Return the observations of an episode from which a compact policy learns.

    Args:
        episode: A stored episode.
        settings: Shapes of the policy. One that sees gets the steps with a frame, another every step.
        space: Observation space of the demonstrations.
        words: The policy's vocabulary.
        chosen: Which of the observations; by default all.

    Raises:
        CheckpointError: Frames of another size than the policy takes.
    """
    sees, frames = settings.observation == "vision", None
    steps = steps_of(episode, sees)[chosen]
    if sees:
        check_frames(episode, settings.image_size)
        assert isinstance(episode.frames, EncodedFrames)
        frames = episode.frames[chosen]
    states = torch.from_numpy(episode.states[steps]).float()
    ids = torch.tensor([words.encode(instruction_of(episode.task), settings.instruction_tokens)])
    proprioception = states[:, : len(space.proprioception)]
    return Observations(frames, proprioception, states, ids.repeat(len(steps), 1), torch.from_numpy(steps))


def read_chunks(episode: DemoEpisode, steps: np.ndarray, chunk: int) -> np.ndarray:
    """Return (n, H, D) float32: the expert's next H = `chunk` clean actions from each of `steps` (n,) on.

    A chunk that begins near the end takes labels that were recorded after the success.

    Raises:
        CheckpointError: Too few of them were recorded.
    """
    check_tail(episode, chunk, f"chunks of {chunk}")
    return np.stack([episode.labels[t : t + chunk] for t in steps])


def steps_of(episode: DemoEpisode, sees: bool) -> np.ndarray:
    """Return the control steps (n,) with a recorded observation: for a policy that sees, those with a frame."""
    return episode.frame_steps if sees else np.arange(episode.steps)


def observations_of(
    target: Target, episode: DemoEpisode, steps: np.ndarray, space: ObservationSpace
) -> list[Observation]:
    """Return the observations at control steps (n,) of a demonstration; all cameras see the recorded frame.

    Args:
        target: Its cameras and, if it has one, its `frame_shape` decide what is read.
        episode: The demonstration.
        steps: Control steps (n,).
        space: Observation space of the demonstrations.

    Raises:
        CheckpointError: A step without a frame, or frames of another size.
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
    count = len(space.proprioception)
    return [
        Observation(state[:count], state, instruction, images) for state, images in zip(states, pictures, strict=True)
    ]


def prompts_of(target: Target, observations: Iterable[Observation], size: int = BATCH) -> Iterator[Tensor]:
    """Yield the prompts (B, P, E) of the observations in order, at most `size` of one length together."""
    remaining = iter(observations)
    while batch := list(itertools.islice(remaining, size)):
        if isinstance(target, EncodesMany):
            yield target.encode_many(batch)
            continue
        prompts = (target.encode(observation) for observation in batch)
        yield from (torch.cat(list(equal)) for _, equal in itertools.groupby(prompts, lambda prompt: prompt.shape[1]))


def check_tail(episode: DemoEpisode, steps: int, use: str) -> None:
    """Refuse an episode with fewer than `steps` labels from its last control step on.

    Raises:
        CheckpointError: Too few labels were recorded after the success; the message names their `use`.
    """
    tail = len(episode.labels) - episode.steps
    if tail < steps - 1:
        raise CheckpointError(
            f"the demonstrations have {tail} labels after an episode's end, {use} need {steps - 1}: "
            "record them again with a longer tail"
        )


def check_frames(episode: DemoEpisode, size: int) -> None:
    """Refuse frames that are not views of the policy's size in pixels, side by side.

    Raises:
        CheckpointError: They are not.
    """
    height, width = episode.frames.shape[1:3]
    if height != size or width % size:
        raise CheckpointError(
            f"the demonstrations' frames have {height} x {width} pixels, the policy takes {size}: "
            "set target.image_size or record again with world.camera.size"
        )


def held_out_every(episodes: int, share: float) -> int:
    """Return k: every k-th of the episodes is held out, for a share above 0 and at most 0.5.

    Raises:
        CheckpointError: A single episode.
    """
    if episodes < 2:
        raise CheckpointError("one demonstration cannot be both trained on and held out: record at least two")
    return min(max(2, round(1 / share)), episodes)


S = TypeVar("S", bound=Rows)


def split(samples: S, share: float) -> tuple[S, S]:
    """Return (training, held out) by whole episodes; `samples` has a tensor `episodes`.

    Every k-th episode is held out, so that each task, plain and perturbed, is in both parts.

    Raises:
        CheckpointError: A single episode.
    """
    episodes: Tensor = getattr(samples, "episodes")  # noqa: B009
    every = held_out_every(int(episodes.max()) + 1, share)
    held_out = episodes % every == every - 1
    return samples.where(~held_out), samples.where(held_out)
