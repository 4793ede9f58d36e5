"""Runs from elsewhere: a results folder of 0.1.0, another kerv.db; what is handed on, and limits."""

import contextlib
import json
import shutil
import sqlite3
import tarfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command import kerv
from studies_synthetic import swept, threshold_study

from kerv_cli.catalogue.imports import connect_foreign
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.measures import MACRO
from kerv_cli.report.tables import CSV_COLUMNS, load_study
from kerv_cli.worlds.demos import files
from kerv_cli.worlds.demos.files import foreign_table

ARCHIVE = Path(__file__).parent / "fixtures" / "results-0.1.0.tar.xz"
STUDY = """
name: four-methods
common: policy.target=few task=[reach-v3,drawer-close-v3] episodes=3 world.horizon=12 record=0
settings:
  {ar: method=ar, spec_vla: method=spec_vla_tuned, heisd: method=heisd_tuned, one_pass_streak: method=one_pass_streak}
"""


def answer(*words: str) -> Any:
    return json.loads(kerv(*words, "--json").stdout)


def refusal(*words: str) -> str:
    result = kerv(*words, code=None)
    assert (result.exit_code in (1, 2), len(result.stderr.splitlines())) == (True, 1), result.output
    return result.stderr


@pytest.fixture(scope="module")
def older(tmp_path_factory):
    folder = tmp_path_factory.mktemp("older")
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
    (folder / "study.yaml").write_text(STUDY)
    told = answer("runs", "import", f"{folder}/results", f"results={folder}/results")
    assert (len(told["studies"]), told["notes"]) == (3, [])
    return folder


def test_every_run_of_0_1_0_is_listed_shown_and_compared(older):
    results = f"results={older}/results"
    runs = {run["id"]: run for run in answer("runs", "list", results) if run["state"] == "complete"}
    kinds = ["calibration", "datastore", "demos", "drafter", "early", "rollout", "rollout", "sweep", "target"]
    assert sorted(run["kind"] for run in runs.values()) == kinds
    assert runs["four-methods"]["command"] == ["kerv", "sweep", "study=four.yaml", "results=results"]
    assert runs["four-methods"]["started"] == "2026-11-23T01:31:05.826"
    made = answer("runs", "show", "four-methods", results)["made_from"]
    assert made == {kind: f"{kind}/few" for kind in ("calibration", "datastore", "drafter", "early", "target")}
    (found,) = answer("runs", "compare", "four-methods:ar", "four-methods:heisd", results)
    assert {"proposer.kind", "datastore"} <= {row["key"] for row in found["settings"]}


def test_it_is_reported_as_it_was(older):
    """Columns have the values of then, but for what is inferred from them: intervals of ratios and averages."""
    before = pd.read_csv(older / "results/report/tables/four-methods.csv")
    renamed = {name: f"{name}_tuned" for name in ("spec_vla", "heisd")}
    before["method"] = before["method"].replace(renamed)
    data = load_study(StudyStore(older / "results", "four-methods"))
    assert set(data.episodes["git_commit"].str[:7]) == {"1e4a685"}
    now = data.table.loc[:, lambda table: [name in before for name in table]].convert_dtypes().astype(object)
    text = pd.read_csv(pd.io.common.StringIO(now.to_csv(index=False, float_format="%.6g")))
    ratios, macro = ("speedup", "episode_speedup", "AL"), before["averaging"] == MACRO
    inferred = {f"{name}_{end}" for name in ratios for end in ("low", "high")}
    inferred |= {"pairs_to_settle", "proposer.top_k", "proposer.nodes"}  # of a chain, the last two have no meaning now
    later = {"steps_to_success", "near_contact_failure", "matched_success_speed", "runs"}
    later |= {"solved_speedup", "solved_speedup_low", "solved_speedup_high"}
    of_macro = {"difference", "difference_low", "difference_high", "non_inferior"}
    for rows, anew in ((~macro, inferred), (macro, inferred | of_macro)):
        columns = [name for name in text if name not in anew]
        assert {*CSV_COLUMNS} - {*columns} <= anew | later
        pd.testing.assert_frame_equal(text.loc[rows, columns], before.loc[rows, columns])


def test_nothing_of_it_is_run_again_and_more_seeds_are_added(older, tmp_path):
    shutil.copytree(older, tmp_path, dirs_exist_ok=True)
    study, results = f"study={tmp_path}/study.yaml", f"results={tmp_path}/results"
    plan = answer("sweep", study, "--plan", results)
    assert (plan["to run"], plan["reused"]) == (0, 24)
    (tmp_path / "study.yaml").write_text(STUDY.replace("episodes=3", "episodes=4"))
    plan = answer("sweep", study, "--plan", results)
    assert (plan["to run"], plan["reused"]) == (8, 24)
    assert {row["why"] for row in plan["settings"]} == {"new seeds"}
    told = answer("runs", "import", f"{tmp_path}/results", results)
    assert (told["studies"], len(told["notes"])) == ([], 3)


def test_a_damaged_cell_is_left_out_with_a_line(older, tmp_path):
    shutil.copytree(older / "results", tmp_path / "old", ignore=shutil.ignore_patterns("kerv.db*", "artifacts"))
    (cell, *_) = sorted((tmp_path / "old/studies/four-methods/cells").iterdir())
    (cell / "decodes.parquet").write_bytes(b"PAR1")
    told = answer("runs", "import", f"{tmp_path}/old", f"results={tmp_path}/new")
    assert [str(cell) in line for line in told["notes"]] == [True]
    (run,) = (run for run in answer("runs", "list", f"results={tmp_path}/new") if run["kind"] == "sweep")
    assert run["state"] == "21 of 24 episodes"


@pytest.mark.bits
def test_its_tokens_are_those_of_today(older, tmp_path):
    shutil.copytree(older, tmp_path, dirs_exist_ok=True)
    told = answer("runs", "rerun", "four-methods", f"results={tmp_path}/results")
    assert (told["episodes"], told["same_tokens"]) == (24, 24)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    swept(folder, threshold_study(["reach-v3", "push-v3"]))
    swept(folder, threshold_study(["reach-v3"], name="other"))
    return folder


def test_an_exported_database_is_the_study_elsewhere(made, tmp_path):
    answer("runs", "export", "threshold", "--to", "db", "--dir", f"{tmp_path}/out", f"results={made}")
    (run,) = answer("runs", "list", f"results={tmp_path}/out/threshold")
    assert (run["id"], run["state"]) == ("threshold", "complete")
    told = answer("runs", "import", f"{tmp_path}/out/threshold/kerv.db", "name=copy", f"results={tmp_path}/new")
    assert told == {"studies": ["copy"], "notes": []}
    before, after = (load_study(StudyStore(*at)) for at in ((made, "threshold"), (tmp_path / "new", "copy")))
    pd.testing.assert_frame_equal(before.per_task.drop(columns="study"), after.per_task.drop(columns="study"))
    with sqlite3.connect(tmp_path / "out/threshold/kerv.db") as file:
        file.execute("UPDATE kerv SET value = '99'")
    said = refusal("runs", "import", f"{tmp_path}/out/threshold", f"results={tmp_path}/new")
    assert "newer kerv" in said


def test_episodes_and_decodes_as_parquet(made, tmp_path):
    answer("runs", "export", "threshold", "--to", "parquet", "--dir", str(tmp_path), f"results={made}")
    episodes, decodes = (pd.read_parquet(tmp_path / f"threshold/{name}.parquet") for name in ("episodes", "decodes"))
    assert len(episodes) == len(StudyStore(made, "threshold").frame()) == 32
    counted = decodes.groupby(["label", "task", "seed", "repeat"]).size()
    assert counted.to_dict() == episodes.set_index(["label", "task", "seed", "repeat"])["decodes"].to_dict()


def test_a_foreign_database_that_never_ends_is_refused(tmp_path):
    path, endless = tmp_path / "recording-1.sqlite", "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
    with sqlite3.connect(path) as file:
        file.execute("CREATE TABLE t (x)")
    begun = time.monotonic()
    with contextlib.closing(connect_foreign(path)) as file, pytest.raises(sqlite3.OperationalError):
        file.execute(f"{endless} SELECT MAX(i) FROM n").fetchone()
    for name in ("eval_metadata", "kerv"):
        with sqlite3.connect(path) as file:
            file.execute(f"CREATE VIEW {name} AS {endless} SELECT i AS eval_id, '' AS metadata FROM n")
        assert str(path) in refusal("runs", "import", str(path), f"results={tmp_path}/new")
    assert time.monotonic() - begun < 10
    assert not (tmp_path / "new").exists()


def test_a_small_parquet_file_that_expands_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MOST_EXPANDED", 2**24)
    for name, column in enumerate((pa.array(["x" * 1000] * 50_000), np.zeros(2**22))):
        path = tmp_path / f"{name}.parquet"
        pq.write_table(pa.table({"a": column}), path, compression="zstd")
        with pytest.raises(ValueError, match="expands to more than"):
            foreign_table(path)
    pq.write_table(pa.table({"a": [1, 2, 3], "b": ["x", "y", "z"]}), path, row_group_size=1)
    assert foreign_table(path, ["b", "c"]).to_pylist() == [{"b": "x"}, {"b": "y"}, {"b": "z"}]
