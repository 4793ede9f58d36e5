"""Reads demonstrations as the observations of a policy: the one reader of training, distillation, datastore and
calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.settings import TargetSettings
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.targets.compact.target import Inputs
from kerv_cli.targets.compact.text import WordTokenizer
from kerv_cli.worlds import instruction_of, specs
from kerv_cli.worlds.demos.dataset import DemoDataset
from kerv_cli.worlds.demos.episode_file import DemoEpisode
from kerv_cli.worlds.demos.frames import EncodedFrames


@dataclass(frozen=True)
class Rows:
    """Base of dataclasses with one row per sample: of tensors, encoded frames, or None for frames that are not seen."""

    def __len__(self) -> int:
        return next(len(x) for x in vars(self).values() if x is not None)

    def where(self, chosen: Tensor) -> Self:
        """The rows that `chosen` selects: a mask (n,) bool, or indices."""
        return type(self)(*(None if x is None else x[chosen] for x in vars(self).values()))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """All rows of `parts`, in order."""
        columns = ([getattr(part, field.name) for part in parts] for field in fields(cls))
        return cls(*map(_joined, columns))


def _joined(column: Sequence[Any]) -> Any:
    if isinstance(column[0], EncodedFrames):
        return EncodedFrames.joined(column)
    return None if column[0] is None else torch.cat(list(column))


@dataclass(frozen=True)
class Observations(Rows):
    """n observations, in the order of episodes and control steps."""

    frames: EncodedFrames | None  # (n, size, size x views, 3) uint8; None for a state policy
    proprioception: Tensor  # (n, p) float32
    states: Tensor  # (n, s) float32, privileged
    words: Tensor  # (n, L) int64
    steps: Tensor  # (n,) int64, control steps since the start of the episode

    def inputs(self, indices: Tensor, device: torch.device) -> Inputs:
        """The observations at `indices` (B,) as a batch on `device`."""
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
    """The observations of a stored episode that a policy of these settings learns from: those with a frame, for a state
    policy every step. chosen: which of them, default all.

    Raises:
        CheckpointError: frames of another size than the policy takes.
    """
    sees, frames = settings.observation == "vision", None
    steps = (episode.frame_steps if sees else np.arange(episode.steps))[chosen]
    if sees:
        check_frames(episode, settings.image_size)
        assert isinstance(episode.frames, EncodedFrames)
        frames = episode.frames[chosen]
    states = torch.from_numpy(episode.states[steps]).float()
    ids = torch.tensor([words.encode(instruction_of(episode.task), settings.instruction_tokens)])
    proprioception = states[:, : len(space.proprioception)]
    return Observations(frames, proprioception, states, ids.repeat(len(steps), 1), torch.from_numpy(steps))


def read_chunks(episode: DemoEpisode, steps: np.ndarray, chunk: int) -> np.ndarray:
    """(n, H, D) float32: the expert's next H = `chunk` clean actions from each of `steps` (n,), environment units. A
    chunk that begins near the end takes labels recorded beyond the success, never those of another episode.

    Raises:
        CheckpointError: too few labels were recorded beyond the success.
    """
    check_tail(episode, chunk, f"chunks of {chunk}")
    return np.stack([episode.labels[t : t + chunk] for t in steps])


def check_tail(episode: DemoEpisode, steps: int, what: str) -> None:
    """Checks that an episode has `steps` labels from each of its control steps on. what: their use, for the message.

    Raises:
        CheckpointError: too few labels were recorded beyond the success.
    """
    tail = len(episode.labels) - episode.steps
    if tail < steps - 1:
        raise CheckpointError(
            f"the demonstrations have {tail} labels behind an episode's end, {what} need {steps - 1}: "
            "record them again with a longer tail"
        )


def check_frames(episode: DemoEpisode, size: int) -> None:
    """Checks that an episode's frames are views of the policy's size in pixels, side by side.

    Raises:
        CheckpointError: they are not.
    """
    height, width = episode.frames.shape[1:3]
    if height != size or width % size:
        pixels = f"{height}" if height == width else f"{height} x {width}"
        raise CheckpointError(
            f"the demonstrations' frames have {pixels} pixels, the policy takes {size}: "
            "set target.image_size or record again with world.camera.size"
        )


def check_spaces(dataset: DemoDataset, actions: ActionSpace, observation: ObservationSpace, owner: str) -> None:
    """Refuses demonstrations of another environment. actions, observation: spaces of `owner`, e.g. "the target".

    Raises:
        CheckpointError: other actions or observations.
    """
    where = f"the demonstrations in {dataset.path}"
    dataset.manifest.actions.check_same(actions, where, owner)
    if observation.state and observation != dataset.manifest.observation:  # without a state it reads images alone
        raise CheckpointError(f"{where} have other observations than {owner}: they are of another environment")


def check_demonstrations(dataset: DemoDataset, description: TargetDescription) -> None:
    """Refuses demonstrations of another environment than a target's, or, for a compact one that sees, of other views.

    Raises:
        CheckpointError: other actions, observations or views.
    """
    check_spaces(dataset, description.actions, description.observation, "the target")
    if description.family != "compact" or not description.cameras:
        return
    camera = specs()[dataset.manifest.environment].camera_name(description.cameras[0])
    check_camera(dataset, camera, "the target sees", f"record them with world.camera.name={camera}")


def check_camera(dataset: DemoDataset, camera: str, who: str, remedy: str) -> None:
    """Refuses demonstrations whose frames are of another camera than `camera`. who, remedy: for the message.

    Raises:
        CheckpointError: they are.
    """
    recorded = dataset.manifest.config["camera"]["name"]
    if recorded != camera:
        raise CheckpointError(f"the demonstrations in {dataset.path} show camera {recorded}, {who} {camera}: {remedy}")


def held_out_every(episodes: int, share: float) -> int:
    """k, of so many episodes of which every k-th is held out. share: above 0, at most 0.5.

    Raises:
        CheckpointError: a single episode.
    """
    if episodes < 2:
        raise CheckpointError("one demonstration cannot be both trained on and held out: record at least two")
    return min(max(2, round(1 / share)), episodes)


S = TypeVar("S", bound=Rows)


def split(samples: S, share: float) -> tuple[S, S]:
    """(training, held out) by whole episodes, of samples with a tensor `episodes`. Every k-th episode is held out, so
    that each task, plain and perturbed, is in both parts. share and errors: as `held_out_every`."""
    episodes: Tensor = getattr(samples, "episodes")  # noqa: B009
    every = held_out_every(int(episodes.max()) + 1, share)
    held_out = episodes % every == every - 1
    return samples.where(~held_out), samples.where(held_out)
