"""Training: a run that is killed and started again ends where the uninterrupted one does; losses are what they say."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from kerv_cli.environments.camera import CameraConfig
from kerv_cli.environments.demos.recording import DemoConfig, record
from kerv_cli.errors import CheckpointError
from kerv_cli.settings import DrafterSettings, TargetSettings, TrainSettings
from kerv_cli.spaces import ActionTokenizer
from kerv_cli.targets.compact.target import Target
from kerv_cli.training.distillation import greedy
from kerv_cli.training.imitation import soft_labels, token_loss, vocabulary
from kerv_cli.training.loop import Job, Loop, Metrics, schedule

TINY = TrainSettings(steps=12, batch=4, lr=0.01, warmup=2, validate_every=4, ema=0.9)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with a few real demonstrations of one task."""
    folder = tmp_path_factory.mktemp("training")
    config = DemoConfig(("drawer-close-v3",), 6, camera=CameraConfig(), frame_stride=8, workers=1)
    record(config, folder / "artifacts/demos/few")
    return folder


def quadratic(folder: Path, identity: str = "a") -> Loop:
    torch.manual_seed(0)
    module = nn.Linear(3, 1)
    data = torch.randn(50, 3, generator=torch.Generator().manual_seed(1))

    def loss(indices: torch.Tensor, step: int) -> tuple[torch.Tensor, Metrics]:
        x = data[indices]
        return ((module(x) - x.sum(-1, keepdim=True)) ** 2).mean(), {}

    job = Job(module, 50, loss, lambda m: {"score": -float(m.weight.detach().sum())}, lambda m, metrics: None)
    return Loop(job, TINY, folder, identity)


def test_an_interrupted_run_resumes_bit_for_bit(tmp_path: Path) -> None:
    whole = quadratic(tmp_path / "whole")
    whole.run()
    cut = quadratic(tmp_path / "cut")
    with pytest.raises(KeyboardInterrupt):
        cut.run(lambda step, metrics: interrupt() if step == 10 else None)
    resumed = quadratic(tmp_path / "cut")
    resumed.run()
    for name, tensor in whole.job.module.state_dict().items():
        assert torch.equal(tensor, resumed.job.module.state_dict()[name])
        assert torch.equal(whole.ema[name], resumed.ema[name])
    assert (tmp_path / "whole/log.csv").read_text() == (tmp_path / "cut/log.csv").read_text()


def interrupt() -> None:
    raise KeyboardInterrupt


def test_another_run_is_never_resumed(tmp_path: Path) -> None:
    quadratic(tmp_path).run()
    with pytest.raises(CheckpointError, match="other settings or data"):
        quadratic(tmp_path, "b").run()


def test_the_schedule_warms_up_and_decays_in_both_phases() -> None:
    settings = TrainSettings(steps=100, warmup=10, scene_steps=40)
    rates = [schedule(step, settings) for step in range(100)]
    assert rates[9] == rates[49] == 1.0
    assert rates[39] < 0.05
    assert rates[99] < 0.03
    assert rates[0] == rates[40] == 0.1


def test_soft_labels_are_distributions_that_fall_off_with_distance() -> None:
    labels = soft_labels(1.5)
    assert torch.allclose(labels.sum(-1), torch.ones(len(labels)), atol=1e-5)
    assert labels[100, 100] > labels[100, 101] > labels[100, 103]
    assert labels[100, 101] / labels[100, 100] == pytest.approx(np.exp(-1 / (2 * 1.5**2)), rel=1e-4)
    logits, tokens = torch.randn(2, 3, 255), torch.randint(0, 255, (2, 3))
    plain = nn.functional.cross_entropy(logits.flatten(0, 1), tokens.flatten())
    assert torch.allclose(token_loss(logits, tokens, soft_labels(0.0)), plain)


def test_batched_greedy_decoding_is_the_decoders() -> None:
    from kerv_cli.decoding.decoder import Decoder
    from kerv_cli.settings import MethodSettings

    torch.manual_seed(0)
    settings = TargetSettings(observation="state", width=32, layers=2, heads=2, feed_forward=48, scene_tokens=2)
    target = Target(settings, ActionTokenizer(-np.ones(4), np.ones(4)), vocabulary()).eval().requires_grad_(False)
    prompts = torch.randn(3, target.prompt_length, 32)
    tokens, hidden = greedy(target, prompts)
    assert hidden.shape == (3, target.prompt_length + target.tokens_per_chunk - 1, 32)
    decoder = Decoder(target, MethodSettings())
    for prompt, expected in zip(prompts.split(1), tokens, strict=True):
        assert decoder.decode_prompt(prompt).tokens == expected.tolist()


def train(results: Path, *arguments: str) -> list[str]:
    return [
        sys.executable,
        "-W",
        "ignore",
        "-m",
        "kerv_cli.app",
        "train",
        *arguments,
        f"results={results}",
        "demos=few",
    ]


def test_a_killed_training_run_goes_on_and_matches_the_uninterrupted_one(results: Path) -> None:
    settings = [
        "target=nano",
        "target.observation=state",
        "task=drawer-close",
        "train.batch=8",
        "train.validate_every=5",
    ]
    command = train(results, "target", *settings, "train.steps=25")
    whole = subprocess.run([*command, "name=whole"], capture_output=True, text=True, timeout=200)
    assert whole.returncode == 0, whole.stderr
    killed = subprocess.Popen([*command, "name=cut"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    folder = results / "artifacts/target/cut"
    deadline = time.monotonic() + 100
    while not (folder / "progress.json").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    assert json.loads((folder / "progress.json").read_text())["step"] <= 25
    resumed = subprocess.run([*command, "name=cut"], capture_output=True, text=True, timeout=200)
    assert resumed.returncode == 0, resumed.stderr
    a, b = (load_file(results / f"artifacts/target/{n}/model.safetensors") for n in ("whole", "cut"))
    assert a.keys() == b.keys()
    assert all(torch.equal(a[k], b[k]) for k in a)


def test_vision_target_and_its_drafter_train_from_the_command_line(results: Path) -> None:
    settings = ["target=nano", "task=drawer-close", "train.batch=4", "train.steps=6", "train.scene_steps=2"]
    settings += ["train.validate_every=3", "train.closed_loop=1", "world.horizon=8"]
    first = subprocess.run(
        train(results, "target", "name=seen", *settings),
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert first.returncode == 0, first.stderr
    assert "closed_loop_success" in first.stdout
    drafter = ["train.steps=4", "train.batch=4", "train.validate_every=2", "drafter.samples=20", "drafter.noise=0.1"]
    second = subprocess.run(
        train(results, "drafter", "policy.target=seen", *drafter), capture_output=True, text=True, timeout=300
    )
    assert second.returncode == 0, second.stderr
    assert "acceptance_length_r9" in second.stdout
    described = json.loads((results / "artifacts/drafter/seen/drafter.json").read_text())
    target = json.loads((results / "artifacts/target/seen/target.json").read_text())
    assert described["target"] == target["sha256"]
    assert DrafterSettings(**described["settings"]).noise == 0.1
