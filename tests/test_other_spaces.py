"""Files and demonstrations that were made for other actions: every command refuses them in one line."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kerv_cli.cli.app import app
from kerv_cli.worlds.demos.recording import DemoConfig, record

TARGET = "policy.target=nano-state"


def refusal(*words: str) -> str:
    """The one line of a command that exits with code 1."""
    run = CliRunner().invoke(app, [*words])
    lines = [line for line in run.output.splitlines() if line.startswith("kerv:")]
    assert (run.exit_code, len(lines)) == (1, 1), run.output
    return lines[0]


@pytest.fixture(scope="module")
def results(policies: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of Meta-World, and demonstrations of another environment."""
    results = tmp_path_factory.mktemp("spaces") / "results"
    shutil.copytree(policies, results)
    record(DemoConfig(("insert-peg",), 4, frame_stride=16, workers=1), results / "artifacts/demos/pegs")
    return results


def test_a_rollout_refuses_a_target_of_other_actions(results: Path) -> None:
    words = ["rollout", "policy=state", TARGET, "episodes=1", "record=0", f"results={results}", "task=insert-peg"]
    said = "target 'nano-state' has an action space with names dx, dy, dz, gripper, environment insertion one with"
    assert said in refusal(*words)


@pytest.mark.parametrize(
    ("command", "owner"),
    [
        (["train", "target", "task=drawer-close", "name=new", "target.observation=state"], "environment metaworld"),
        (["train", "drafter", TARGET], "the target"),
        (["train", "drafter", "drafter=early", TARGET], "the target"),
        (["build", "datastore", "task=drawer-close", TARGET], "the target"),
        (["calibrate", "task=drawer-close", TARGET], "the target"),
    ],
)
def test_demonstrations_of_another_environment_are_refused_at_once(
    results: Path, command: list[str], owner: str
) -> None:
    line = refusal(*command, "demos=pegs", f"results={results}", "--plan")
    assert "artifacts/demos/pegs has an action space with names dx, dy, dz, droll" in line
    assert f"{owner} one with dx, dy, dz, gripper" in line


def test_a_fine_tuned_target_must_be_of_the_demonstrations_environment(results: Path) -> None:
    words = ["train", "target", "task=insert-peg", "name=new", "target=nano", "target.observation=state"]
    words += ["train.init=nano-state", "demos=pegs", "world.camera.name=front", f"results={results}"]
    assert "the target in" in refusal(*words)
