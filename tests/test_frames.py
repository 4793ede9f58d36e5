"""Frames that stay encoded in their files: the same pixels, whatever is chosen of them."""

from pathlib import Path

import numpy as np
import pytest
import torch

from kerv_cli.targets.compact.settings import TargetSettings
from kerv_cli.targets.compact.text import WordTokenizer
from kerv_cli.targets.observations import Observations, read_observations
from kerv_cli.worlds.demos.files import DemoEpisode, EncodedFrames, load_episode, save_episode
from kerv_cli.worlds.metaworld.spec import SPEC

SIZE = 96


def episode(path: Path, seed: int, frames: int = 5) -> DemoEpisode:
    """Writes an episode of random frames -> as it was before."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 255, (frames, SIZE, SIZE, 3), dtype=np.uint8)
    steps, labels = 2 * frames, rng.uniform(-1, 1, (2 * frames + 8, 4)).astype(np.float32)
    states = rng.uniform(size=(steps, 39)).astype(np.float32)
    made = DemoEpisode(
        *("reach-v3", seed, False, steps, pixels, np.arange(0, steps, 2)), states, labels, labels[:steps], np.zeros(3)
    )
    save_episode(path, made)
    return made


@pytest.fixture
def two(tmp_path):
    """Two episodes as written, and as read."""
    paths = [tmp_path / f"{seed}.safetensors" for seed in range(2)]
    written = [episode(path, seed, 5 + seed) for seed, path in enumerate(paths)]
    return written, [load_episode(path) for path in paths]


def test_pixels_are_those_that_were_written(two):
    for written, found in zip(*two, strict=True):
        assert isinstance(found.frames, EncodedFrames)
        assert np.array_equal(found.frames.pixels(), written.frames)
        assert np.array_equal(found.frames[3], written.frames[3])
        assert np.array_equal(found.frames[1:3].pixels(), written.frames[1:3])
        assert np.array_equal(np.stack(list(found.frames)), written.frames)


def test_observations_of_several_files_keep_none_of_them_in_memory(two):
    written, found = two
    words = WordTokenizer.build(["reach the goal"])
    parts = [read_observations(e, TargetSettings(), SPEC.observation, words) for e in found]
    joined = Observations.joined(parts)
    everything = np.concatenate([e.frames for e in written])
    assert isinstance(joined.frames, EncodedFrames)
    assert all(isinstance(file, Path) for file in joined.frames.files)  # neither bytes nor open files
    chosen = torch.tensor([10, 0, 7, 7])
    images = joined.inputs(chosen, torch.device("cpu")).images
    assert np.array_equal(images.permute(0, 2, 3, 1).numpy(), everything[chosen.numpy()])
    masked = joined.where(torch.arange(len(joined)) % 3 == 1)
    assert isinstance(masked.frames, EncodedFrames)
    assert np.array_equal(masked.frames.pixels(), everything[1::3])
