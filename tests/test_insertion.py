"""The example with a simulator, and `kerv doctor` on targets and environments that break the protocol."""

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from command import kerv
from examples.insertion import SPEC
from examples.insertion.world import InsertionWorld
from examples.own_policy import OwnPolicy, Remembered
from mock_target import MockTarget
from test_decoding_lossless import RandomTrees, decode, plain_greedy

from kerv_cli.base.spaces import Observation
from kerv_cli.targets.conformance import check_target
from kerv_cli.worlds.conformance import check_environment
from kerv_cli.worlds.demos.dataset import DemoDataset
from kerv_cli.worlds.demos.recording import DemoConfig, record
from kerv_cli.worlds.findings import Finding
from kerv_cli.worlds.settings import CameraSettings

TASKS = tuple(SPEC.tasks)
ROTATION = slice(3, 6)
SMALL = CameraSettings(size=48, supersample=1)


@pytest.mark.parametrize("task", TASKS)
def test_the_expert_succeeds(task):
    with SPEC.open_world(task) as world:
        for seed in range(8):
            expert, observation = SPEC.expert(task), world.reset(seed)
            while not world.done:
                observation = world.step(expert(observation))
            assert world.succeeded


def test_demonstrations_carry_their_spaces(tmp_path):
    config = DemoConfig(("INSERTION",), episodes=4, camera=SMALL, frame_stride=10, workers=1, tail=5)
    assert (config.camera.name, config.horizon) == ("front", 120)
    record(config, tmp_path)
    demonstrations = DemoDataset.open(tmp_path)
    manifest = demonstrations.manifest
    assert (manifest.actions, manifest.observation) == (SPEC.actions, SPEC.observation)
    assert set(manifest.versions) == {"mujoco", "numpy", "python"}
    assert [entry.task for entry in demonstrations.episodes] == [task for task in TASKS for _ in range(4)]
    for index, entry in enumerate(demonstrations.episodes):
        episode = demonstrations.load(index)
        assert episode.states.shape == (entry.steps, 19)
        assert episode.labels.shape == (entry.steps + 5, 7)
        low, high = np.float32(SPEC.actions.low), np.float32(SPEC.actions.high)
        for actions in (episode.labels, episode.executed):
            assert ((actions >= low) & (actions <= high)).all()
        noise = np.abs(episode.executed - episode.labels[: entry.steps])
        assert noise[:, 6].max() == 0.0  # the gripper stays clean
        assert (noise[:, ROTATION].max() > 0.01) == entry.perturbed


# --- conformance

SEEN = Observation(np.array([0.3]), np.zeros(0), "push the red block gently away")


def failures(found: list[Finding]) -> dict[str, str]:
    return {finding.what: finding.says for finding in found if not finding.ok}


@pytest.mark.parametrize("target", [OwnPolicy(), MockTarget(chunk=1)], ids=["own_policy", "mock"])
def test_the_examples_keep_the_protocol(target):
    found = check_target(target, SEEN)
    assert failures(found) == {}
    assert len(found) == 9


@pytest.mark.bits
def test_the_example_without_a_cache_is_decoded_losslessly():
    target = OwnPolicy()
    prompt = target.encode(SEEN)
    truth = plain_greedy(target, prompt)
    for seed in range(5):
        assert decode(target, RandomTrees(truth, seed, 12, 255), prompt).tokens == truth


class Forgetful(Remembered):
    """Does not move a path's entries."""

    def compact(self, start: int, slots: torch.Tensor) -> None:
        self.length = start + len(slots)


class Right(OwnPolicy):
    """Where a broken target does what it should."""

    right = OwnPolicy.forward


def every(x: torch.Tensor, seen: np.ndarray | None) -> np.ndarray:
    """A token sees those after it, unless it is told."""
    return np.ones((x.shape[1],) * 2, dtype=bool) if seen is None else seen


@pytest.mark.parametrize(
    ("member", "wrong", "what"),
    [
        ("forward", lambda t, x, p, cache=None, seen=None: t.right(x, p, cache), "tree attention"),
        ("forward", lambda t, x, p, c=None, seen=None: t.right(x, torch.arange(len(p)) if c else p, c, seen), "cache"),
        ("forward", lambda t, x, p, c=None, seen=None: t.right(x, p, c, every(x, seen)), "causality"),
        ("new_cache", lambda t, batch, capacity: Forgetful(batch, capacity, t.width), "commit of a path"),
        ("encode", lambda t, observation: OwnPolicy.encode(t, observation) + torch.randn(()), "encode"),
        ("head", lambda t, hidden: hidden, "embed and head"),
        ("encode", lambda t, observation: torch.zeros(1, t.max_prompt + 1, t.width), "encode"),
        ("cameras", property(), "members"),
    ],
)
def test_every_way_of_breaking_it_is_found(member, wrong, what):
    target = type("Broken", (Right,), {member: wrong})()
    assert what in failures(check_target(target, SEEN))


def test_doctor_checks_a_policy_on_disk(policies):
    for name, code, says in (("nano-state", 0, "tree attention"), ("nothing", 2, "no target 'nothing'")):
        run = kerv("doctor", f"target={name}", f"results={policies}", code=code)
        assert says in run.output


# --- environments


def test_insertion_keeps_the_protocol():
    found = check_environment(SPEC, 100_000)
    assert failures(found) == {}
    assert len(found) == 5


class Noisy(InsertionWorld):
    """Physics that differ from run to run."""

    def _advance(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        state, success = super()._advance(action)
        return state + np.random.default_rng().normal(size=state.shape), success


class Blank(InsertionWorld):
    """A camera that sees nothing."""

    def _draw(self, camera: Any) -> np.ndarray:
        return np.zeros((camera.size, camera.size, 3), dtype=np.uint8)


class Greedy(InsertionWorld):
    """A start that does not depend on the seed."""

    def _start(self, seed: int) -> np.ndarray:
        return super()._start(3)


@pytest.mark.parametrize(
    ("world", "what"), [(Noisy, "same seed, same episode"), (Blank, "frames"), (Greedy, "another seed, another start")]
)
def test_a_broken_environment_is_found(monkeypatch, world, what):
    monkeypatch.setattr(sys.modules[__name__], "Chosen", world, raising=False)
    spec = replace(SPEC, world_class=f"{__name__}:Chosen", expert_class="")
    assert what in failures(check_environment(spec, 100_000))
