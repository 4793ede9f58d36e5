"""Read observations from demonstrations: in batches to train a compact target, or one by one for any target.

Shapes: n observations, p and s numbers of proprioception and state, L words, P prompt tokens, E width, H control steps
of a chunk, D degrees of freedom of an action.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.spaces import Observation, ObservationSpace
from kerv_cli.engine.protocol import EncodesMany, Target
from kerv_cli.targets.compact.features import WordTokenizer
from kerv_cli.targets.compact.target import Inputs
from kerv_cli.targets.samples import Rows, observed_steps
from kerv_cli.targets.settings import TargetSettings
from kerv_cli.worlds import instruction_of
from kerv_cli.worlds.demos.files import DemoEpisode, EncodedFrames

BATCH = 64  # observations that a target encodes and decodes at once


@dataclass(frozen=True)
class Observations(Rows):
    """n observations, ordered by episode and control step.

    Attributes:
        frames: (n, size, size x views, 3) uint8 images. None if the policy reads the state.
        proprioception: (n, p) float32.
        states: (n, s) float32, the simulator's privileged state.
        words: (n, L) int64, ids of the instruction's words.
        steps: (n,) int64, control steps since the start of the episode.
    """

    frames: EncodedFrames | None
    proprioception: Tensor
    states: Tensor
    words: Tensor
    steps: Tensor

    def inputs(self, device: torch.device) -> Inputs:
        images = None
        if self.frames is not None:
            images = torch.from_numpy(self.frames.pixels()).to(device).permute(0, 3, 1, 2)
        return Inputs(images, self.proprioception.to(device), self.states.to(device), self.words.to(device))


def read_observations(
    episode: DemoEpisode, settings: TargetSettings, space: ObservationSpace, words: WordTokenizer
) -> Observations:
    """Return the observations of an episode, to train a compact policy.

    If the policy reads images, only the control steps with an image are observations.
    """
    sees = settings.observation == "vision"
    steps = observed_steps(episode, sees)
    frames: Any = episode.frames if sees else None
    if sees:
        check_frames(episode, settings.image_size)
    states = torch.from_numpy(episode.states[steps]).float()
    ids = torch.tensor([words.encode(instruction_of(episode.task), settings.instruction_tokens)])
    proprioception = states[:, : len(space.proprioception)]
    return Observations(frames, proprioception, states, ids.repeat(len(steps), 1), torch.from_numpy(steps))


def read_chunks(episode: DemoEpisode, steps: np.ndarray, chunk: int) -> np.ndarray:
    """Return the expert's next H actions (n, H, D) at n control steps, in environment units without noise.

    Args:
        steps: (n,) control steps at which the chunks begin. Chunks near the episode's end include the actions
            that were recorded after the end.
        chunk: H, control steps per chunk.
    """
    check_tail(episode, chunk, f"chunks of {chunk}")
    return episode.labels[steps[:, None] + np.arange(chunk)]


def undisturbed(episode: DemoEpisode, steps: np.ndarray, chunk: int) -> np.ndarray:
    """Return whether all actions of the chunks that begin at the control steps (n,) were executed as labelled, (n,).

    Noise in the execution changes the later labels of a chunk, so no policy can predict them.
    """
    check_tail(episode, chunk, f"chunks of {chunk}")
    noisy = np.zeros(len(episode.labels), dtype=bool)  # after an episode's end the expert acts
    noisy[: episode.steps] = (episode.executed != episode.labels[: episode.steps]).any(1)
    return np.asarray(~noisy[steps[:, None] + np.arange(chunk)].any(1))


def observations_of(
    target: Target, episode: DemoEpisode, steps: np.ndarray, space: ObservationSpace
) -> list[Observation]:
    """Return the observations that a target would have got at the control steps (n,) of a demonstration.

    Each of the target's cameras gets the recorded image.
    """
    frames: Any = [None] * len(steps)
    if target.cameras:
        if frame_shape := getattr(target, "frame_shape", None):
            check_frames(episode, frame_shape[0])
        rows = np.searchsorted(episode.frame_steps, steps).clip(max=len(episode.frame_steps) - 1)
        missing = steps[episode.frame_steps[rows] != steps]
        if len(missing):
            raise CheckpointError(f"step {missing[0]} of {episode.task} {episode.seed} has no frame: record every step")
        frames = np.asarray(episode.frames[rows])
    count, instruction, found = len(space.proprioception), instruction_of(episode.task), []
    for state, frame in zip(episode.states[steps].astype(np.float64), frames, strict=True):
        found.append(Observation(state[:count], state, instruction, dict.fromkeys(target.cameras, frame)))
    return found


def prompts_of(target: Target, observations: Iterable[Observation], size: int = BATCH) -> Iterator[Tensor]:
    """Encode observations, and yield batches of up to `size` prompts (B, P, E) of equal length, in order."""
    remaining = iter(observations)
    while batch := list(itertools.islice(remaining, size)):
        if isinstance(target, EncodesMany):
            yield target.encode_many(batch)
            continue
        prompts = map(target.encode, batch)
        yield from (torch.cat(list(equal)) for _, equal in itertools.groupby(prompts, lambda prompt: prompt.shape[1]))


def check_tail(episode: DemoEpisode, steps: int, use: str) -> None:
    """Check that an episode has `steps` expert actions from its last control step on. `use`: for the message."""
    tail = len(episode.labels) - episode.steps
    if tail < steps - 1:
        raise CheckpointError(
            f"the demonstrations have {tail} labels after an episode's end, {use} need {steps - 1}: "
            f"take at most {tail + 1}, or record or import them with tail={steps - 1}"
        )


def check_frames(episode: DemoEpisode, size: int) -> None:
    """Check that each view in an episode's images has `size` pixels per side."""
    height, width = episode.frames.shape[1:3]
    if height != size or width % size:
        raise CheckpointError(
            f"the demonstrations' frames have {height} x {width} pixels, the policy takes {size}: "
            "set target.image_size or record again with world.camera.size"
        )
