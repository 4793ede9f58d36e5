"""Balanced batches, datasets that add up, and DAgger."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch
from command import kerv

from kerv_cli.base.config import compose
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.episodes.policy import decoder_for
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.training.dagger import PolicyActs
from kerv_cli.training.demonstrations import open_demos
from kerv_cli.training.imitation import task_weights
from kerv_cli.training.loop import draw_samples
from kerv_cli.training.settings import DemosSettings
from kerv_cli.worlds import spec_of
from kerv_cli.worlds.demos.dataset import DemoDataset
from kerv_cli.worlds.demos.recording import DemoConfig, record, run_expert
from kerv_cli.worlds.metaworld.spec import SPEC
from kerv_cli.worlds.settings import CameraSettings, WorldSettings
from kerv_cli.worlds.spec import EnvironmentSpec

SHORT = CameraSettings()


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Two small datasets of real demonstrations: `few` of one task, `more` of another."""
    folder = tmp_path_factory.mktemp("datasets")
    for name, task in (("few", "drawer-close-v3"), ("more", "reach-v3")):
        record(DemoConfig((task,), 4, camera=SHORT, frame_stride=8, workers=1), folder / "artifacts/demos" / name)
    return folder


def test_balanced_tasks_are_drawn_alike():
    tasks = torch.tensor([0] * 900 + [1] * 100)
    generator = torch.Generator().manual_seed(0)

    def share(balance):
        weights = task_weights(tasks, balance)
        drawn = draw_samples(1000, 20_000, generator, None if weights is None else weights.cumsum(0))
        return float(tasks[drawn].double().mean())

    assert share(0.0) == pytest.approx(0.1, abs=0.01)
    assert share(1.0) == pytest.approx(0.5, abs=0.02)
    assert share(0.5) == pytest.approx(0.25, abs=0.02)  # 1 : 3, the root of 1 : 9


def test_datasets_add_up(results):
    few, more, both = (open_demos(str(results), name) for name in ("few", "more", "few+more"))
    assert [e.path for e in both.episodes] == [e.path for e in (*few.episodes, *more.episodes)]
    assert set(both.manifest.tasks) == {"drawer-close-v3", "reach-v3"}
    assert len({few.sha256, more.sha256, both.sha256, open_demos(str(results), "more+few").sha256}) == 4
    assert both.load(5).task == "reach-v3"


def test_datasets_of_other_cameras_do_not_add_up(results, tmp_path):
    other = DemoConfig(("reach-v3",), 1, camera=CameraSettings(size=48), frame_stride=50, workers=1)
    record(other, tmp_path / "other")
    with pytest.raises(CheckpointError, match="another camera"):
        DemoDataset.joined([open_demos(str(results), "few"), DemoDataset.open(tmp_path / "other")])


def acts_of(target: str, spec: EnvironmentSpec, world: WorldSettings | None = None) -> PolicyActs:
    return PolicyActs.of(DemosSettings(policy=PolicySettings(target=target), world=world or WorldSettings()), spec)


@pytest.mark.bits
def test_a_target_acts_and_the_expert_labels(tmp_path):
    acts = acts_of("mt10-state", SPEC)
    tasks, share = ("reach-v3",), 0.5
    config = DemoConfig(tasks, 2, camera=SHORT, frame_stride=20, workers=1, horizon=60, expert_share=share)
    config = DemoConfig(**(vars(config) | {"policy": acts.sha256}))
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
    words = ("policy=vision", "method=early_unverified", "task=reach", f"name={tmp_path / 'visited'}", "episodes=1")
    short = ("world.horizon=12", "expert_share=0", "frame_stride=4", "runtime.workers=1")
    kerv("demos", *words, *short)
    episode = DemoDataset.open(tmp_path / "visited").load(0)
    settings = compose("rollout", ["method=early_unverified"], RolloutSettings)
    decoder, world = decoder_for(settings, "reach-v3"), SPEC.open_world("reach-v3", SHORT)
    world.reset(0)
    decoder.reset("reach-v3", 0, world.end_effector)
    first = decoder.decode(world.observe(decoder.cameras)).actions
    world.close()
    np.testing.assert_allclose(episode.executed[: len(first)], first, atol=1e-6)


@pytest.mark.parametrize("method", ["ar", "early_unverified"])
def test_the_chunk_counts_and_is_executed(method):
    words = ["policy=vision", f"method={method}"]
    whole, two = (PolicyActs.of(compose("demos", [*words, f"chunk={n}"], DemosSettings), SPEC) for n in (0, 2))
    assert whole.sha256 != two.sha256
    decoder = two(DemoConfig(("reach-v3",), 1, camera=SHORT)).decoder_of("reach-v3")
    assert (decoder.steps, decoder.target.chunk > 2) == (2, True)


@pytest.mark.parametrize(
    ("target", "spec", "camera", "says"),
    [
        ("mt10-vision", SPEC, CameraSettings(name="corner4+gripperPOV:75"), ""),
        ("mt10-vision", SPEC, CameraSettings(name="corner"), "world.camera.name"),
        ("mt10-vision", SPEC, CameraSettings(name="corner4:60"), "world.camera.name"),
        ("mt10-vision", SPEC, CameraSettings(size=48), "world.camera.size=48"),
        ("mt10-state", spec_of("insert-peg"), CameraSettings(), "target 'mt10-state'"),
    ],
)
def test_only_further_views_may_differ_from_what_the_target_was_trained_on(target, spec, camera, says):
    with pytest.raises((UsageError, CheckpointError), match=says) if says else nullcontext():
        assert acts_of(target, spec, WorldSettings(camera=camera)).sha256
