"""Data and weights that a training begins with: another target's, balanced batches, joined datasets, DAgger."""

import dataclasses
import shutil
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from command import kerv, refusal

from kerv_cli.base.config import compose
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.episodes.policy import decoder_for
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.database import Database
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.targets.checkpoint import load_target, read_target
from kerv_cli.targets.compact.features import WordTokenizer
from kerv_cli.targets.compact.target import CompactTarget, save_target
from kerv_cli.training.demonstrations import PolicyActs, open_demos
from kerv_cli.training.drafter import plan_drafter
from kerv_cli.training.fit import batches, identity_of
from kerv_cli.training.settings import DemosSettings, TrainDrafterSettings, TrainSettings, TrainTargetSettings
from kerv_cli.training.target import plan_target, task_weights
from kerv_cli.worlds import spec_of
from kerv_cli.worlds.demos.dataset import DemoDataset, DemoEntry
from kerv_cli.worlds.demos.files import DemoEpisode
from kerv_cli.worlds.demos.recording import DemoConfig, record, run_expert
from kerv_cli.worlds.metaworld.spec import SPEC
from kerv_cli.worlds.settings import CameraSettings, WorldSettings
from kerv_cli.worlds.spec import EnvironmentSpec

ACTIONS, OBSERVATION = SPEC.actions, SPEC.observation

OLD = dataclasses.replace(ACTIONS, low=(-0.5, -1.0, -1.0, -1.0), high=(0.5, 1.0, 2.0, 1.0))
WORDS = WordTokenizer.build(["pull the drawer open", "jump"])


class Demos:
    """Four made-up episodes of a task."""

    sha256, path, views = "d" * 64, Path("demos"), 0
    manifest = SimpleNamespace(config={}, environment=SPEC.name, actions=ACTIONS, observation=OBSERVATION)
    episodes = tuple(DemoEntry(seed, False, 6, 0, "", "drawer-open-v3", Path()) for seed in range(4))
    of_tasks = DemoDataset.of_tasks

    def load(self, index: int) -> DemoEpisode:
        rng = np.random.default_rng(index)
        labels = rng.uniform(-1, 1, (14, 4)).astype(np.float32)
        states = rng.uniform(0, 0.3, (6, 39)).astype(np.float32)
        frames, steps = np.zeros((3, 96, 96, 3), dtype=np.uint8), np.arange(0, 6, 2)
        return DemoEpisode("drawer-open-v3", index, False, 6, frames, steps, states, labels, labels[:6], np.zeros(3))


@pytest.fixture
def with_old(tmp_path, monkeypatch):
    """A results folder with the target `old` (H = 4), whose statistics and words no fresh run would have."""
    monkeypatch.setattr(DemoDataset, "open", classmethod(lambda cls, folder: Demos()))
    save_old(tmp_path, 3)
    return tmp_path


def save_old(with_old: Path, seed: int) -> None:
    torch.manual_seed(seed)
    shapes = compose("train_target", ["target=nano", "target.observation=state"], TrainTargetSettings).target
    save_target(with_old / "artifacts/target/old", CompactTarget(shapes, OLD, OBSERVATION, WORDS), "metaworld", {})


def trained(with_old: Path, *overrides: str) -> Path:
    common = ["name=new", "target=nano", "target.observation=state", "target.chunk=8", "task=drawer-open"]
    common += ["train.init=old", "train.batch=4", "train.steps=4", "train.validate_every=2", f"results={with_old}"]
    given = {override.split("=")[0] for override in overrides}
    common = [override for override in common if override.split("=")[0] not in given]
    settings = compose("train_target", [*common, *overrides], TrainTargetSettings)
    return plan_target(settings, Database(with_old)).make()[0]


@pytest.mark.bits
def test_a_run_begins_with_the_weights_statistics_and_words(with_old):
    folder = trained(with_old, "train.lr=0", "train.weight_decay=0")
    old, _ = load_target(with_old / "artifacts/target/old")
    new, description = load_target(folder)
    assert all(torch.equal(new.state_dict()[k], v) for k, v in old.state_dict().items())
    assert new.chunk == 8
    assert dataclasses.replace(new.settings, chunk=old.settings.chunk) == old.settings
    assert new.actions == OLD
    assert new.words == WORDS
    assert description.provenance["init"] == read_target(with_old / "artifacts/target/old").sha256


def test_the_weights_belong_to_the_runs_identity_and_their_name_does_not(with_old):
    trained(with_old)
    shutil.copytree(with_old / "artifacts/target/old", with_old / "artifacts/target/renamed")
    trained(with_old, "train.init=renamed", "train.steps=5")
    save_old(with_old, 4)
    for other in ("train.init=old", "train.init=null"):
        with pytest.raises(UsageError, match="other settings or data"):
            trained(with_old, other)


def test_scores_with_and_without_success_are_of_different_runs(with_old):
    alone, some, more = (identity_of(TrainSettings(closed_loop=n), Demos()) for n in (0, 1, 2))  # type: ignore[arg-type]
    assert some == more != alone
    assert identity_of(TrainSettings(undisturbed=True), Demos()) != alone  # type: ignore[arg-type]
    smaller = identity_of(TrainSettings(stored="int8"), Demos())  # type: ignore[arg-type]
    assert smaller != alone  # a finished training is not said to be done in a format that was never written


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["target.width=64"], "width=32, the run target.width=64"),
        (["target.observation=vision"], "observation=state, the run target.observation=vision"),
        (["target.layers=1"], "layers=2, the run target.layers=1"),
        (["train.init=nobody"], "no target 'nobody'"),
        (["name=old"], "would be overwritten"),
        (["train.colour=0.3"], "train.colour=0.3 needs images"),
        (["train.places=path"], "train.places=path needs images"),
    ],
)
def test_what_cannot_be_trained_is_refused(with_old, overrides, says):
    with pytest.raises(UsageError, match=says):
        trained(with_old, *overrides)


@pytest.mark.parametrize(
    "setting", ["init=old", "colour=0.3", "places=path", "balance=0.5", "closed_loop=2", "undisturbed=true"]
)
def test_settings_of_targets_are_refused_for_a_drafter(tmp_path, setting):
    with pytest.raises(UsageError, match=rf"train\.{setting}"):
        plan_drafter(compose("train_drafter", [f"train.{setting}"], TrainDrafterSettings), Database(tmp_path)).make()


@pytest.mark.parametrize(
    ("observation", "proprioception", "error"),
    [("state", OBSERVATION.proprioception, UsageError), ("vision", (), CheckpointError)],
)
def test_demonstrations_without_the_positions_that_a_policy_needs_are_refused(
    with_old, monkeypatch, observation, proprioception, error
):
    space = dataclasses.replace(OBSERVATION.without_state(), proprioception=proprioception)
    monkeypatch.setattr(Demos, "manifest", SimpleNamespace(**{**vars(Demos.manifest), "observation": space}))
    with pytest.raises(error):
        trained(with_old, f"target.observation={observation}")


# --- dagger

SHORT = CameraSettings()


@pytest.fixture(scope="module")
def datasets(tmp_path_factory, recorded):
    """Two small datasets of real demonstrations: `few` of one task, `more` of another."""
    folder = Path(shutil.copytree(recorded, tmp_path_factory.mktemp("datasets") / "results"))
    config = DemoConfig(("reach-v3",), 4, camera=SHORT, frame_stride=8, workers=1)
    record(config, folder / "artifacts/demos/more")
    return folder


def test_balanced_tasks_are_drawn_alike():
    tasks = torch.tensor([0] * 900 + [1] * 100)

    def share(balance):
        draw = batches(1000, TrainSettings(batch=20_000), task_weights(tasks, balance))
        return float(tasks[draw(0)].double().mean())

    assert share(0.0) == pytest.approx(0.1, abs=0.01)
    assert share(1.0) == pytest.approx(0.5, abs=0.02)
    assert share(0.5) == pytest.approx(0.25, abs=0.02)  # 1 : 3, the root of 1 : 9


def test_datasets_add_up(datasets):
    few, more, both = (open_demos(Database(datasets), name) for name in ("few", "more", "few+more"))
    assert [e.path for e in both.episodes] == [e.path for e in (*few.episodes, *more.episodes)]
    assert set(both.manifest.tasks) == {"drawer-close-v3", "reach-v3"}
    assert len({few.sha256, more.sha256, both.sha256, open_demos(Database(datasets), "more+few").sha256}) == 4
    assert both.load(6).task == "reach-v3"


def test_datasets_of_other_cameras_do_not_add_up(datasets, tmp_path):
    other = DemoConfig(("reach-v3",), 1, camera=CameraSettings(size=48), frame_stride=50, workers=1)
    record(other, tmp_path / "other")
    with pytest.raises(CheckpointError, match="another camera"):
        DemoDataset.joined([open_demos(Database(datasets), "few"), DemoDataset.open(tmp_path / "other")])


def acts_of(target: str, spec: EnvironmentSpec, world: WorldSettings | None = None) -> PolicyActs:
    return PolicyActs.of(DemosSettings(policy=PolicySettings(target=target), world=world or WorldSettings()), spec)


@pytest.mark.bits
def test_a_target_acts_and_the_expert_labels(tmp_path):
    acts = acts_of("mt10-state", SPEC)
    short = {"camera": SHORT, "frame_stride": 20, "workers": 1, "horizon": 60}
    config = DemoConfig(("reach-v3",), 2, **short, expert_share=0.5, policy=acts.sha256)
    record(config, tmp_path / "visited", make_actor=acts)
    dataset = DemoDataset.open(tmp_path / "visited")
    assert dataset.manifest.config["policy"] == acts.sha256
    assert [entry.seed for entry in dataset.episodes] == [0, 1]  # no seed is replaced, whether it succeeds or not
    episode = dataset.load(0)
    same = (episode.labels[: episode.steps] == episode.executed).all(1)
    assert 0 < same.mean() < 1  # the expert's chunks, and the target's
    world = SPEC.open_world("reach-v3", SHORT)
    again = run_expert(world, 0, config, acts(config))
    np.testing.assert_array_equal(again.executed, episode.executed)
    expert, observation = world.spec.expert("reach-v3"), world.reset(0)
    for action, label in zip(episode.executed, episode.labels, strict=False):
        np.testing.assert_allclose(expert(observation), label, atol=1e-6)
        observation = world.step(action)
    world.close()


def test_a_policy_acts_by_its_method(tmp_path):
    words = ("policy=vision", "method=early_unverified", "task=reach", "name=visited", "episodes=1")
    short = ("world.horizon=12", "expert_share=0", "frame_stride=4", "runtime.workers=1")
    kerv("demos", *words, *short, f"results={tmp_path}")
    episode = DemoDataset.open(tmp_path / "artifacts/demos/visited").load(0)
    settings = compose("rollout", ["method=early_unverified"], RolloutSettings)
    decoder, world = decoder_for(settings, "reach-v3"), SPEC.open_world("reach-v3", SHORT)
    world.reset(0)
    decoder.reset("reach-v3", 0, world.end_effector)
    first = decoder.decode(world.observe(decoder.cameras)).actions
    world.close()
    np.testing.assert_allclose(episode.executed[: len(first)], first, atol=1e-6)


def test_the_chunk_counts_and_is_executed():
    words = ["policy=vision", "method=early_unverified"]
    whole, two = (PolicyActs.of(compose("demos", [*words, f"chunk={n}"], DemosSettings), SPEC) for n in (0, 2))
    assert whole.sha256 != two.sha256
    decoder = two(DemoConfig(("reach-v3",), 1, camera=SHORT)).decoder_of("reach-v3")
    assert (decoder.steps, decoder.target.chunk > 2) == (2, True)


@pytest.mark.parametrize(
    ("target", "spec", "camera", "says"),
    [
        ("mt10-h1", SPEC, CameraSettings(name="corner4+gripperPOV:75"), ""),
        ("mt10-h1", SPEC, CameraSettings(name="corner"), "world.camera.name"),
        ("mt10-h1", SPEC, CameraSettings(name="corner4:60"), "world.camera.name"),
        ("mt10-h1", SPEC, CameraSettings(size=48), "world.camera.size=48"),
        ("mt10-state", spec_of("insert-peg"), CameraSettings(), "target 'mt10-state'"),
    ],
)
def test_only_further_views_may_differ_from_what_the_target_was_trained_on(target, spec, camera, says):
    with pytest.raises((UsageError, CheckpointError), match=says) if says else nullcontext():
        assert acts_of(target, spec, WorldSettings(camera=camera)).sha256


OUTSIDE = "../../../outside"


@pytest.mark.parametrize(
    "line",
    [
        f"demos name={OUTSIDE} task=reach",
        f"demos import source=. name={OUTSIDE}",
        f"train target name={OUTSIDE} demos=few target=nano target.observation=state train.steps=1",
        f"train drafter policy.artifacts.drafter={OUTSIDE} demos=few train.steps=1",
        f"train drafter drafter=early policy.artifacts.early={OUTSIDE} demos=few train.steps=1",
        f"build target grow=60m name={OUTSIDE}",
        f"build datastore policy.artifacts.datastore={OUTSIDE} demos=few",
        f"calibrate policy.artifacts.calibration={OUTSIDE} demos=few",
    ],
)
def test_a_command_writes_nothing_outside_the_results_folder(demonstrated, line):
    policy = [] if line.startswith(("demos import", "demos name", "train target")) else ["policy.target=nano-vision"]
    refused = refusal(*line.split(), *policy, f"results={demonstrated}", code=2)
    assert f"'{OUTSIDE}' must be letters" in refused
    assert not (demonstrated / "artifacts" / "target" / OUTSIDE).resolve().exists()
