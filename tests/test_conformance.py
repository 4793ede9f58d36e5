"""`kerv doctor target=… environment=…`: good ones pass, and each way of breaking the protocol is found."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
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

from kerv_cli.base.findings import Finding
from kerv_cli.base.spaces import Observation
from kerv_cli.cli.app import app
from kerv_cli.targets.conformance import check_target
from kerv_cli.worlds.conformance import check_environment

SEEN = Observation(np.array([0.3]), np.zeros(0), "push the red block gently away")


def failures(found: list[Finding]) -> dict[str, str]:
    return {finding.what: finding.says for finding in found if not finding.ok}


@pytest.mark.parametrize("target", [OwnPolicy(), MockTarget(chunk=1)], ids=["own_policy", "own_target"])
def test_the_examples_keep_the_protocol(target: Any) -> None:
    found = check_target(target, SEEN)
    assert failures(found) == {}
    assert len(found) == 12


@pytest.mark.bits
def test_the_example_without_a_cache_is_decoded_losslessly() -> None:
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
    right: Callable[..., torch.Tensor] = OwnPolicy.forward
    if name == "mask":
        target.forward = lambda x, positions, cache=None, seen=None: right(target, x, positions, cache)
    elif name == "positions":
        target.forward = lambda x, positions, cache=None, seen=None: right(
            target, x, positions if cache is None else torch.arange(len(positions)), cache, seen
        )
    elif name == "causality":
        target.forward = lambda x, positions, cache=None, seen=None: right(
            target, x, positions, cache, np.ones((x.shape[1],) * 2, dtype=bool) if seen is None else seen
        )
    elif name == "compact":
        target.new_cache = lambda batch, capacity: Forgetful(batch, capacity, target.width)
    elif name == "training":
        target.encode = lambda observation: OwnPolicy.encode(target, observation) + torch.randn(())
    elif name == "head":
        target.head = lambda hidden: hidden
    elif name == "prompt":
        target.max_prompt, target.encode = 3, lambda observation: torch.zeros(1, 5, target.width)
    else:
        target.embed = None
        del target.actions
    return target  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("name", "what", "said"),
    [
        ("mask", "tree attention", "sees others than its ancestors"),
        ("positions", "cache, token by token", "token by token behind a cache"),
        ("causality", "causality", "a token sees later ones"),
        ("compact", "commit of a path", "a token behind a committed path"),
        ("training", "encode", "gives another prompt the second time"),
        ("head", "embed and head", "finite (1, T, 255) are wanted"),
        ("prompt", "encode", "a prompt of 5 tokens, max_prompt is 3"),
        ("members", "members", "OwnPolicy lacks actions"),
    ],
)
def test_every_way_of_breaking_it_is_found(name: str, what: str, said: str) -> None:
    assert said in failures(check_target(broken(name), SEEN))[what]


def test_doctor_checks_a_policy_on_disk(policies: Path) -> None:
    run = CliRunner().invoke(app, ["doctor", "target=nano-state", f"results={policies}"])
    assert run.exit_code == 0, run.output
    assert "tree attention" in run.output
    run = CliRunner().invoke(app, ["doctor", "target=nothing", f"results={policies}"])
    assert run.exit_code == 2
    assert "kerv: no target 'nothing'" in run.output


# --- environments


def test_insertion_keeps_the_protocol() -> None:
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
    ("world", "what", "said"),
    [
        (Noisy, "same seed, same episode", "two episodes of seed 100000 differ by"),
        (Blank, "frames", "draws one colour"),
        (Greedy, "another seed, another start", "three seeds begin with the same initial_state"),
    ],
)
def test_a_broken_environment_is_found(
    monkeypatch: pytest.MonkeyPatch, world: type[InsertionWorld], what: str, said: str
) -> None:
    monkeypatch.setattr(sys.modules[__name__], "Chosen", world, raising=False)
    spec = replace(INSERTION, world_class=f"{__name__}:Chosen", expert_class="")
    assert said in failures(check_environment(spec, 100_000))[what]
