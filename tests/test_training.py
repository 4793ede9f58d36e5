"""Training: a run that is killed and started again ends where the uninterrupted one does; losses are what they say."""

import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command import kerv, refusal
from conftest import refused
from torch import nn

from kerv_cli.base import files
from kerv_cli.base.codes import FastCode
from kerv_cli.base.errors import CheckpointError, Interrupted
from kerv_cli.base.files import sha256_of
from kerv_cli.base.paths import RESUME
from kerv_cli.methods.drafters import TrainableDrafter
from kerv_cli.report.plots import save_curves
from kerv_cli.targets.checkpoint import load_target, save_tensors
from kerv_cli.targets.compact.target import CompactTarget, save_target
from kerv_cli.targets.losses import soft_labels, token_loss
from kerv_cli.targets.settings import TargetSettings
from kerv_cli.training.fit import Metrics, Progress, Save, batches, fit
from kerv_cli.training.settings import TrainSettings
from kerv_cli.training.target import Imitation, Samples, lit, vocabulary, waypoints_of
from kerv_cli.worlds.demos.files import DemoEpisode
from kerv_cli.worlds.metaworld.spec import SPEC

ACTIONS, OBSERVATION = SPEC.actions, SPEC.observation

TINY = TrainSettings(steps=12, batch=4, lr=0.01, warmup=2, validate_every=4, ema=0.9)


@pytest.fixture(scope="module")
def results(tmp_path_factory, recorded):
    """A results folder with a few real demonstrations of one task."""
    return Path(shutil.copytree(recorded, tmp_path_factory.mktemp("training") / "results"))


def ignored(*given: object) -> None:
    """Neither saves nor shows anything."""


def quadratic(
    folder: Path, progress: Progress = ignored, settings: TrainSettings = TINY, save: Save = ignored
) -> nn.Linear:
    """A linear layer that learns the sum of three numbers."""
    torch.manual_seed(0)
    network = nn.Linear(3, 1)
    data = torch.randn(50, 3, generator=torch.Generator().manual_seed(1))
    draw = batches(len(data), settings)

    def loss(step: int) -> tuple[torch.Tensor, Metrics]:
        x = data[draw(step)]
        return ((network(x) - x.sum(-1, keepdim=True)) ** 2).mean(), {}

    def validate(network: nn.Module) -> Metrics:
        return {"score": -float(next(network.parameters()).detach().sum())}

    fit(network, loss, validate, save, settings, folder, "a", progress)
    return network


@pytest.mark.bits
@pytest.mark.parametrize(("number", "last"), [(signal.SIGINT, 7), (signal.SIGTERM, 7), (signal.SIGINT, 2)])
def test_ctrl_c_saves_the_step_that_ran_and_the_run_goes_on_there(
    tmp_path, number, last
):  # step 2 comes before the first validation
    whole = quadratic(tmp_path / "whole")
    steps: list[int] = []

    def stop(step, total, text):
        if step == last:
            os.kill(os.getpid(), number)

    before = signal.signal(number, signal.default_int_handler)  # a test run in the background ignores Ctrl-C
    try:
        with pytest.raises(Interrupted, match=f"step {last} is saved"):
            quadratic(tmp_path / "cut", stop)
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, before)
    resumed = quadratic(tmp_path / "cut", lambda step, total, text: steps.append(step))
    assert steps[0] == last + 1
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, resumed.state_dict()[name])


def test_a_finished_training_that_is_repeated_changes_no_file(tmp_path, quick_training):
    """The time of its newest file is the training's own in `kerv runs list`."""
    seen = []
    for _ in range(2):
        quadratic(tmp_path)
        save_curves(tmp_path)
        seen.append({path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()})
    assert {"log.csv", "curves.png"} <= set(seen[0])
    assert seen[0] == seen[1]


def test_one_request_that_arrives_twice_is_one_and_a_run_without_validation_says_so(tmp_path):
    def stop(step, total, text):
        for _ in range(2):  # schedulers pass on what the process heard already
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(Interrupted):
        quadratic(tmp_path, stop)
    with pytest.raises(CheckpointError, match="before its first validation"):
        quadratic(tmp_path, settings=replace(TINY, steps=1))


def test_a_training_that_diverges_names_the_figure_and_the_remedy(tmp_path):
    with refused("loss is", "lower train.lr"):
        quadratic(tmp_path, settings=replace(TINY, lr=1e38, warmup=0))


def test_a_damaged_resume_file_is_one_line(tmp_path):
    network = quadratic(tmp_path)
    whole = (tmp_path / RESUME).read_bytes()
    index = whole.index(network.weight.detach().numpy().tobytes())
    for damaged in (whole[:index] + bytes([whole[index] ^ 1]) + whole[index + 1 :], whole[:-100], b"", b"{}"):
        (tmp_path / RESUME).write_bytes(damaged)
        with refused("damaged", error=CheckpointError):
            quadratic(tmp_path)


def test_a_kill_between_the_weights_and_the_resume_file_keeps_the_right_best(tmp_path, monkeypatch):
    """Cut at every write of a run: the one that goes on saves the best of the uninterrupted run."""
    writes: list[int] = []

    def saving(folder):
        quadratic(folder, save=lambda network, metrics: save_tensors(folder / "best", network.state_dict()))

    saving(tmp_path / "whole")
    best = (tmp_path / "whole/best").read_bytes()
    real = files.os.replace

    def counted(source, target):
        writes.append(1)
        if len(writes) == cut:
            raise KeyboardInterrupt
        real(source, target)

    monkeypatch.setattr(files.os, "replace", counted)
    for cut in range(1, 10):
        folder = tmp_path / str(cut)
        writes.clear()
        try:
            saving(folder)
        except KeyboardInterrupt:
            saving(folder)
        assert (folder / "best").read_bytes() == best
        assert (folder / "log.csv").read_bytes() == (tmp_path / "whole/log.csv").read_bytes()


def test_more_positions_than_the_embedding_has_are_refused():
    settings = TargetSettings(width=8, layers=1, heads=2, feed_forward=8, grid=32, image_size=256)
    with refused("target.grid=32 target.chunk=4: prompt and chunk have 1055 tokens in all, at most 1024 are possible"):
        CompactTarget(settings, ACTIONS, OBSERVATION, vocabulary("metaworld"), "corner4")


def test_weights_can_be_stored_in_fewer_bits(tmp_path):
    settings = TargetSettings(observation="state", width=64, layers=1, heads=2, feed_forward=96, scene_tokens=2)
    target = CompactTarget(settings, ACTIONS, OBSERVATION, vocabulary("metaworld"))
    sizes = {}
    for stored in ("float32", "float16", "int8"):
        digest = save_target(tmp_path / stored, target, "metaworld", {}, stored)
        loaded, description = load_target(tmp_path / stored)
        assert description.sha256 == digest == sha256_of(tmp_path / stored / "model.safetensors")
        sizes[stored] = (tmp_path / stored / "model.safetensors").stat().st_size
        for name, tensor in loaded.state_dict().items():
            wanted = target.state_dict()[name]
            assert tensor.dtype == torch.float32
            if stored == "int8" and wanted.dim() >= 2:
                rows = wanted.flatten(1)
                off = (tensor.flatten(1) - rows).abs().amax(1)
                assert (off <= 1.01 * rows.abs().amax(1) / 254 + 1e-6).all(), name
            else:
                assert torch.equal(tensor, wanted if stored == "float32" else wanted.half().float())
    assert sizes["float16"] < 0.6 * sizes["float32"]
    assert sizes["int8"] < 0.6 * sizes["float16"]


def test_soft_labels_are_distributions_that_fall_off_with_distance():
    labels = soft_labels(255, 1.5)
    assert torch.allclose(labels.sum(-1), torch.ones(len(labels)), atol=1e-5)
    assert labels[100, 100] > labels[100, 101] > labels[100, 103]
    assert labels[100, 101] / labels[100, 100] == pytest.approx(np.exp(-1 / (2 * 1.5**2)), rel=1e-4)
    logits, tokens = torch.randn(2, 3, 255), torch.randint(0, 255, (2, 3))
    plain = nn.functional.cross_entropy(logits.flatten(0, 1), tokens.flatten())
    assert torch.allclose(token_loss(logits, tokens, soft_labels(255, 0.0)), plain)


def test_random_light_depends_only_on_sample_and_step_and_moves_nothing():
    images = torch.randint(30, 60, (4, 3, 16, 32), dtype=torch.uint8)
    images[:, :, 5, 7] = 200  # a marker
    indices = torch.arange(4)
    changed = lit(images, indices, 3, 0.3)
    assert torch.equal(changed[2:], lit(images[2:], indices[2:], 3, 0.3))  # whatever the batch
    assert not torch.equal(changed, lit(images, indices, 4, 0.3))
    assert (changed != images).flatten(1).any(1).all()
    assert changed.flatten(2).argmax(-1).eq(5 * 32 + 7).all()
    assert torch.equal(lit(images, indices, 3, 0.0), images)


def test_waypoints_are_where_the_gripper_changes_next_and_where_the_episode_ends():
    states = np.zeros((10, 39), np.float32)
    states[:, :3] = np.arange(10)[:, None] + np.array([0, 0.1, 0.2])
    labels = np.zeros((13, 4), np.float32)
    labels[4:, 3] = 0.5  # closes
    labels[6:, 3] = 0.6  # holds
    labels[8:, 3] = 1.0  # closes further
    labels[10:, 3] = -1.0  # beyond the success
    frames, steps = np.zeros((10, 8, 8, 3), np.uint8), np.arange(10)
    episode = DemoEpisode("reach-v3", 0, False, 10, frames, steps, states, labels, labels[:10], np.zeros(3))
    two = waypoints_of(episode, np.array([0, 3, 4, 7, 8, 9]), 2, ACTIONS)
    assert two.shape == (6, 2, 3)
    assert two[:, 0, 0].tolist() == [4, 4, 8, 8, 9, 9]
    assert torch.equal(two[:, 1], torch.from_numpy(states[9, :3]).expand(6, 3))
    three = waypoints_of(episode, np.array([0, 5, 8]), 3, ACTIONS)
    assert three[:, :, 0].tolist() == [[4, 8, 9], [8, 9, 9], [9, 9, 9]]


@pytest.mark.usefixtures("quick_training")
def test_a_run_learns_the_experts_own_path(results):
    words = ["train", "target", "target=nano", "train=plain", "task=drawer-close", "train.batch=2", "train.steps=3"]
    words += ["train.validate_every=3", "demos=few", f"results={results}"]
    out = kerv(*words, "name=path", "train.scene_steps=1", "train.closed_loop=1", "world.horizon=4").stdout
    assert "closed_loop_success" in out
    assert "waypoint_1_error_cm" in out
    assert "object_error_cm" not in out
    assert "waypoint" not in kerv(*words, "name=none", "train.scene_weight=0").stdout
    assert "waypoint" in kerv(*words, "name=calm", "train.undisturbed=true").stdout


@pytest.mark.usefixtures("quick_training")
def test_demonstrations_that_are_all_disturbed_name_the_remedy(results, monkeypatch):
    monkeypatch.setattr(
        "kerv_cli.training.target.undisturbed", lambda episode, steps, chunk: np.zeros(len(steps), bool)
    )
    words = ["target=nano", "task=drawer-close", "demos=few", "name=none-left", f"results={results}"]
    assert "quiet=8" in refusal("train", "target", *words, "train.undisturbed=true", "target.chunk=4", code=1)


@pytest.mark.usefixtures("quick_training")
@pytest.mark.parametrize(("kind", "score"), [("drafter", "acceptance_length_r9"), ("early", "accepted_r9")])
def test_a_drafter_is_trained_for_the_target_in_the_number_format_that_is_recorded(
    demonstrated, monkeypatch, kind, score
):
    decoded = []
    examples = TrainableDrafter.examples

    def seen(self, target, *rest):
        decoded.append(target.dtype)
        return examples(self, target, *rest)

    monkeypatch.setattr(TrainableDrafter, "examples", seen)
    words = [f"drafter={kind}", "policy.target=nano-vision", f"policy.artifacts.{kind}=bf16", "demos=few"]
    words += ["task=drawer-close", "train.steps=2", "train.batch=2", "train.validate_every=2", "drafter.samples=8"]
    words += [f"results={demonstrated}", "runtime.device=cpu"]
    assert score in kerv("train", "drafter", *words, "runtime.dtype=bfloat16").output
    assert decoded == [torch.bfloat16]
    described = json.loads((demonstrated / f"artifacts/{kind}/bf16/{kind}.json").read_text())
    assert described["provenance"]["settings"]["runtime"]["dtype"] == "bfloat16"
    assert "another policy.artifacts" in refusal("train", "drafter", *words)


def test_a_target_is_not_said_to_be_trained_in_another_number_format(results):
    words = ["target=nano", "task=drawer-close", "name=half", "runtime.dtype=bfloat16", f"results={results}"]
    assert "remove runtime.dtype" in refusal("train", "target", *words, code=2)
    assert not (results / "artifacts/target/half").exists()


def test_padding_of_fast_chunks_does_not_count():
    """The loss and both shares are those of the tokens up to each chunk's end token, whatever the model says after."""
    random = np.random.default_rng(0)
    chunks = np.cumsum(random.normal(0, 0.2, (40, 4, 4)), 1).clip(-1, 1)
    chunks[::3] = 0.0  # one token and the end
    actions = replace(ACTIONS, low=(-1.0,) * 4, high=(1.0,) * 4, code=FastCode.learn(chunks))
    settings = TargetSettings(width=24, heads=2, layers=1, feed_forward=24, chunk=4, observation="state", code="fast")
    target = CompactTarget(settings, actions, OBSERVATION, vocabulary(SPEC.name), "corner4")
    count = len(chunks)
    samples = Samples(
        steps=torch.arange(count),
        words=torch.zeros(count, settings.instruction_tokens, dtype=torch.long),
        proprioception=torch.zeros(count, len(OBSERVATION.proprioception)),
        states=torch.zeros(count, OBSERVATION.state),
        frames=None,
        chunks=torch.from_numpy(chunks).float(),
        places=torch.zeros(count, len(OBSERVATION.places), 3),
        episodes=torch.arange(count),
        tasks=torch.zeros(count, dtype=torch.long),
    )
    imitation = Imitation(target, samples, replace(TINY, bf16=False, scene_weight=0.0, held_out=0.5))
    held = imitation.held_out
    tokens = imitation.tokens(held)
    own = torch.tensor([row.tolist().index(actions.end) + 1 for row in tokens])
    assert own.min() < tokens.shape[1]
    with torch.no_grad():
        logits = target.teacher_forced(held.inputs(target.device), tokens)[0]
    hits = [(logits[i, :n].argmax(-1) == tokens[i, :n]) for i, n in enumerate(own)]
    assert imitation.validate(target)["token_accuracy"] == pytest.approx(float(torch.cat(hits).float().mean()))
    indices = torch.arange(len(imitation.training))
    batch = imitation.training.where(indices)
    tokens = imitation.tokens(batch)
    logits = target.teacher_forced(batch.inputs(target.device), tokens)[0].log_softmax(-1)
    losses = [-logits[i, n, row[n]] for i, row in enumerate(tokens) for n in range(row.tolist().index(actions.end) + 1)]
    assert float(imitation.loss(indices, 0)[0].detach()) == pytest.approx(float(torch.stack(losses).mean().detach()))
