"""A policy of one's own: it keeps its tasks and demonstrations, `kerv prepare` makes the rest; released policies."""

from __future__ import annotations

import errno
import json
import re
import shutil
import subprocess
import tarfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from command import told
from test_calibration import write_dataset

from kerv_cli.base import files, paths
from kerv_cli.base.config import conf_dir
from kerv_cli.base.files import read_yaml_lines
from kerv_cli.base.paths import RESUME
from kerv_cli.episodes.resolve import resolve, resolve_rollout
from kerv_cli.lab.database import opened
from kerv_cli.lab.runs import run_rows
from kerv_cli.report.plots import read_log
from kerv_cli.worlds import resolve_tasks

TASK = "reach-v3"
MINE = "policy.target=mine"


@pytest.fixture
def results(policies, tmp_path, monkeypatch):
    """A folder to work in, with the target `mine`, trained on one of the two tasks of the demonstrations `few`."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "results"
    for kind in ("target", "drafter"):
        shutil.copytree(policies / "artifacts" / kind / "nano-state", folder / "artifacts" / kind / "mine")
    path = folder / "artifacts/target/mine/target.json"
    described = json.loads(path.read_text())
    described["provenance"] |= {"settings": {"task": ["reach"], "demos": "few"}, "demos": {"config": {"episodes": 4}}}
    path.write_text(json.dumps(described))
    write_dataset(folder / "artifacts/demos/few", episodes=4, names=(TASK, "push-v3"))
    return folder


@pytest.mark.usefixtures("results")
@pytest.mark.parametrize("command", ["build datastore", "calibrate"])
def test_tasks_and_demonstrations_are_those_of_the_target(command):
    plan = " ".join(told(*command.split(), MINE, "--plan").split())
    assert "of 1 task" in plan
    assert re.search(r"about \d+ s \(from a few steps, measured now\)", plan)
    assert "2 tasks" in " ".join(told(*command.split(), MINE, "task=[reach,push]", "--plan").split())


def test_a_target_is_trained_on_the_demonstrations_that_are_named(results):
    train = ("train", "target", "name=new", "target=nano", "target.observation=state", "--plan")
    planned = told(*train, "demos=few")
    assert "8 demonstrations of 2 tasks, 6000 steps of 64 samples" in planned
    assert "measured now" in planned
    refused = told(*train, "demos=few", "task=drawer-open", code=1)
    assert "no episode of drawer-open-v3" in refused
    assert "'kerv demos task=drawer-open-v3'" in refused
    (results / "artifacts/demos/few").rename(results / "artifacts/demos/reach")
    assert "4 demonstrations of 1 task," in told(*train, "task=reach")


def test_missing_demonstrations_are_recorded_by_the_command_that_is_named(results):
    (results / "artifacts/demos/few").rename(results / "artifacts/demos/other")
    line = told("build", "datastore", MINE, code=1)
    assert "kerv demos name=few task=reach episodes=4'" in line
    assert "kerv demos name=few task=reach episodes=4'" in told("calibrate", MINE, "task=push", code=1)
    assert "kerv demos task=mt10'" in told("calibrate", MINE, "task=push", "demos=mt10", code=1)
    assert "kerv demos task=drawer-open'" in told("train", "target", "name=new", "demos=drawer-open", code=1)
    assert "demos=other" in line
    assert "kerv demos task=push'" in told("train", "target", "name=new", "task=push", code=1)


@pytest.mark.usefixtures("results")
def test_a_rollout_and_a_study_run_on_the_tasks_that_the_target_knows():
    def tasks(*words):
        (chosen,) = {tuple(one.task) for one in resolve(list(words)).settings.values()}
        return list(chosen)

    assert resolve_rollout([MINE], False).settings["ar"].task == [TASK]
    assert tasks("study=own", MINE) == [TASK]
    assert tasks("study=main", MINE) == [TASK]  # the study names ten
    assert tasks("study=demo", MINE) == [TASK]  # the target does not know the study's task
    assert tasks("study=main", MINE, "task=push") == ["push"]
    assert tasks("study=main") == ["MT10"]
    assert len(resolve_rollout(["policy=expert"], False).settings["expert"].task) == 10


@pytest.mark.usefixtures("quick_training")
def test_prepare_makes_what_is_missing_and_skips_what_is_there(results):
    plan = told("prepare", MINE, "--plan")
    words = [line.split() for line in plan.splitlines() if "│" in line]
    assert [(row[1], row[3]) for row in words] == [
        ("drafter", "there"), ("early", "missing"), ("datastore", "missing"), ("calibration", "missing"),
    ]  # fmt: skip
    missing = told("rollout", "method=heisd", MINE, code=1)
    assert f"kerv prepare {MINE}'" in missing
    done = told("prepare", MINE, "for=heisd,one_pass", "steps=2")
    assert "kerv sweep study=own policy.target=mine" in done
    for place in ("early/mine/early.json", "datastore/mine/manifest.json", "calibration/mine/calibration.json"):
        assert (results / "artifacts" / place).is_file()
    assert told("prepare", MINE, "--plan").count("there") == 4
    shutil.rmtree(results / "artifacts/datastore/mine")
    assert "missing" in told("prepare", MINE, "--plan")


@pytest.mark.parametrize(
    ("kind", "method"),
    {"early": "one_pass", "datastore": "retrieval_unverified", "calibration": "kerv", "drafter": "spec_vla"}.items(),
)
def test_the_remedy_for_a_missing_artifact_makes_it(results, kind, method):
    shutil.rmtree(results / f"artifacts/{kind}/mine", ignore_errors=True)
    rollout = ("rollout", f"method={method}", MINE)
    for named in ((), (f"policy.artifacts.{kind}=other",)):
        said = told(*rollout, *named, code=1)
        assert f"artifacts/{kind}/" in said
        remedy = re.findall(r"'kerv (.*?)'", said)[0]
        plan = told(*remedy.split(), "--plan")
        assert "other" in remedy if named else re.search(rf"{kind} +│ missing", plan)
    assert f"leave policy.artifacts.{kind}= out" in told(*rollout, f"policy.artifacts.{kind}=./none", code=1)


@pytest.mark.usefixtures("quick_training")
@pytest.mark.parametrize("file", [RESUME, "curves.png"])
def test_prepare_ends_with_all_files_after_a_full_disk(results, monkeypatch, file):
    replace = files.os.replace

    def full(source, target):
        if Path(target).name == file:
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(source, target)

    words = ("prepare", MINE, "for=one_pass", "steps=2")
    with monkeypatch.context() as patch:
        patch.setattr(files.os, "replace", full)
        assert "No space left" in told(*words, code=1)
    told(*words)
    assert {RESUME, "log.csv", "curves.png"} <= {path.name for path in (results / "artifacts/early/mine").iterdir()}


def typed(line: str) -> Iterator[list[str]]:
    """The words behind `kerv` of the commands that a message quotes, in their order."""
    return (quoted.split() for quoted in re.findall("'kerv ([^']*)'", line))


@pytest.mark.usefixtures("quick_training")
def test_the_remedy_for_weights_of_another_target_works_as_it_is_typed(results):
    rollout = ("rollout", "method=spec_vla", "task=reach", MINE, "--plan")
    fast = ("train.steps=1", "train.batch=2", "drafter.samples=40")
    for path in (results / "artifacts/drafter/mine").iterdir():
        path.unlink()
    told("train", "drafter", MINE, *fast)
    path = results / "artifacts/drafter/mine/drafter.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"target": "0" * 64}))
    (train,) = typed(told(*rollout, code=1))
    assert train == ["train", "drafter", "replace=true"]
    another = told("train", "drafter", MINE, "train.lr=0.5", "--plan", code=2)
    assert "choose another policy.artifacts.drafter=NAME, or type replace=true" in another
    told(*train, MINE, *fast)
    assert "1 task, " in told(*rollout)
    assert "4000 steps of 64" in told("train", "drafter", MINE, "policy.artifacts.drafter=b", "--plan")
    few = told("train", "drafter", MINE, "policy.artifacts.drafter=b", "train.steps=400", "--plan")
    assert ", 400 steps of 64" in few


@pytest.mark.usefixtures("quick_training")
def test_a_calibration_for_another_datastore_is_refused_by_a_plan_and_made_again(results):
    told("prepare", MINE, "for=heisd", "steps=2")
    rollout = ("rollout", "method=heisd", "task=reach", MINE, "--plan")
    assert "1 task, " in told(*rollout)
    shutil.rmtree(results / "artifacts/datastore/mine")
    told("build", "datastore", MINE, "components=4")
    (remedy,) = typed(told(*rollout, code=1))
    assert remedy == ["calibrate", MINE, "replace=true"]
    assert "type replace=true" in told("prepare", MINE, "--plan", code=1)
    assert "of other artifacts" in told("prepare", MINE, "replace=true", "--plan")
    told(*remedy)
    assert "1 task, " in told(*rollout)
    assert "of other artifacts" not in told("prepare", MINE, "--plan")


@pytest.mark.usefixtures("quick_training")
def test_an_artifact_has_a_row_and_is_shown_with_the_settings_that_it_was_made_with(results):
    quick = ["demos=few", "task=[reach-v3]", "train.steps=2", "train.batch=2", "train.validate_every=1"]
    made = {
        "target/new": ["train", "target", "target=nano", "name=new", "target.observation=state", *quick],
        "early/one": ["train", "drafter", "drafter=early", "policy.target=new", "policy.artifacts.early=one", *quick],
        "datastore/new": ["build", "datastore", "policy.target=new", *quick[:2]],
        "calibration/new": ["calibrate", "policy.target=new", *quick[:2], "decodes=0"],
    }
    for name, words in made.items():
        told(*words)
        assert sorted(json.loads(told("runs", "show", name, "--json"))["command"]) == sorted(["kerv", *words])
    assert "made by   kerv train target target=nano " in told("runs", "show", "target/new")
    rows = {f"{row.kind}/{row.name}": row for row in run_rows(opened(results))}
    assert {name: row.status for name, row in rows.items()} == dict.fromkeys(made, "complete")
    assert (rows["target/new"].done, rows["target/new"].total) == (2, 2)
    assert read_log(results / "artifacts/target/new")["step"].tolist() == [1, 2]


@pytest.mark.parametrize("command", ["train drafter", "train drafter drafter=early", "calibrate"])
def test_a_target_that_decodes_in_parallel_takes_no_drafts(results, command):
    path = results / "artifacts/target/mine/target.json"
    described = json.loads(path.read_text())
    described["settings"]["parallel"] = True
    path.write_text(json.dumps(described))
    assert "decodes all tokens at once" in told(*command.split(), MINE, "--plan", code=2)


@pytest.mark.usefixtures("quick_training")
def test_a_target_whose_training_was_interrupted_is_finished_by_the_command_that_is_shown(results):
    train = ["train", "target", "name=new", "demos=few", "target=nano", "target.observation=state", "train.steps=2"]
    told(*train)
    (results / "artifacts/target/new/target.json").unlink()  # as before the first validation
    (shown,) = typed(told("prepare", "policy.target=new", code=2))
    assert f"kerv {' '.join(train)}" in told(*shown)


@pytest.mark.usefixtures("results")
@pytest.mark.parametrize("command", ["prepare", "build datastore", "calibrate", "train drafter", "rollout", "serve"])
def test_a_wrong_target_is_noticed_before_anything_else(command):
    assert "no target 'min'" in told(*command.split(), "policy.target=min", code=2)


@pytest.mark.usefixtures("quick_training")
def test_drafts_of_seven_tasks_are_made_as_the_note_of_their_study_says(policies, results):
    shutil.copytree(policies / "artifacts", results / "artifacts", dirs_exist_ok=True)
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


# --- policies of the release


def test_the_released_policies_are_those_of_a_checkout():
    shipped = Path(__file__).resolve().parents[1].glob("results/pretrained/*/target/target.json")
    assert sorted(path.parts[-3] for path in shipped) == sorted(paths.RELEASED)


def test_the_printed_command_installs_a_policy_that_the_wheel_leaves_out(policies, tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "shipped_dir", lambda: tmp_path / "nothing")
    for kind in ("target", "drafter"):
        shutil.copytree(policies / "artifacts" / kind / "nano-vision", tmp_path / "release/mt50-vision" / kind)
    with tarfile.open(tmp_path / "mt50-vision.tar.gz", "w:gz") as file:
        file.add(tmp_path / "release/mt50-vision", "mt50-vision")
    words = ("rollout", "policy=mt50", "task=reach", f"results={tmp_path}/results", "--plan")
    printed = re.search("'(mkdir .*)'", told(*words, code=2))
    assert printed
    subprocess.run(printed[1], shell=True, cwd=tmp_path, check=True)
    assert "1 task, 3 episodes" in told(*words)
    assert "mt50-vision" in paths.target_names(f"{tmp_path}/results")
