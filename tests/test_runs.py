"""`kerv rollout` and `kerv sweep` as runs: what they leave, and what `kerv runs` does with it. Real episodes of a nano
policy in this process, recordings left out."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from command import kerv

from kerv_cli.catalogue.entries import find_runs
from kerv_cli.lab.database import opened
from kerv_cli.lab.runs import Run
from kerv_cli.lab.store import Study, decodes_of, frame_of, loaded
from kerv_cli.lab.work import EpisodeRunner

FAST = ["policy=state", "policy.target=nano-state", "task=reach-v3", "world.horizon=8", "record=0"]


def works(*arguments: str) -> str:
    return kerv(*arguments).stdout


@pytest.fixture(scope="module")
def results(policies, tmp_path_factory):
    """Read only: a rollout of two settings and one of a single one, beside the policies."""
    folder = tmp_path_factory.mktemp("runs") / "results"
    shutil.copytree(policies / "artifacts", folder / "artifacts")
    works("rollout", "-m", "method=spec_vla", "threshold.r=5,9", "episodes=2", *FAST, f"results={folder}")
    works("rollout", "method=ar", "episodes=2", *FAST, f"results={folder}")
    return folder


@pytest.fixture
def copy(results, tmp_path):
    """One that a test may change."""
    return Path(shutil.copytree(results, tmp_path / "results"))


def listed(results: Path, *words: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(works("runs", "list", *words, f"results={results}", "--json"))
    return found


def test_runs_are_viewed_by_their_ids_and_last_is_the_newest_with_recordings(policies, tmp_path, monkeypatch):
    results = f"results={tmp_path}/results"
    words = ["policy=vision", "policy.target=nano-vision", "task=reach-v3", "world.horizon=3", "record_size=32"]
    shutil.copytree(policies / "artifacts", tmp_path / "results/artifacts")
    for method in ("jacobi", "ar"):
        works("rollout", f"method={method}", "episodes=1", *words, results)
    works("rollout", "method=ar", "episodes=1", *FAST, results)
    ar, jacobi = (run["id"] for run in listed(tmp_path / "results", "kind=rollout")[1:])
    assert (ar.endswith("-ar"), jacobi.endswith("-jacobi")) == (True, True)
    monkeypatch.setattr("kerv_cli.report.viewing.viewer.has_display", lambda: False)
    assert works("view", "last", results) == works("view", ar, results)
    (one,) = (tmp_path / "results/rollouts" / jacobi).rglob("*.rrd")
    assert works("view", jacobi, results) == works("view", str(one))
    assert "no recordings in" in kerv("view", "target/nano-state", results, code=2).stderr
    assert "unknown run 'nobodys'" in kerv("view", "nobodys", results, code=2).stderr
    shutil.rmtree(tmp_path / "results/rollouts" / jacobi)
    assert "no recordings in" in kerv("view", jacobi, results, code=2).stderr
    assert "nobodys/either does not exist" in kerv("view", "nobodys/either", results, code=2).stderr


def test_a_finished_training_stays_finished_while_it_is_repeated_and_after_that_was_interrupted(copy):
    def training() -> dict[str, Any]:
        (run,) = [run for run in listed(copy) if run["id"] == "target/nano-state"]
        return run

    database, words = opened(copy), ("target", "nano-state", ["train", "target", "name=nano-state"])
    before = training()
    with Run(database, *words, total=20):
        pass
    with contextlib.suppress(KeyboardInterrupt), Run(database, *words, total=20):
        during = training()
        raise KeyboardInterrupt
    after = training()
    assert (during["started"], during["state"]) == (before["started"], "running, 0 of 20")
    assert (after["started"], after["state"]) == (before["started"], "complete")
    longer = ("target", "nano-state", ["train", "target", "name=nano-state", "train.steps=40"])
    with contextlib.suppress(KeyboardInterrupt), Run(database, *longer):
        raise KeyboardInterrupt
    assert training()["state"] == "interrupted"


def test_runs_are_listed_and_filtered(results):
    runs = listed(results)
    assert [run["kind"] for run in runs].count("rollout") == 2
    assert {run["state"] for run in runs if run["kind"] == "rollout"} == {"complete"}
    (grid,) = listed(results, "method=spec_vla")
    assert (grid["episodes"], grid["methods"]) == (4, ["spec_vla"])
    (single,) = listed(results, "method=ar")
    assert single["episodes"] == 2
    assert single["command"][:3] == ["kerv", "rollout", "method=ar"]
    assert {run["id"] for run in listed(results, "kind=target")} == {"target/nano-state", "target/nano-vision"}
    assert listed(results, "task=push") == []
    assert "did you mean method" in kerv("runs", "list", "methd=ar", f"results={results}", code=2).stderr
    assert "did you mean sweep" in kerv("runs", "list", "kind=swep", code=2).stderr
    assert "step, running, interrupted, failed, 2 of 6 episodes" in kerv("runs", "list", "state=x", code=2).stderr


def test_a_run_is_shown_and_a_wrong_name_refused(results):
    told = works("runs", "show", "last", f"results={results}")
    assert re.search(r"^(command +kerv rollout|made by +unknown)", told, re.MULTILINE)
    missing = kerv("runs", "show", "nothing-like-it", f"results={results}", code=2)
    assert "unknown run 'nothing-like-it'" in missing.stderr
    assert "kerv rollout" in kerv("runs", "show", "last", "results=/tmp/no-such-results", code=2).stderr


def tokens_of(results: Path, name: str) -> list[list[int]]:
    store = loaded(Study(opened(results), name))
    tokens: list[list[int]] = decodes_of(store, frame_of(store)["episode"].tolist(), ["tokens"])["tokens"].to_pylist()
    return tokens


@pytest.mark.bits
def test_a_repeated_rollout_has_the_same_tokens_and_a_folder_of_its_own(copy):
    single = next(run["id"] for run in listed(copy, "method=ar"))
    works("rollout", "method=ar", "episodes=2", *FAST, f"results={copy}")
    again = listed(copy)[0]["id"]
    assert again != single
    assert tokens_of(copy, again) == tokens_of(copy, single)
    assert "removed" in works("runs", "rm", again, single, "--yes", f"results={copy}")
    assert listed(copy, "method=ar") == []


def test_an_interrupted_rollout_goes_on_where_it_was(policies, tmp_path, monkeypatch):
    shutil.copytree(policies / "artifacts", tmp_path / "results" / "artifacts")
    command = ["rollout", "method=ar", "episodes=3", *FAST, f"results={tmp_path}/results"]
    original, last = EpisodeRunner.__call__, 100_001

    def interrupted(self, setting, task):
        run = original(self, setting, task)

        def episode(seed):
            if seed == last:
                raise KeyboardInterrupt
            return run(seed)

        return episode

    monkeypatch.setattr(EpisodeRunner, "__call__", interrupted)
    stopped = kerv(*command, code=130)
    assert "1 of 3 episodes of" in stopped.stderr
    assert listed(tmp_path / "results")[0]["state"] == "interrupted, 1 of 3 episodes"
    last = 100_002
    stopped = kerv(*command, code=130)
    assert "1 episode there already" in stopped.stderr
    monkeypatch.setattr(EpisodeRunner, "__call__", original)
    again = kerv(*command)
    assert "2 episodes there already" in again.stderr
    assert len(listed(tmp_path / "results", "kind=rollout")) == 1
    assert works(*command)  # complete: the same command is a new run
    assert len(listed(tmp_path / "results", "kind=rollout")) == 2


def test_results_that_cannot_be_written_are_refused_at_once(tmp_path):
    (tmp_path / "file").touch()
    for command in (["rollout"], ["sweep", "study=demo"], ["demos"], ["train", "target"], ["calibrate"], ["report"]):
        refused = kerv(*command, f"results={tmp_path}/file/below", code=2)
        assert "is a file" in refused.stderr
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


@pytest.mark.parametrize(
    ("words", "labels"),
    [
        (["proposer=hold", "acceptance=relaxed", "threshold.r=5"], ["ar proposer=hold acceptance=relaxed"]),
        (["prefill_draft=hold"], ["ar prefill_draft=hold"]),
        (["method=spec_vla", "threshold.r=3,5", "rectifier=compensate"], ["spec_vla rectifier=compensate r=3",
                                                                         "spec_vla rectifier=compensate r=5"]),
        (["method=ar,kerv"], ["ar", "kerv"]),
    ],
)  # fmt: skip
def test_a_method_composed_on_the_command_line_is_called_what_it_is(words, labels):
    from kerv_cli.episodes.resolve import resolve_rollout

    assert list(resolve_rollout(words, multirun=True).settings) == labels


# --- export ---


def test_episodes_are_exported_as_csv(results, tmp_path):
    grid = next(run for run in find_runs(opened(results)) if "spec_vla" in run.methods)
    (path,) = works("runs", "export", grid.id, "--dir", str(tmp_path), f"results={results}").split()
    table = pd.read_csv(path)
    assert list(table["label"]) == ["spec_vla r=5", "spec_vla r=5", "spec_vla r=9", "spec_vla r=9"]
    assert set(table["steps"]) == {8}
    kerv("runs", "export", "target/nano-state", f"results={results}", code=2)


# --- removal ---


KILLED = """
import os, sys
from pathlib import Path
from kerv_cli.catalogue.entries import find_run, remove
from kerv_cli.lab.database import opened

left = int(sys.argv[3])

def kill_at(event, arguments):
    global left
    if event in ("os.rename", "os.remove", "os.rmdir", "shutil.rmtree"):
        left -= 1
        if left < 0:
            os.kill(os.getpid(), 9)

database = opened(sys.argv[1])
run = find_run(database, sys.argv[2])
sys.addaudithook(kill_at)
remove(run, database)
"""


@pytest.mark.parametrize("moment", [0, 2])
def test_a_removal_that_is_killed_can_be_repeated(copy, moment):
    name = next(run["id"] for run in listed(copy) if run["kind"] == "rollout")
    (copy / "rollouts" / name / "rollouts").mkdir(parents=True)
    (copy / "rollouts" / name / "rollouts/a.rrd").touch()
    killed = subprocess.run([sys.executable, "-c", KILLED, str(copy), name, str(moment)], check=False)
    assert killed.returncode == -9
    if name in [run["id"] for run in listed(copy)]:
        works("runs", "rm", "--yes", name, f"results={copy}")
    assert name not in [run["id"] for run in listed(copy)]
    assert not list((copy / "rollouts").glob("[!.]*"))


def test_removal_refuses_links_and_parts_of_names(copy, tmp_path):
    name = next(run["id"] for run in listed(copy) if run["kind"] == "rollout")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (copy / "rollouts").mkdir(exist_ok=True)
    (copy / "rollouts" / name).symlink_to(elsewhere)
    for part, said in ((name, "is a link to"), (name[:8], "unknown run"), ("last", "unknown run")):
        refused = kerv("runs", "rm", "-y", part, f"results={copy}", code=2)
        assert said in refused.stderr
