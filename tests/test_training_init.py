"""train.init: a run that begins with another target's weights, at another chunk length."""

import dataclasses
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from kerv_cli.base.config import compose
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.targets.checkpoint import load_target, read_target
from kerv_cli.targets.compact.folder import save_target
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.compact.text import WordTokenizer
from kerv_cli.training.drafter import DrafterRun
from kerv_cli.training.settings import TrainDrafterSettings, TrainTargetSettings
from kerv_cli.training.target import TargetRun
from kerv_cli.worlds.demos.dataset import DemoDataset, DemoEntry
from kerv_cli.worlds.demos.files import DemoEpisode
from kerv_cli.worlds.metaworld.spec import SPEC

ACTIONS, OBSERVATION = SPEC.actions, SPEC.observation

OLD = dataclasses.replace(ACTIONS, low=(-0.5, -1.0, -1.0, -1.0), high=(0.5, 1.0, 2.0, 1.0))
WORDS = WordTokenizer.build(["pull the drawer open", "jump"])


class Demos:
    """Four made-up episodes of a task."""

    sha256, path, views = "d" * 64, Path("demos"), 0
    manifest = SimpleNamespace(config={}, environment=SPEC.name, actions=ACTIONS, observation=OBSERVATION)
    episodes = tuple(DemoEntry(seed, False, 6, 0, "", "drawer-open-v3", Path()) for seed in range(4))

    def load(self, index: int) -> DemoEpisode:
        rng = np.random.default_rng(index)
        labels = rng.uniform(-1, 1, (14, 4)).astype(np.float32)
        states = rng.uniform(0, 0.3, (6, 39)).astype(np.float32)
        frames, steps = np.zeros((3, 96, 96, 3), dtype=np.uint8), np.arange(0, 6, 2)
        return DemoEpisode("drawer-open-v3", index, False, 6, frames, steps, states, labels, labels[:6], np.zeros(3))


@pytest.fixture
def results(tmp_path, monkeypatch):
    """A results folder with the target `old` (H = 4), whose statistics and words no fresh run would have."""
    monkeypatch.setattr(DemoDataset, "open", classmethod(lambda cls, folder: Demos()))
    save_old(tmp_path, 3)
    return tmp_path


def save_old(results: Path, seed: int) -> None:
    torch.manual_seed(seed)
    shapes = compose("train_target", ["target=nano", "target.observation=state"], TrainTargetSettings).target
    save_target(results / "artifacts/target/old", CompactTarget(shapes, OLD, OBSERVATION, WORDS), "metaworld", {})


def settings(results: Path, *overrides: str) -> TrainTargetSettings:
    common = ["name=new", "target=nano", "target.observation=state", "target.chunk=8", "task=drawer-open"]
    common += ["train.init=old", "train.batch=4", "train.steps=4", "train.validate_every=2", f"results={results}"]
    given = {override.split("=")[0] for override in overrides}
    common = [override for override in common if override.split("=")[0] not in given]
    return compose("train_target", [*common, *overrides], TrainTargetSettings)


def trained(results: Path, *overrides: str, stop: int | None = None) -> Path:
    run = TargetRun(settings(results, *overrides))
    run.load(lambda done, total: None)
    run.train(lambda step, metrics: interrupt() if step == stop else None)
    return run.folder


def interrupt() -> None:
    raise KeyboardInterrupt


@pytest.mark.bits
def test_a_run_begins_with_the_weights_statistics_and_words(results):
    folder = trained(results, "train.lr=0", "train.weight_decay=0")
    old, _ = load_target(results / "artifacts/target/old")
    new, description = load_target(folder)
    assert all(torch.equal(new.state_dict()[k], v) for k, v in old.state_dict().items())
    assert new.chunk == 8
    assert dataclasses.replace(new.settings, chunk=old.settings.chunk) == old.settings
    assert new.actions == OLD
    assert new.words == WORDS
    assert description.provenance["init"] == read_target(results / "artifacts/target/old").sha256


def test_the_weights_belong_to_the_runs_identity_and_their_name_does_not(results):
    trained(results)
    shutil.copytree(results / "artifacts/target/old", results / "artifacts/target/renamed")
    trained(results, "train.init=renamed", "train.steps=5")
    save_old(results, 4)
    for other in ("train.init=old", "train.init=null"):
        with pytest.raises(CheckpointError, match="other settings or data"):
            trained(results, other)


def test_scores_with_and_without_success_are_of_different_runs(results):
    alone, some, more = (TargetRun(settings(results, f"train.closed_loop={n}")).hash for n in (0, 1, 2))
    assert some == more != alone


@pytest.mark.parametrize(
    ("override", "shape"),
    [("target.width=64", "width"), ("target.observation=vision", "observation"), ("target.layers=1", "layers")],
)
def test_another_shape_is_refused_by_its_name(results, override, shape):
    old = read_target(results / "artifacts/target/old").settings[shape]
    with pytest.raises(UsageError, match=rf"{shape}={old}, the run {override}"):
        TargetRun(settings(results, override))


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["train.init=nobody"], "no target 'nobody'"),
        (["name=old"], "would be overwritten"),
        (["train.colour=0.3"], "train.colour=0.3 needs images"),
        (["train.places=path"], "train.places=path needs images"),
    ],
)
def test_what_cannot_be_trained_is_refused(results, overrides, says):
    with pytest.raises(UsageError, match=says):
        TargetRun(settings(results, *overrides))


@pytest.mark.parametrize("setting", ["init=old", "colour=0.3", "places=path", "balance=0.5", "closed_loop=2"])
def test_settings_of_targets_are_refused_for_a_drafter(setting):
    with pytest.raises(UsageError, match=rf"train\.{setting}"):
        DrafterRun(compose("train_drafter", [f"train.{setting}"], TrainDrafterSettings))


def test_demonstrations_without_places_are_refused(results, monkeypatch):
    nameless = SimpleNamespace(**{**vars(Demos.manifest), "observation": dataclasses.replace(OBSERVATION, places=())})
    monkeypatch.setattr(Demos, "manifest", nameless)
    with pytest.raises(UsageError, match="no places"):
        TargetRun(settings(results))
