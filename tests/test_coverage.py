"""Drafts from a part of what the target knows: the presets, and from demonstrations to a study's plan."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from test_calibration import write_dataset
from typer.testing import CliRunner

from kerv_cli.base.config import compose, conf_dir
from kerv_cli.base.files import read_yaml
from kerv_cli.base.settings import (
    BuildDatastoreSettings,
    RolloutSettings,
    TrainDrafterSettings,
)
from kerv_cli.cli.app import app
from kerv_cli.worlds import resolve_tasks

COVERS = {"three": 3, "five": 5, "seven": 7}
COMMANDS = {
    "train_drafter": TrainDrafterSettings,
    "build_datastore": BuildDatastoreSettings,
    "rollout": RolloutSettings,
}


def covers_tasks(cover: str, command: str = "rollout") -> tuple[str, ...]:
    return resolve_tasks(compose(command, [f"cover={cover}"], COMMANDS[command]).task)


def test_every_part_is_one_of_the_next_larger_and_none_is_of_the_unseen_tasks() -> None:
    nested = [set(covers_tasks(cover)) for cover in COVERS] + [set(resolve_tasks(["MT10"]))]
    assert [len(part) for part in nested] == [*COVERS.values(), 10]
    assert nested[0] < nested[1] < nested[2] < nested[3]
    study = read_yaml((conf_dir() / "study/coverage_unseen.yaml").read_text())
    unseen = compose("rollout", study["common"].split(), RolloutSettings).task
    assert not nested[2] & set(resolve_tasks(unseen))


def test_thirty_five_of_fifty_tasks_are_in_one_study_and_the_others_in_the_other() -> None:
    tasks = [
        set(resolve_tasks(compose("rollout", study["common"].split(), RolloutSettings).task))
        for study in (
            read_yaml((conf_dir() / f"study/coverage_50_{part}.yaml").read_text()) for part in ("seen", "unseen")
        )
    ]
    assert tasks[0] == set(covers_tasks("thirty_five"))
    assert not tasks[0] & tasks[1]
    assert tasks[0] | tasks[1] == set(resolve_tasks(["MT50"]))


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("cover", [*COVERS, "thirty_five", "half"])
def test_a_preset_names_tasks_and_artifacts_alike_for_every_command(cover: str, command: str) -> None:
    settings = compose(command, [f"cover={cover}"], COMMANDS[command])
    kinds = ("drafter", "early", "scout", "datastore", "certificate")
    assert {settings.policy.named(kind) for kind in kinds} == {cover}
    if cover in COVERS:
        assert covers_tasks(cover, command) == covers_tasks(cover)
        other = compose(command, [f"cover={cover}", "task=[reach]"], COMMANDS[command])
        assert (other.task, other.policy.early) == (["reach"], cover)


@pytest.mark.parametrize(
    ("words", "command"),
    [
        ("cover=seven method=early_unverified", "train drafter drafter=early policy.target=mt10-vision cover=seven"),
        ("cover=five method=one_pass_certified", "calibrate success policy.target=mt10-vision cover=five"),
        ("policy.scout=m method=scout_unverified", "train drafter drafter=scout policy.target=mt10-vision"),
    ],
)
def test_a_missing_artifact_with_a_name_is_answered_with_the_command_that_makes_it(
    words: str, command: str, tmp_path: Path
) -> None:
    run = CliRunner().invoke(app, ["rollout", *words.split(), f"results={tmp_path / 'results'}"])
    assert run.exit_code == 1
    assert f"kerv {command}" in run.stderr


@pytest.fixture(scope="module")
def results(policies: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy and made-up demonstrations of all ten tasks."""
    folder = tmp_path_factory.mktemp("coverage") / "results"
    shutil.copytree(policies, folder)
    write_dataset(folder / "artifacts/demos/mt10", names=resolve_tasks(["MT10"]))
    return folder


@pytest.mark.usefixtures("few_validations")
@pytest.mark.parametrize(("cover", "study"), [("three", "coverage_3"), ("half", "coverage_half")])
def test_the_documented_commands_make_what_the_study_names(results: Path, cover: str, study: str) -> None:
    def kerv(*words: str) -> str:
        result = CliRunner().invoke(app, [*words, f"results={results}"])
        assert result.exit_code == 0, result.output
        return result.output

    policy, few = "policy.target=nano-state", ("train.steps=2", "train.batch=8", "train.validate_every=2")
    part = (f"cover={cover}", policy, *(("starts=half",) if cover == "half" else ()))
    kerv("train", "drafter", *part, *few, "drafter.samples=50")
    kerv("train", "drafter", "drafter=early", *part, *few, "drafter.samples=50")
    kerv("build", "datastore", *part, "stride=8")
    store = json.loads((results / "artifacts/datastore" / cover / "manifest.json").read_text())
    assert set(store["tasks"]) == set(resolve_tasks(["MT10"]) if cover == "half" else covers_tasks("three"))
    early = json.loads((results / "artifacts/early" / cover / "early.json").read_text())
    assert early["provenance"]["settings"]["starts"] == ("half" if cover == "half" else "all")
    settings = ("method=early_unverified", f"cover={cover}", "task=[reach]", policy, "episodes=1", "world.horizon=4")
    kerv("rollout", *settings, "record=0")
    found = CliRunner().invoke(app, ["sweep", f"study={study}", policy, "episodes=1", "--plan", f"results={results}"])
    assert found.exit_code == 0, found.output
    assert "early_unverified" in found.output
