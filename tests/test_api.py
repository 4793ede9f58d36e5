"""kerv as a library: the same runs as the commands', errors as exceptions, and the notebook of the docs."""

import ast
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused

import kerv_cli as kerv
from kerv_cli.base.config import as_overrides

pytestmark = pytest.mark.usefixtures("quick_report")

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def mine(policies, tmp_path_factory):
    """Settings of a short episode of an untrained policy, in a results folder of this module."""
    short = {"task": "reach", "episodes": 1, "record": 0, "world": {"horizon": 6}}
    target = policies / "artifacts" / "target" / "nano-state"
    return {**short, "policy": {"target": target}, "results": tmp_path_factory.mktemp("library") / "results"}


@pytest.fixture(scope="module")
def run(mine):
    return kerv.rollout("seed=100003", method="ar", **mine)


@pytest.fixture(scope="module")
def study(mine):
    path = mine["results"].parent / "both.yaml"
    path.write_text("settings: {ar: method=ar, hold: method=spec_vla proposer=hold}\n", encoding="utf-8")
    return kerv.sweep(path, **mine)


def test_the_package_names_what_the_stub_names():
    stub = ast.parse((ROOT / "kerv_cli/__init__.pyi").read_text(encoding="utf-8"))
    assert [node.names[0].asname for node in stub.body if isinstance(node, ast.ImportFrom)] == kerv.__all__
    assert all(getattr(kerv, name).__doc__ for name in kerv.__all__)
    with pytest.raises(AttributeError, match="'kerv_cli' has no attribute 'rolout'"):
        _ = kerv.rolout  # type: ignore[attr-defined]


def test_settings_are_written_as_they_are_typed():
    words = as_overrides(
        "a=1", task=["reach", "push"], threshold={"r": 5}, world={"camera": {"size": 48}}, on=True, x=None
    )
    assert words == ["a=1", "task=[reach,push]", "threshold.r=5", "world.camera.size=48", "on=true", "x=null"]


def test_a_rollout_gives_its_episodes_and_is_the_commands_own(run, mine):
    (episode,) = run.episodes()
    assert (episode["task"], episode["seed"], episode["label"]) == ("reach-v3", 100003, "ar")
    assert episode["steps"] == 6
    assert len(run.to_pandas()) == len(run.to_pandas("tasks")) == 1
    assert run.folder.parent == mine["results"] / "rollouts"
    (command,) = kerv.runs(mine["results"], kind="rollout")["command"]
    assert command[:3] == ("rollout", "seed=100003", "method=ar")


def test_a_grid_has_a_setting_per_value(mine):
    both = kerv.rollout(grid=True, method="ar,jacobi", **mine)
    assert list(both.to_pandas()["label"]) == ["ar", "jacobi"]


def test_a_study_is_run_once_reported_and_loaded(study, mine):
    table = study.to_pandas()
    assert list(table["label"]) == ["ar", "hold"]
    assert table["episodes"].tolist() == [1, 1]
    again = kerv.sweep(mine["results"].parent / "both.yaml", **mine)
    assert again.to_pandas().equals(table)  # times included
    loaded = kerv.load_study("both", results=mine["results"])
    assert loaded.folder == study.folder
    files = {path.name for path in loaded.report()}
    assert {"both.csv", "both_per_task.csv", "report.html"} <= files


def test_a_sweep_reports_from_the_database_that_was_named(study, mine, tmp_path):
    results, store = tmp_path / "results", f"sqlite:///{tmp_path}/other.db"
    kerv.sweep(mine["results"].parent / "both.yaml", **{**mine, "results": results, "store": store})
    loaded = kerv.load_study(study.name, results=results, store=store)
    assert "report.html" in {file.name for file in loaded.report()}
    assert loaded.to_pandas()["episodes"].tolist() == [1, 1]
    assert not list(results.glob("*.db"))


def test_runs_are_listed_and_narrowed(run, study, mine):
    there = kerv.runs(mine["results"])
    assert {run.name, study.name} <= set(there["id"])
    assert list(kerv.runs(mine["results"], kind="sweep")["id"]) == ["both"]
    assert kerv.runs(mine["results"] / "none").empty


def test_a_policy_answers_observations(mine):
    policy = kerv.load_policy(str(mine["policy"]["target"]), method="ar", results=mine["results"])
    seen = {"observation/state": np.linspace(-0.1, 0.2, 39), "prompt": "reach the goal"}
    actions = policy.act(seen)
    assert actions.shape == (policy.info["chunk"], len(policy.info["actions"]))
    assert policy.last["decode"]["forwards"] == actions.size
    policy.act(seen, executed=1)
    policy.reset()
    assert np.array_equal(policy.act(seen), actions)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda mine: kerv.rollout(**{**mine, "task": "raech"}), "unknown task or suite 'raech': did you mean reach"),
        (lambda mine: kerv.sweep("dmeo", **mine), "unknown study 'dmeo': did you mean demo"),
        (lambda mine: kerv.runs(mine["results"], colour="red"), "unknown filter 'colour'"),
        (lambda mine: kerv.load_policy("absent", results=mine["results"]), "no target 'absent'"),
        (lambda mine: kerv.load_study("other", results=mine["results"]), "unknown run 'other'"),
    ],
)
def test_a_wrong_request_is_an_exception_of_one_line(call, says, run, mine):
    with refused(says):
        call(mine)


def test_what_a_study_or_a_policy_cannot_do_is_said(run, mine):
    with pytest.raises(kerv.KervError, match="unknown table 'rows'"):
        run.to_pandas("rows")
    with pytest.raises(kerv.KervError, match="is a rollout"):
        run.report()
    policy = kerv.load_policy(str(mine["policy"]["target"]), method="ar", results=mine["results"])
    with pytest.raises(kerv.KervError, match="no observation/state"):
        policy.act({"prompt": "reach the goal"})


def test_episodes_that_fail_are_an_exception(mine, monkeypatch):
    def failing(*_):
        raise RuntimeError("the world broke")

    monkeypatch.setattr("kerv_cli.episodes.runner.Runner.episode", failing)
    with pytest.raises(kerv.KervError, match=r"2 of 2 episodes failed, .* on reach-v3: .*the world broke"):
        kerv.sweep(mine["results"].parent / "both.yaml", "seed=100050", **mine)


def test_the_notebook_runs(tmp_path, monkeypatch):
    cells = json.loads((ROOT / "docs/notebook.ipynb").read_text(encoding="utf-8"))["cells"]
    sources = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert sum(len(source.splitlines()) for source in sources) <= 25
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for source in sources:
        exec(source, names)
    assert names["study"].to_pandas()["success"].tolist() == [1, 1, 1]
    assert names["actions"].shape[1] == 4
