"""Files and demonstrations that were made for other actions: every command refuses them in one line."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kerv_cli.cli.app import app
from kerv_cli.methods.artifacts import MadeFor
from kerv_cli.methods.early import EarlySettings
from kerv_cli.methods.early.drafter import EarlyArtifact, EarlyDrafter
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.worlds.demos.recording import DemoConfig, record

TARGET = "policy.target=nano-state"


def kerv(*words: str) -> tuple[int, list[str]]:
    """Exit code and the lines that begin as kerv's own messages."""
    run = CliRunner().invoke(app, [*words])
    assert "Traceback" not in run.output
    return run.exit_code, [line for line in run.output.splitlines() if line.startswith("kerv:")]


def refusal(*words: str) -> str:
    """The one line of a command that exits with code 1."""
    code, lines = kerv(*words)
    assert (code, len(lines)) == (1, 1), lines
    return lines[0]


@pytest.fixture(scope="module")
def results(policies: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of Meta-World with every kind of artifact, and demonstrations of both environments."""
    results = tmp_path_factory.mktemp("spaces") / "results"
    shutil.copytree(policies, results)
    for task, name in (("drawer-close-v3", "drawer"), ("insert-peg", "pegs")):
        record(DemoConfig((task,), 4, frame_stride=16, workers=1), results / "artifacts/demos" / name)
    target, described = load_target(results / "artifacts/target/nano-state")
    early = EarlyDrafter.beside(EarlySettings(layers=1, width=16, rank=4), target)
    folder, own = results / "artifacts/early/nano-state", {"settings": asdict(early.settings)}
    EarlyArtifact().save(folder, early, MadeFor.of(described), {}, **own)
    common = [TARGET, "task=drawer-close", "demos=drawer", f"results={results}"]
    assert kerv("build", "datastore", *common) == (0, [])
    assert kerv("calibrate", *common, "held_out=0.5", "decodes=0") == (0, [])
    return results


def rollout(results: Path, *words: str) -> list[str]:
    return [
        "rollout",
        "policy=state",
        TARGET,
        "episodes=1",
        "world.horizon=8",
        "record=0",
        f"results={results}",
        *words,
    ]


@pytest.mark.parametrize(
    ("path", "method"),
    [
        ("drafter/nano-state/drafter.json", "spec_vla"),
        ("early/nano-state/early.json", "one_pass_strict"),
        ("datastore/nano-state/manifest.json", "spec_vla proposer=retrieval"),
        ("calibration/nano-state/calibration.json", "spec_vla proposer=kalman"),
    ],
)
def test_a_rollout_refuses_an_artifact_of_other_actions(results: Path, tmp_path: Path, path: str, method: str) -> None:
    copy = Path(shutil.copytree(results, tmp_path / "results"))
    words = rollout(copy, "task=drawer-close", *f"method={method}".split())
    assert kerv(*words, "--plan") == (0, [])
    file = copy / "artifacts" / path
    value = json.loads(file.read_text())
    (value if "actions" in value else value["target"])["actions"]["strict"] = ["dz"]
    file.write_text(json.dumps(value))
    assert "action space with strict" in refusal(*words)


def test_a_rollout_refuses_a_target_of_other_actions(results: Path) -> None:
    assert "target 'nano-state' has an action space with names dx, dy, dz, gripper, environment insertion one with" in (
        refusal(*rollout(results, "task=insert-peg"))
    )


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
