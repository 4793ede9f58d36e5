"""Samples to train on, read from demonstrations. torch is imported only where a tensor is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np

from kerv_cli.base.errors import CheckpointError
from kerv_cli.worlds.demos.files import DemoEpisode, EncodedFrames

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Rows:
    """Base class of dataclasses of samples. Each field (a tensor, or encoded images) has one row per sample.

    A field for images is None if the samples have no images.
    """

    def __len__(self) -> int:
        return next(len(x) for x in vars(self).values() if x is not None)

    def where(self, chosen: Tensor) -> Self:
        return type(self)(*(None if x is None else x[chosen] for x in vars(self).values()))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        import torch

        joined: list[Any] = []
        for column in zip(*(vars(part).values() for part in parts), strict=True):
            if isinstance(column[0], EncodedFrames):
                joined.append(EncodedFrames.joined(column))
            else:
                joined.append(None if column[0] is None else torch.cat(column))
        return cls(*joined)


def observed_steps(episode: DemoEpisode, sees: bool) -> np.ndarray:
    return episode.frame_steps if sees else np.arange(episode.steps)


S = TypeVar("S", bound=Rows)


def split(samples: S, share: float) -> tuple[S, S]:
    """Split samples into training and held-out samples. All samples of an episode go to the same part.

    Every k-th episode is held out (k is about 1 / share), so that both parts contain each task, with and without
    perturbations.

    Args:
        samples: Samples with a tensor `episodes`, the index of each sample's episode.
        share: Share of episodes to hold out, above 0 and at most 0.5.
    """
    episodes: Tensor = getattr(samples, "episodes")  # noqa: B009
    count = int(episodes.max()) + 1
    if count < 2:
        raise CheckpointError("one demonstration cannot be both trained on and held out: record at least two")
    every = min(max(2, round(1 / share)), count)
    held_out = episodes % every == every - 1
    return samples.where(~held_out), samples.where(held_out)
