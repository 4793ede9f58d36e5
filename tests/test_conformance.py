"""`kerv doctor target=… environment=…`: good ones pass, and each way of breaking the protocol is found."""

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from examples.insertion import SPEC as INSERTION
from examples.insertion.world import InsertionWorld
from examples.own_policy import OwnPolicy, Remembered
from examples.own_target import MockTarget
from test_decoding_lossless import RandomTrees, decode, plain_greedy
from typer.testing import CliRunner

from kerv_cli.base.spaces import Observation
from kerv_cli.cli.app import app
from kerv_cli.targets.conformance import check_target
from kerv_cli.worlds.conformance import check_environment
from kerv_cli.worlds.findings import Finding

SEEN = Observation(np.array([0.3]), np.zeros(0), "push the red block gently away")


def failures(found: list[Finding]) -> dict[str, str]:
    return {finding.what: finding.says for finding in found if not finding.ok}


@pytest.mark.parametrize("target", [OwnPolicy(), MockTarget(chunk=1)], ids=["own_policy", "own_target"])
def test_the_examples_keep_the_protocol(target):
    found = check_target(target, SEEN)
    assert failures(found) == {}
    assert len(found) == 12


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


def broken(name: str) -> OwnPolicy:
    target: Any = OwnPolicy()

    def right(x, positions, cache=None, seen=None):
        return OwnPolicy.forward(target, x, positions, cache, seen)

    def everything(x):
        return np.ones((x.shape[1],) * 2, dtype=bool)

    wrong: dict[str, dict[str, Any]] = {
        "mask": {"forward": lambda x, p, cache=None, seen=None: right(x, p, cache)},
        "positions": {
            "forward": lambda x, p, cache=None, seen=None: right(x, torch.arange(len(p)) if cache else p, cache, seen)
        },
        "causality": {
            "forward": lambda x, p, cache=None, seen=None: right(x, p, cache, everything(x) if seen is None else seen)
        },
        "compact": {"new_cache": lambda batch, capacity: Forgetful(batch, capacity, target.width)},
        "training": {"encode": lambda observation: OwnPolicy.encode(target, observation) + torch.randn(())},
        "head": {"head": lambda hidden: hidden},
        "prompt": {"max_prompt": 3, "encode": lambda observation: torch.zeros(1, 5, target.width)},
        "members": {},
    }
    for attribute, value in wrong[name].items():
        setattr(target, attribute, value)
    if name == "members":
        del target.actions
    return target  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("mask", "tree attention"),
        ("positions", "cache, token by token"),
        ("causality", "causality"),
        ("compact", "commit of a path"),
        ("training", "encode"),
        ("head", "embed and head"),
        ("prompt", "encode"),
        ("members", "members"),
    ],
)
def test_every_way_of_breaking_it_is_found(name, what):
    assert what in failures(check_target(broken(name), SEEN))


def test_doctor_checks_a_policy_on_disk(policies):
    for name, code, says in (("nano-state", 0, "tree attention"), ("nothing", 2, "no target 'nothing'")):
        run = CliRunner().invoke(app, ["doctor", f"target={name}", f"results={policies}"])
        assert run.exit_code == code, run.output
        assert says in run.output


# --- environments


def test_insertion_keeps_the_protocol():
    found = check_environment(INSERTION, 100_000)
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
    ("world", "what"),
    [(Noisy, "same seed, same episode"), (Blank, "frames"), (Greedy, "another seed, another start")],
)
def test_a_broken_environment_is_found(monkeypatch, world, what):
    monkeypatch.setattr(sys.modules[__name__], "Chosen", world, raising=False)
    spec = replace(INSERTION, world_class=f"{__name__}:Chosen", expert_class="")
    assert what in failures(check_environment(spec, 100_000))
