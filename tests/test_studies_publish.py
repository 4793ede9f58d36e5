"""What `kerv report --publish` writes, and what it refuses."""

from dataclasses import replace

import pandas as pd
import pytest
from studies_synthetic import swept, threshold_study

from kerv_cli.lab.database import Database
from kerv_cli.lab.store import StudyStore, plan_study
from kerv_cli.report.report import Unpublishable, refusals, report
from kerv_cli.report.tables import load_study

COMMIT = "c" * 40
STUDY = threshold_study(["reach-v3", "push-v3"])


@pytest.fixture(autouse=True)
def commit(monkeypatch):
    """Sets the commit that computes what follows."""

    def is_of(name):
        monkeypatch.setattr("kerv_cli.targets.provenance.git_commit", lambda: name)

    is_of(COMMIT)
    return is_of


def test_one_run_of_one_commit_is_published_where_it_is_committed(tmp_path):
    swept(tmp_path, STUDY)
    draft = report(tmp_path, "threshold")
    assert not (tmp_path / "tables").exists()
    published = report(tmp_path, "threshold", publish=True)
    table = tmp_path / "tables" / "threshold.csv"
    assert table in published.files
    assert table.read_bytes() == (tmp_path / "report" / "tables" / "threshold.csv").read_bytes()
    assert len(draft.files) == len(published.files)


def test_what_is_missing_or_not_committed_is_refused(tmp_path, commit):
    commit(f"{COMMIT}+changes")
    swept(tmp_path, replace(STUDY, episodes=STUDY.episodes[:-1]))
    StudyStore(tmp_path, "threshold").save(STUDY, plan_study(Database(tmp_path), STUDY).existing)
    with pytest.raises(Unpublishable) as refused:
        report(tmp_path, "threshold", publish=True)
    assert "1 of its episodes are missing" in str(refused.value)
    assert "not committed" in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "tables").exists()


def test_sides_of_several_runs_or_commits_are_refused(tmp_path, commit):
    swept(tmp_path, replace(STUDY, episodes=tuple(one for one in STUDY.episodes if one.setting.label == "ar")))
    commit("d" * 40)
    store, _ = swept(tmp_path, STUDY)
    found = refusals(load_study(store).table)
    assert "its episodes are from 2 commits" in found
    assert any(reason.startswith("not measured in one run with the baseline: naive_sd") for reason in found)
    assert any(reason.startswith("not measured in turn with the baseline") for reason in found)


def test_several_machines_are_refused():
    rows = {"label": ["ar", "x"], "baseline": "ar", "pairs": [0, 3], "same_run": True, "same_block": 1.0}
    table = pd.DataFrame(rows | {"git_commit": COMMIT, "host": ["a", "a;b"], "device_name": "chip", "engine": 1})
    assert refusals(table) == ["its episodes are from 2 machines"]
    assert refusals(table.assign(host="a")) == []
