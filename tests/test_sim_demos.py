"""Recorded demonstrations on real Meta-World: contents, resuming, refusals, damage, frames that stay encoded."""

import hashlib
import itertools
import json
import shutil
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from examples.insertion import SPEC as INSERTION

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.manifests import read_file
from kerv_cli.targets.compact.features import WordTokenizer
from kerv_cli.targets.observations import Observations, read_observations, undisturbed
from kerv_cli.targets.settings import TargetSettings
from kerv_cli.worlds.demos import recording
from kerv_cli.worlds.demos.dataset import DemoDataset, DemoManifest
from kerv_cli.worlds.demos.files import DemoEpisode, EncodedFrames, load_episode, save_episode
from kerv_cli.worlds.demos.recording import DemoConfig, Perturbation, is_perturbed, record
from kerv_cli.worlds.metaworld.spec import SPEC
from kerv_cli.worlds.settings import CameraSettings

CONFIG = DemoConfig(
    tasks=("reach",), episodes=6, frame_stride=10, camera=CameraSettings(size=24, supersample=1), workers=1, tail=5
)

GOLDEN_NOISE = "da22e466a3c803b9b3d044c2cfe817eb4241429e2422b91622f51c340dc4a442"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    out = tmp_path_factory.mktemp("demos")
    progress = []
    manifest = record(CONFIG, out, lambda done, total: progress.append((done, total)))
    assert progress[-1] == (6, 6)
    assert manifest == read_file(DemoManifest, out / "manifest.json")
    return out


@pytest.fixture
def copied(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "demos")


def test_a_horizon_above_the_tasks_own_is_honoured(tmp_path, monkeypatch):
    monkeypatch.setitem(INSERTION.tasks, "insert-peg", replace(INSERTION.tasks["insert-peg"], horizon=4))
    manifest = record(DemoConfig(("insert-peg",), 1, perturbed=0.0, horizon=120, workers=1, frame_stride=50), tmp_path)
    assert manifest.tasks["insert-peg"].episodes[0].steps > 4


def files_of(folder):
    return {path.relative_to(folder): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.mark.bits
@pytest.mark.parametrize("index", [0, 1])
def test_an_episode_can_be_replayed_from_its_seed(recorded, index):
    episode = DemoDataset.open(recorded).load(index)
    expert, frames = SPEC.expert("reach"), []
    noise = Perturbation(episode.task, episode.seed, SPEC.actions)
    with SPEC.open_world("reach", CONFIG.camera) as world:
        observation = world.reset(episode.seed)
        assert world.initial_state.tobytes() == episode.initial_state.tobytes()
        for step in range(episode.steps):
            assert not world.success
            if step % CONFIG.frame_stride == 0:
                frames.append(world.frame())
            label = expert(observation)
            action = noise(label) if episode.perturbed else label
            assert observation.state.astype(np.float32).tobytes() == episode.states[step].tobytes()
            assert label.astype(np.float32).tobytes() == episode.labels[step].tobytes()
            assert action.astype(np.float32).tobytes() == episode.executed[step].tobytes()
            observation = world.step(action)
        assert world.success
        for label in episode.labels[episode.steps :]:
            assert expert(observation).astype(np.float32).tobytes() == label.tobytes()
            observation = world.step(expert(observation))
    assert np.asarray(episode.frames).tobytes() == np.stack(frames).tobytes()


@pytest.mark.bits
def test_a_killed_recording_goes_on(copied):
    before = DemoDataset.open(copied)
    missing, damaged = before.episodes[1].path, before.episodes[4].path
    kept = files_of(copied / "episodes")
    missing.unlink()
    damaged.write_bytes(damaged.read_bytes()[:-100])
    (copied / "manifest.json").unlink()
    with pytest.raises(CheckpointError, match="unfinished"):
        DemoDataset.open(copied)
    assert record(CONFIG, copied).sha256 == before.sha256
    again = files_of(copied / "episodes")
    assert {path.name for path in again if again[path] != kept[path]} == {missing.name, damaged.name}


@pytest.mark.bits
def test_the_number_of_workers_changes_nothing(recorded, tmp_path):
    manifest = record(replace(CONFIG, workers=2), tmp_path / "parallel")
    assert manifest == DemoDataset.open(recorded).manifest


def test_another_configuration_is_refused_and_nothing_touched(copied):
    before = files_of(copied)
    for change, said in (({"episodes": 7}, "episodes=6, not 7"), ({"camera": CameraSettings(size=32)}, "camera=")):
        with pytest.raises(UsageError, match=said):
            record(replace(CONFIG, **change), copied)
    assert files_of(copied) == before


def test_failed_seeds_are_replaced_by_the_next_ones(recorded, tmp_path):
    steps = {entry.seed: entry.steps for entry in DemoDataset.open(recorded).episodes}
    horizon = sorted(steps.values())[3]
    config = replace(CONFIG, episodes=3, horizon=horizon)
    manifest = record(config, tmp_path / "short")
    task = manifest.tasks["reach-v3"]
    succeeded = [entry.seed for entry in task.episodes]
    fast = [seed for seed in steps if steps[seed] <= horizon]
    assert succeeded == fast[:3]
    assert task.failed_seeds == tuple(seed for seed in range(succeeded[-1]) if seed not in succeeded)
    assert task.failed_seeds, "choose a horizon that some seed misses"
    tried = files_of(tmp_path / "short" / "failed")
    assert record(config, tmp_path / "short") == manifest
    assert files_of(tmp_path / "short" / "failed") == tried  # a known failure is not run again


def test_an_expert_that_never_succeeds_ends_the_recording(tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "_EXTRA_SEEDS", 2)
    config = DemoConfig(("insert-peg",), 1, horizon=2, workers=1)  # a simulator that opens fast
    with pytest.raises(KervError, match="insert-peg"):
        record(config, tmp_path / "hopeless")
    assert len(list((tmp_path / "hopeless" / "failed").rglob("*.json"))) == 4  # bounded: 2 x 1 + 2 seeds
    assert not (tmp_path / "hopeless" / "manifest.json").exists()


def test_damage_is_found(copied, tmp_path):
    with pytest.raises(CheckpointError):
        DemoDataset.open(tmp_path / "nothing")
    dataset = DemoDataset.open(copied)
    path = dataset.episodes[2].path
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(CheckpointError, match=path.name):
        dataset.load(2)
    path.write_bytes(data[:-1])
    with pytest.raises(CheckpointError, match=path.name):
        DemoDataset.open(copied)
    manifest = json.loads((copied / "manifest.json").read_text())
    manifest["tasks"]["reach-v3"]["episodes"].pop()
    for text in (json.dumps(manifest), "{}", "{", '{"format": 2, "tasks": 3}'):
        (copied / "manifest.json").write_text(text)
        with pytest.raises(CheckpointError):
            DemoDataset.open(copied)


@pytest.mark.bits
def test_noise_is_what_it_was_in_every_dataset_so_far():
    """Datasets recorded before must come out bit-equal when they are recorded again."""
    perturb = Perturbation("reach-v3", 1, SPEC.actions)
    executed = np.array([perturb(np.array([0.1, -0.2, 0.3, -1.0])) for _ in range(200)])
    assert hashlib.sha256(executed.tobytes()).hexdigest() == GOLDEN_NOISE


@pytest.mark.parametrize("quiet", [1, 20])
def test_quiet_noise_comes_in_bursts_that_far_apart(quiet):
    action = np.array([0.1, -0.2, 0.3, -1.0])
    for seed in range(20):
        perturb = Perturbation("reach-v3", seed, SPEC.actions, quiet)
        noisy = [(perturb(action) != action).any() for _ in range(300)]
        lengths = [len(list(run)) for _, run in itertools.groupby(noisy)]  # noisy and quiet stretches in turn
        whole = lengths[1:-1]  # the first begins at random, the last is cut off
        stretches = dict(zip((noisy[lengths[0]], not noisy[lengths[0]]), (whole[::2], whole[1::2]), strict=True))
        assert set(stretches[False]) == {quiet}
        assert set(stretches[True]) <= set(range(3, 9))


def test_only_chunks_executed_as_labelled_are_undisturbed(tmp_path):
    config, chunk = replace(CONFIG, tasks=("drawer-close",), episodes=2, perturbed=1.0, quiet=8), 5
    record(config, tmp_path)
    dataset = DemoDataset.open(tmp_path)
    for index in range(2):
        episode = dataset.load(index)
        executed = np.concatenate([episode.executed, episode.labels[episode.steps :]])
        steps = np.arange(episode.steps)
        expected = [bool((executed[t : t + chunk] == episode.labels[t : t + chunk]).all()) for t in steps]
        assert undisturbed(episode, steps, chunk).tolist() == expected
        assert 0 < sum(expected) < len(steps)
    with pytest.raises(CheckpointError, match="take at most 6"):
        undisturbed(dataset.load(0), np.arange(3), CONFIG.tail + 2)
    with pytest.raises(UsageError, match="quiet=8, not 0"):
        record(replace(config, quiet=0), tmp_path)


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.5, 1.0])
def test_noisy_episodes_are_spread_evenly(fraction):
    noisy = [is_perturbed(seed, fraction) for seed in range(1000)]
    assert sum(noisy) == pytest.approx(1000 * fraction, abs=1)
    assert all(abs(sum(noisy[start : start + 10]) - 10 * fraction) <= 1 for start in range(990))


# --- frames

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


def test_an_episode_is_written_image_by_image(tmp_path):
    """A long episode of large images would otherwise take more memory than a robot's computer has."""
    made = replace(episode(tmp_path / "whole", 0), frame_steps=np.arange(60))
    pixels = np.random.default_rng(0).integers(0, 255, (SIZE, SIZE, 3), dtype=np.uint8)
    streamed: Any = (np.roll(pixels, shift, 0) for shift in range(60))
    tracemalloc.start()
    try:
        save_episode(tmp_path / "long", replace(made, frames=streamed))
        assert tracemalloc.get_traced_memory()[1] < (tmp_path / "long").stat().st_size / 3
    finally:
        tracemalloc.stop()
    assert np.array_equal(load_episode(tmp_path / "long").frames[59], np.roll(pixels, 59, 0))
    assert {path.name for path in tmp_path.iterdir()} == {"whole", "long"}


def test_observations_of_several_files_keep_none_of_them_in_memory(tmp_path):
    words = WordTokenizer.build(["reach the goal"])
    paths = [tmp_path / f"{seed}.safetensors" for seed in range(2)]
    written = [episode(path, seed, 5 + seed) for seed, path in enumerate(paths)]
    found = map(load_episode, paths)
    parts = [read_observations(e, TargetSettings(), SPEC.observation, words) for e in found]
    joined = Observations.joined(parts)
    everything = np.concatenate([e.frames for e in written])
    assert isinstance(joined.frames, EncodedFrames)
    assert all(isinstance(file, Path) for file in joined.frames.files)  # neither bytes nor open files
    chosen = torch.tensor([10, 0, 7, 7])
    images = joined.where(chosen).inputs(torch.device("cpu")).images
    assert np.array_equal(images.permute(0, 2, 3, 1).numpy(), everything[chosen.numpy()])
    masked = joined.where(torch.arange(len(joined)) % 3 == 1)
    assert isinstance(masked.frames, EncodedFrames)
    assert np.array_equal(masked.frames.pixels(), everything[1::3])
