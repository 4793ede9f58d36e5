"""Drafts from a part of what the target knows: from demonstrations of some of the tasks to a study's plan."""

import json
import re

import pytest
from command import kerv, told
from test_calibration import write_dataset

from kerv_cli.base.config import conf_dir
from kerv_cli.base.files import read_yaml_lines
from kerv_cli.worlds import resolve_tasks


@pytest.mark.parametrize(
    ("words", "command"),
    [
        ("policy.artifacts.scout=m method=scout_unverified", "train drafter drafter=scout policy.target=mt10-vision"),
        ("policy.artifacts.certificate=m method=one_pass_certified", "calibrate success policy.target=mt10-vision"),
    ],
)
def test_a_missing_artifact_with_a_name_is_answered_with_the_command_that_makes_it(words, command, tmp_path):
    run = kerv("rollout", *words.split(), f"results={tmp_path / 'results'}", code=1)
    assert f"kerv {command} {words.split()[0]}" in run.stderr


@pytest.mark.usefixtures("quick_training")
def test_drafts_of_seven_tasks_are_made_as_the_note_of_their_study_says(results):
    write_dataset(results / "artifacts/demos/mt10", episodes=2, names=resolve_tasks(["MT10"]))

    def run(*words):
        return told(*words, f"results={results}")

    study, _ = read_yaml_lines(conf_dir() / "study/coverage_unseen.yaml", "the study")
    making = re.findall(r"kerv (train drafter .*?\])", study["note"])
    few = ("train.steps=2", "train.batch=8", "train.validate_every=2", "drafter.samples=50")
    target = "policy.target=nano-state"
    run(*making[0].split(), target, *few)
    made = json.loads((results / "artifacts/early/seven/early.json").read_text())
    seen = set(made["provenance"]["settings"]["task"])
    assert len(seen) == 7
    planned = run("sweep", "study=coverage_unseen", target, "--plan")
    assert not any(task in planned for task in seen)
