"""Results of kerv 0.1.0, made on 2026-11-23 by its commit 1e4a685: a study, rollouts, trainings, demonstrations, a
datastore, a calibration and a recorded risk, all tiny, stay readable, comparable, reusable and repeatable."""

from __future__ import annotations

import json
import shutil
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from kerv_cli.base.files import read_json
from kerv_cli.cli.app import app

ARCHIVE = Path(__file__).parent / "fixtures" / "results-0.1.0.tar.xz"
STUDY = """
title: Four methods of a policy that learned nothing
name: four-methods
common: policy.target=few task=[reach-v3,drawer-close-v3] episodes=3 world.horizon=12 record=0
settings:
  ar: method=ar
  spec_vla: method=spec_vla
  heisd: method=heisd
  one_pass_streak: method=one_pass_streak
axis: ""
"""


def kerv(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def works(*arguments: str) -> str:
    result = kerv(*arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


def answer(*arguments: str) -> Any:
    return json.loads(works(*arguments, "--json"))


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Read only."""
    folder = tmp_path_factory.mktemp("older")
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
    (folder / "study.yaml").write_text(STUDY)
    return folder


@pytest.fixture
def results(older: Path, tmp_path: Path) -> str:
    """A copy to write in."""
    shutil.copytree(older, tmp_path, dirs_exist_ok=True)
    return f"results={tmp_path}/results"


def test_every_run_is_listed_and_shown(older: Path) -> None:
    results = f"results={older}/results"
    runs = answer("runs", "list", results)
    assert {run["state"] for run in runs} == {"complete"}
    kinds = ["calibration", "datastore", "demos", "drafter", "early", "risk", "rollout", "rollout", "sweep", "target"]
    assert sorted(run["kind"] for run in runs) == kinds
    for run in runs:
        assert run["id"] in works("runs", "show", run["id"], results)
    made = answer("runs", "show", "four-methods", results)["made_from"]
    assert made == {kind: f"{kind}/few" for kind in ("calibration", "datastore", "drafter", "early", "target")}
    assert answer("runs", "show", "drafter/few", results)["made_from"] == {"target": "target/few", "demos": "demos/few"}
    (row,) = {row["label"] for row in answer("runs", "show", "four-methods:heisd", results)["settings"]}
    assert row == "heisd"


def test_runs_are_compared(older: Path) -> None:
    results = f"results={older}/results"
    (found,) = answer("runs", "compare", "four-methods:ar", "four-methods:heisd", results)
    assert {"proposer.kind", "datastore"} <= {row["key"] for row in found["settings"]}
    assert answer("runs", "compare", "20261123-013121-kerv", "20261123-013127-spec_vla", results)


def test_nothing_of_it_is_run_again_and_more_seeds_are_added(results: str, tmp_path: Path) -> None:
    study = f"study={tmp_path}/study.yaml"
    plan = answer("sweep", study, "--plan", results)
    assert (plan["to run"], plan["reused"]) == (0, 8)
    (tmp_path / "study.yaml").write_text(STUDY.replace("episodes=3", "episodes=4"))
    plan = answer("sweep", study, "--plan", results)
    assert (plan["to run"], plan["reused"]) == (8, 8)
    assert {row["why"] for row in plan["settings"]} == {"new seeds"}
    assert answer("sweep", study, results)["cells"] == {"run": 8, "reused": 8, "failed": 0}
    table = answer("report", study, results)["studies"]["four-methods"]
    assert {row["episodes"] for row in table} == {8}
    assert {str(row["engine"]) for row in table} == {"1"}


def test_it_is_reported_as_it_was(results: str, tmp_path: Path) -> None:
    """The columns of then have the values of then, to the byte, but for what is inferred from them: the intervals of
    ratios and of averages over difficulty."""
    import pandas as pd

    from kerv_cli.report.measures import MACRO

    before = pd.read_csv(tmp_path / "results/report/tables/four-methods.csv")
    works("report", f"study={tmp_path}/study.yaml", results)
    now = pd.read_csv(tmp_path / "results/report/tables/four-methods.csv")
    ratios, macro = ("speedup", "episode_speedup", "AL"), before["averaging"] == MACRO
    inferred = {"pairs_to_settle", *(f"{name}_{end}" for name in ratios for end in ("low", "high"))}
    of_macro = {"difference", "difference_low", "difference_high", "non_inferior"}
    for rows, anew in ((~macro, inferred), (macro, inferred | of_macro)):
        columns = [name for name in before if name not in anew]
        pd.testing.assert_frame_equal(now.loc[rows, columns], before.loc[rows, columns])


@pytest.fixture
def gated(older: Path, tmp_path: Path) -> tuple[Path, str]:
    """A study with the calibrated gate, which kerv had up to its commit 72e42ef: three settings, twelve episodes."""
    shutil.copytree(older, tmp_path, dirs_exist_ok=True)
    with tarfile.open(ARCHIVE.with_name("gate-72e42ef.tar.xz")) as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path, f"results={tmp_path}/results"


def test_what_the_gate_measured_is_listed_shown_and_reported_as_it_was(gated: tuple[Path, str]) -> None:
    import pandas as pd

    folder, results = gated
    (run,) = [run for run in answer("runs", "list", results) if run["id"] == "gate"]
    assert (run["state"], run["episodes"]) == ("complete", 12)
    (label,) = {row["label"] for row in answer("runs", "show", "gate:one_pass_risk", results)["settings"]}
    assert label == "one_pass_risk"
    assert "skip.kind" in works("runs", "compare", "gate:one_pass_risk", "gate:one_pass_streak", results)
    before = pd.read_csv(folder / "results/report/tables/gate.csv")
    (folder / "gate.yaml").write_text("settings: {ar: method=ar}")
    works("report", f"study={folder}/gate.yaml", results)
    now = pd.read_csv(folder / "results/report/tables/gate.csv")
    # a setting that a part has since, skip.opening of a streak, has its default where the column was empty
    pd.testing.assert_frame_equal(now[before.columns].where(before.notna()), before, check_dtype=False)
    assert before.loc[before["label"] == "one_pass_risk", "realised_risk"].notna().all()


@pytest.mark.bits
def test_its_tokens_are_those_of_today(results: str, tmp_path: Path) -> None:
    """A run of every method on the stored weights, again, whatever the CPU."""
    told = answer("runs", "rerun", "four-methods", results)
    assert told["episodes"] == 24
    assert told["same_tokens"] == 24
    assert (tmp_path / "results/studies/four-methods-again/report.html").exists() is False


def test_its_artifacts_are_inputs_of_today(results: str, tmp_path: Path) -> None:
    tasks = "task=[reach,drawer-close]"
    works("build", "datastore", "policy.target=few", "demos=few", tasks, "name=again", results)
    before, again = (tmp_path / "results/artifacts/datastore" / name for name in ("few", "again"))
    payloads = [read_json(folder / "manifest.json")["files"]["payload.parquet"] for folder in (before, again)]
    assert payloads[0] == payloads[1]
    # another CPU may sum in another order
    np.testing.assert_allclose(np.load(again / "vectors.npy"), np.load(before / "vectors.npy"), rtol=1e-5, atol=1e-6)
    works("train", "drafter", "policy.target=few", "demos=few", tasks, "train.steps=2", "train.validate_every=2",
          "train.batch=4", "train.warmup=1", "policy.drafter=again", results)  # fmt: skip


def test_a_file_with_more_fields_is_read_and_one_of_a_newer_format_is_refused(results: str, tmp_path: Path) -> None:
    path = tmp_path / "results/artifacts/drafter/few/drafter.json"
    value = read_json(path)
    path.write_text(json.dumps({**value, "of_a_newer_kerv": {"a": 1}}))
    rollout = ("rollout", "policy.target=few", "method=spec_vla", "task=reach", "episodes=1", "world.horizon=4")
    works(*rollout, "record=0", results)
    path.write_text(json.dumps({**value, "format": 99}))
    refused = kerv(*rollout, results)
    assert refused.exit_code == 1
    assert "drafter.json" in refused.stderr
    assert "format" in refused.stderr
