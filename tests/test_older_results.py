"""A results folder of version 0.1.0: its runs are listed and reported."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

from typer.testing import CliRunner

from kerv_cli.cli.app import app

ARCHIVE = Path(__file__).parent / "fixtures" / "results-0.1.0.tar.xz"


def works(*arguments: str) -> str:
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == 0, result.output
    return result.stdout


def test_runs_of_version_0_1_0_are_listed_and_reported(tmp_path: Path) -> None:
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    results = f"results={tmp_path}/results"
    runs = json.loads(works("runs", "list", results, "--json"))
    assert {run["state"] for run in runs} == {"complete"}
    kinds = ["calibration", "datastore", "demos", "drafter", "early", "rollout", "rollout", "sweep", "target"]
    assert sorted(run["kind"] for run in runs) == kinds
    table = json.loads(works("report", "study=four-methods", results, "--json"))["studies"]["four-methods"]
    assert {row["label"] for row in table} == {"ar", "spec_vla", "heisd", "one_pass_streak"}
    assert {row["episodes"] for row in table} == {6}
    assert all(row["speedup"] > 0 for row in table)
