"""What `kerv report --publish` writes, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from studies_synthetic import prepare, threshold_settings, threshold_study

from kerv_cli.lab.execute import execute
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.publish import Unpublishable, refusals
from kerv_cli.report.report import report
from kerv_cli.report.tables import load_study

COMMIT = "c" * 40


def begin(folder: Path, monkeypatch: pytest.MonkeyPatch, commit: str = COMMIT) -> StudyStore:
    """A planned study whose cells say that this commit computed them."""
    for module in ("kerv_cli.lab.execute", "kerv_cli.base.provenance"):
        monkeypatch.setattr(f"{module}.git_commit", lambda: commit)
    store = StudyStore(folder, "threshold")
    store.write_plan(threshold_settings(), threshold_study(["reach-v3", "push-v3"]))
    return store


def test_one_run_of_one_commit_is_published_where_it_is_committed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = begin(tmp_path, monkeypatch)
    execute(store.read_plan().cells, prepare, store)
    draft = report(tmp_path, "threshold")
    assert not (tmp_path / "tables").exists()
    published = report(tmp_path, "threshold", publish=True)
    table = tmp_path / "tables" / "threshold.csv"
    assert table in published.files
    assert table.read_bytes() == (tmp_path / "report" / "tables" / "threshold.csv").read_bytes()
    assert len(draft.files) == len(published.files)


def test_what_is_missing_or_not_committed_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = begin(tmp_path, monkeypatch, f"{COMMIT}+changes")
    execute(store.read_plan().cells[:-1], prepare, store)
    with pytest.raises(Unpublishable) as refused:
        report(tmp_path, "threshold", publish=True)
    assert "1 of its cells are missing" in str(refused.value)
    assert "not committed" in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "tables").exists()


def test_sides_of_several_runs_or_commits_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = begin(tmp_path, monkeypatch)
    cells = store.read_plan().cells
    execute([cell for cell in cells if cell.label == "ar"], prepare, store)
    begin(tmp_path, monkeypatch, "d" * 40)
    execute(cells, prepare, store)
    found = refusals(load_study(store).table)
    assert "its cells are of 2 commits" in found
    assert any(reason.startswith("not measured in one run with the baseline: naive_sd") for reason in found)
    assert any(reason.startswith("not measured in turn with the baseline") for reason in found)


def test_several_machines_are_refused() -> None:
    rows = {"label": ["ar", "x"], "baseline": "ar", "pairs": [0, 3], "same_run": True, "same_block": 1.0}
    table = pd.DataFrame(rows | {"git_commit": COMMIT, "host": ["a", "a;b"], "device_name": "chip", "engine": 1})
    assert refusals(table) == ["its cells are of 2 machines"]
    assert refusals(table.assign(host="a")) == []
