"""Two runs of one study: how far their ratios agree."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from studies_synthetic import prepare, threshold_settings, threshold_study

from kerv_cli.base.errors import UsageError
from kerv_cli.lab.execute import execute
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.agreement import agreement_summary, agreement_table
from kerv_cli.report.report import report
from kerv_cli.report.tables import load_study, study_table


def run(results: Path) -> StudyStore:
    store = StudyStore(results, "threshold")
    cells = threshold_study(["reach-v3", "push-v3"])
    store.write_plan(threshold_settings(), cells)
    execute(cells, prepare, store)
    return store


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two runs, `one` and `two`."""
    made = tmp_path_factory.mktemp("runs")
    for name in ("one", "two"):
        run(made / name)
    return made


@pytest.fixture(scope="module")
def tables(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    first, second = (study_table(load_study(StudyStore(folder / name, "threshold"))) for name in ("one", "two"))
    return first, second


def test_a_shifted_ratio_is_neither_close_nor_within_the_intervals(tables: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    own, other = tables
    same = agreement_table(own, other)
    assert same["ratio"].to_list() == pytest.approx([1.0] * len(same))
    assert same["close"].all()
    assert same["overlap"].all()
    assert set(same["label"]) == {"naive_sd", "spec_vla r=3", "spec_vla r=9"}

    shifted = other.copy()
    at = shifted["label"] == "spec_vla r=9"
    shifted.loc[at, ["speedup", "speedup_low", "speedup_high"]] *= 1.5
    found = agreement_table(own, shifted).set_index(["averaging", "label"])
    row = found.loc[("micro over tasks", "spec_vla r=9")]
    assert row["ratio"] == pytest.approx(1.5)
    assert not row["close"]
    assert not row["overlap"]
    assert found.loc[("micro over tasks", "spec_vla r=3"), "close"]


def test_a_difference_of_three_percent_is_the_most_that_is_close(tables: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    own, other = tables
    for factor, close in ((1.029, True), (1.031, False), (0.971, True), (0.969, False)):
        moved = other.assign(speedup=other["speedup"] * factor)
        assert agreement_table(own, moved)["close"].tolist() == [close] * 6


def test_the_command_writes_the_table_and_says_how_many_agree(folder: Path) -> None:
    found = report(folder / "one", "threshold", against=str(folder / "two"))
    assert found.agreement is not None
    assert folder / "one/report/tables/threshold_agreement.csv" in found.files
    assert "3 of 3 ratios agree within 3 %" in str(agreement_summary(found.agreement).caption)


def test_what_cannot_be_compared_is_one_line(folder: Path, tables: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    own, other = tables
    with pytest.raises(UsageError, match="both hold episodes of run"):
        agreement_table(own, own)
    with pytest.raises(UsageError, match="baselines ar and naive_sd"):
        agreement_table(own, other.assign(baseline="naive_sd"))
    with pytest.raises(UsageError, match="no setting in common"):
        agreement_table(own, other.assign(label=other["label"] + " again"))
    with pytest.raises(UsageError, match="study=NAME"):
        report(folder / "one", against=str(folder / "two"))
