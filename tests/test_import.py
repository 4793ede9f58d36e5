"""Runs from another kerv.db; what is handed on."""

import json
import sqlite3
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command import kerv
from studies_synthetic import swept, threshold_study

from kerv_cli.lab.database import opened
from kerv_cli.lab.store import Study
from kerv_cli.report.measures import csv_text
from kerv_cli.report.tables import load_study
from kerv_cli.worlds.demos import files
from kerv_cli.worlds.demos.files import foreign_table


def answer(*words: str) -> Any:
    return json.loads(kerv(*words, "--json").stdout)


def refusal(*words: str) -> str:
    result = kerv(*words, code=None)
    assert (result.exit_code in (1, 2), len(result.stderr.splitlines())) == (True, 1), result.output
    return result.stderr


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    swept(folder, threshold_study(["reach-v3", "push-v3"]))
    swept(folder, threshold_study(["reach-v3"], name="other"))
    return folder


def test_an_imported_study_is_the_study_elsewhere(made, tmp_path):
    (tmp_path / "out").mkdir()
    swept(tmp_path / "out", threshold_study(["reach-v3", "push-v3"]))
    told = answer("runs", "import", f"{tmp_path}/out/kerv.db", "name=copy", f"results={tmp_path}/new")
    assert told == {"studies": ["copy"], "notes": []}
    assert "holds 2 studies" in refusal("runs", "import", str(made), "name=copy", f"results={tmp_path}/new")
    again = kerv("runs", "import", f"{tmp_path}/out", "name=copy", f"results={tmp_path}/new").stdout
    assert f"'kerv runs rm copy results={tmp_path}/new' removes it" in again
    assert f"'kerv runs list results={tmp_path}/new'" in again
    before, after = (
        load_study(Study(opened(folder), name))
        for folder, name in ((tmp_path / "out", "threshold"), (tmp_path / "new", "copy"))
    )
    assert [csv_text([replace(row, study="").columns()]) for row in before.task_results] == [
        csv_text([replace(row, study="").columns()]) for row in after.task_results
    ]
    with sqlite3.connect(tmp_path / "out/kerv.db") as file:
        file.execute("UPDATE kerv SET value = '99'")
    said = refusal("runs", "import", f"{tmp_path}/out", f"results={tmp_path}/new")
    assert "newer kerv" in said


def test_episodes_and_decodes_as_parquet(made, tmp_path):
    answer("runs", "export", "threshold", "--to", "parquet", "--dir", str(tmp_path), f"results={made}")
    episodes, decodes = (pd.read_parquet(tmp_path / f"threshold/{name}.parquet") for name in ("episodes", "decodes"))
    assert len(episodes) == len(Study(opened(made), "threshold").frame()) == 32
    counted = decodes.groupby(["label", "task", "seed"]).size()
    assert counted.to_dict() == episodes.set_index(["label", "task", "seed"])["decodes"].to_dict()


def test_a_small_parquet_file_that_expands_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MOST_EXPANDED", 2**24)
    for name, column in enumerate((pa.array(["x" * 1000] * 50_000), np.zeros(2**22))):
        path = tmp_path / f"{name}.parquet"
        pq.write_table(pa.table({"a": column}), path, compression="zstd")
        with pytest.raises(ValueError, match="expands to more than"):
            foreign_table(path)
    pq.write_table(pa.table({"a": [1, 2, 3], "b": ["x", "y", "z"]}), path, row_group_size=1)
    assert foreign_table(path, ["b", "c"]).to_pylist() == [{"b": "x"}, {"b": "y"}, {"b": "z"}]
