"""Frames of several views: their names, what a world draws, recordings, the policy that sees them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command import kerv, told

from kerv_cli.base.config import compose
from kerv_cli.base.errors import CheckpointError, UnknownName, UsageError
from kerv_cli.base.files import sha256_of
from kerv_cli.base.spaces import Observation
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.settings import TargetSettings
from kerv_cli.training.settings import TrainTargetSettings
from kerv_cli.training.target import check_init, continued_target, vocabulary
from kerv_cli.worlds.demos.dataset import DemoDataset
from kerv_cli.worlds.metaworld.spec import SPEC
from kerv_cli.worlds.metaworld.world import MetaWorld
from kerv_cli.worlds.settings import CameraSettings
from kerv_cli.worlds.stress import NO_STRESS, Stress
from kerv_cli.worlds.views import View, frame_shape, views_of

SIZE = 32
HAND = "corner4+gripperPOV:75"


@pytest.fixture(scope="module")
def world():
    made = SPEC.open_world("drawer-close", CameraSettings(HAND, size=SIZE, supersample=1))
    assert isinstance(made, MetaWorld)
    with made:
        yield made


def test_a_name_says_cameras_and_fields_of_view():
    assert views_of("corner4") == [View("corner4", "corner4", None)]
    assert views_of("a+b:75.5+b:60") == [View("a", "a", None), View("b:75.5", "b", 75.5), View("b:60", "b", 60.0)]
    assert frame_shape("a+b", 96) == (96, 192, 3)
    assert frame_shape("", 96) == (96, 96, 3)


@pytest.mark.parametrize("name", ["a+", "+a", "a@4", "a:0", "a:180", "a:", "a:x", "a:²"])
def test_a_name_that_says_none_of_them_is_refused(name):
    with pytest.raises(UsageError, match="is no view"):
        views_of(name)


def test_views_lie_side_by_side_as_their_cameras_draw_them(world):
    world.reset(0)
    left, right = np.split(world.frame(), 2, axis=1)
    assert left.tobytes() == world.frame(CameraSettings("corner4", size=SIZE, supersample=1)).tobytes()
    assert right.tobytes() == world.frame(CameraSettings("gripperPOV", 75.0, SIZE, 1)).tobytes()
    assert world.observe([HAND]).images[HAND].tobytes() == world.frame().tobytes()
    with pytest.raises(UnknownName, match="gripperPOW"):
        world.observe(["corner4+gripperPOW"])


def test_a_stress_changes_each_camera(world):
    class Numbered(Stress):
        def see(self, camera, image, step):
            return np.full_like(image, 10 * step + (camera == "gripperPOV:75"))

    world.stress = Numbered()
    try:
        world.reset(0)
        for step in range(5):
            image = world.observe([HAND]).images[HAND]
            assert [int(x) for x in image[0, ::SIZE, 0]] == [10 * step, 10 * step + 1]
            world.step(np.zeros(4))
    finally:
        world.stress = NO_STRESS


def small(*overrides: str) -> TargetSettings:
    return compose("train_target", ["target=nano", f"target.image_size={SIZE}", *overrides], TrainTargetSettings).target


def made(camera: str, seed: int = 0) -> CompactTarget:
    torch.manual_seed(seed)
    target = CompactTarget(small(), SPEC.actions, SPEC.observation, vocabulary(SPEC.name), camera)
    for parameter in target.parameters():
        if parameter.dim() == 1:
            parameter.data += 0.1 * torch.rand(parameter.shape)
    return target.eval().requires_grad_(False)


def shown(camera: str, seed: int = 0) -> Observation:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, frame_shape(camera, SIZE), dtype=np.uint8)
    return Observation(rng.normal(size=4), rng.normal(size=39), "close the drawer", {camera: image})


@pytest.mark.bits
def test_every_view_has_tokens_of_its_own():
    one, two = made("corner4"), made(HAND)
    cells = one.settings.grid**2
    assert two.segments["vision"] == slice(0, 2 * cells)
    assert two.max_prompt == one.max_prompt + cells
    seen = shown(HAND)
    prompt, places = two.encode_batch(two.inputs(seen))
    changed = seen.images[HAND].copy()
    changed[:, SIZE:] = 255 - changed[:, SIZE:]
    other, moved = two.encode_batch(two.inputs(seen.with_images({HAND: changed})))
    assert torch.equal(prompt[:, :cells], other[:, :cells])
    assert not torch.allclose(prompt[:, cells : 2 * cells], other[:, cells : 2 * cells])
    assert not torch.allclose(places, moved)


def test_a_frame_of_other_views_is_refused():
    seen = shown("corner4")
    with pytest.raises(CheckpointError, match=r"\(32, 32, 3\), the target takes \(32, 64, 3\)"):
        made(HAND).encode(seen.with_images({HAND: seen.images["corner4"]}))


@pytest.mark.bits
def test_a_view_is_added_to_a_trained_policy_without_moving_its_estimates():
    one = made("corner4", seed=3)
    two = continued_target(one.settings, one, HAND).eval()
    seen = shown(HAND)
    left = seen.with_images({"corner4": seen.images[HAND][:, :SIZE]})
    ours, places = two.encode_batch(two.inputs(seen))
    theirs, expected = one.encode_batch(one.inputs(left))
    cells = one.settings.grid**2
    assert torch.allclose(places, expected, atol=1e-6)  # zeros more to add, in blocks of another length on some CPUs
    assert torch.equal(ours[:, :cells], theirs[:, :cells])
    assert torch.allclose(ours[:, 2 * cells :], theirs[:, cells:], atol=1e-4)
    alike = seen.with_images({HAND: np.tile(seen.images[HAND][:, :SIZE], (1, 2, 1))})
    assert torch.equal(*two.encode(alike)[:, : 2 * cells].split(cells, 1))
    # further training reaches the new encoder
    two.requires_grad_(True)
    two.encode_batch(two.inputs(seen))[1].sum().backward()
    assert two.locate[0].weight.grad[:, 2 * one.settings.keypoints : 4 * one.settings.keypoints].abs().sum() > 0


def test_training_goes_on_only_with_views_behind_those_it_has():
    one = made("corner4")
    described = type("D", (), {"settings": vars(one.settings), "cameras": one.cameras})()
    for camera in ("corner4", HAND):
        check_init(one.settings, camera, described, Path("x"))
    check_init(replace(one.settings, norm="instance"), HAND, described, Path("x"))  # its weights have the same shapes
    for camera in ("corner", "gripperPOV+corner4", "corner4:60"):
        with pytest.raises(UsageError, match="sees corner4"):
            check_init(one.settings, camera, described, Path("x"))


def weights_of(results: Path, name: str) -> str:
    return sha256_of(results / "artifacts/target" / name / "model.safetensors")


@pytest.mark.usefixtures("quick_training")
def test_from_recording_to_rollout(tmp_path):
    """Every command of a policy that sees two views, as docs/training.md gives them, small."""
    common = ["task=drawer-close", f"world.camera.name={HAND}", "world.camera.size=32", f"results={tmp_path}"]

    told("demos", "name=two", "episodes=2", "frame_stride=4", "runtime.workers=1", *common)
    dataset = DemoDataset.open(tmp_path / "artifacts/demos/two")
    frames = dataset.load(0).frames
    assert frames.shape[1:] == (SIZE, 2 * SIZE, 3)
    assert np.asarray(frames).shape == frames.shape
    sizes = ["target=nano", "target.image_size=32"]
    steps = ["train.steps=2", "train.batch=2", "train.validate_every=2"]
    one = [word for word in common if "camera.name" not in word]
    told("demos", "name=one", "episodes=2", "frame_stride=4", "runtime.workers=1", *one)
    told("train", "target", "name=first", "demos=one", *sizes, *steps, *one)
    told("train", "target", "name=seen", "demos=two", "train.init=first", *sizes, *steps, *common)
    # the recording's first view alone is what a recording of this view shows
    told("train", "target", "name=left", "demos=two", *sizes, *steps, *one)
    assert weights_of(tmp_path, "left") == weights_of(tmp_path, "first")
    early = ["train", "drafter", "drafter=early", "demos=two", "drafter.samples=8", *steps, common[-1]]
    described = json.loads((tmp_path / "artifacts/target/seen/target.json").read_text())
    assert described["cameras"] == [HAND]
    told(*early, "policy.target=seen")
    told("rollout", "policy.target=seen", "method=ar", "episodes=1", "world.horizon=8", "record=1", *common)
    for camera, name in (("gripperPOV:75", "two"), (HAND, "one")):
        asked = [f"world.camera.name={camera}", "world.camera.size=32", common[0], common[-1]]
        wrong = kerv("train", "target", "name=wrong", f"demos={name}", *sizes, *steps, *asked, code=1)
        assert f"the policy would be shown {camera}" in wrong.output
    another = kerv("train", "target", "name=left", "demos=two", *sizes, *steps, *common, code=2)
    assert "holds a run with other settings or data" in another.output
    for words in (
        ["train", "drafter", "drafter=early", "policy.target=seen", "demos=one", *steps, common[-1]],
        ["train", "drafter", "policy.target=seen", "demos=one", *steps, common[-1]],
        ["build", "datastore", "policy.target=seen", "demos=one", common[0], common[-1]],
        ["calibrate", "policy.target=seen", "demos=one", common[0], common[-1]],
    ):
        refused = kerv(*words, code=1)
        assert "show camera corner4, the target sees corner4+gripperPOV:75" in " ".join(refused.output.split())
    visits = ["demos", "policy=vision", "policy.target=seen", "name=visits", "episodes=1", "runtime.workers=1"]
    lone = kerv(*visits, *one, code=2)
    assert "set world.camera.name=corner4+gripperPOV:75" in " ".join(lone.output.split())
    told(*visits, "world.horizon=20", "expert_share=0.5", *common)
    both = ["train", "target", "name=both", "demos=two+visits", "train.places=path", *sizes, *steps, *common]
    assert "train.scene_weight=0" in told(*both, code=2)
    told(*both, "train.scene_weight=0")
