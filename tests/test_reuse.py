"""What was measured stays: a plan runs what is missing and says why; the rest comes from this study or from another."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import pandas as pd
import pytest
from studies_synthetic import (
    IDENTITY,
    count_calls,
    part,
    prepare,
    settings_of,
    threshold_settings,
    threshold_study,
)

from kerv_cli.base.settings import RolloutSettings
from kerv_cli.lab import identity
from kerv_cli.lab.execute import execute
from kerv_cli.lab.plan import Cell, plan
from kerv_cli.lab.reuse import Covered, Stock, cover, disagreements, take_over
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.summary import not_in_turn
from kerv_cli.report.tables import load_study


@pytest.fixture
def store(tmp_path: Path) -> StudyStore:
    return StudyStore(tmp_path, "threshold")


def to_run(covered: Covered) -> dict[tuple[str, tuple[int, ...]], str]:
    """(label, seeds) of what runs -> why."""
    return {(c.label, c.seeds): covered.reasons[c.id] for c in covered.cells if c.id in covered.reasons}


def swept(store: StudyStore, cells: list[Cell], rerun: str = "never") -> Covered:
    covered = cover(cells, Stock(store), rerun)
    take_over(covered)
    store.write_plan(threshold_settings(), covered.cells)
    assert not execute(covered.cells, prepare, store).failed
    return covered


def table_of(store: StudyStore) -> pd.DataFrame:
    return load_study(store).table.query("averaging == 'micro over tasks'").set_index("label")


def test_other_code_a_rename_and_a_new_part_run_nothing_again(
    store: StudyStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    cells = threshold_study(["reach-v3"])
    swept(store, cells)
    monkeypatch.setattr("kerv_cli.lab.reuse.code_hash", lambda: "f" * 64)
    assert not cover(cells, Stock(store)).reasons
    assert set(cover(cells, Stock(store), "changed").reasons.values()) == {"other code"}


def test_more_episodes_run_only_the_new_seeds_in_turn(store: StudyStore) -> None:
    swept(store, threshold_study(["reach-v3", "push-v3"], episodes=3, radii=(3,)))
    covered = swept(store, threshold_study(["reach-v3", "push-v3"], episodes=5, radii=(3,)))
    assert set(to_run(covered)) == {(name, (100_003, 100_004)) for name in ("ar", "naive_sd", "spec_vla r=3")}
    assert set(covered.reasons.values()) == {"new seeds"}
    row = table_of(store).loc["spec_vla r=3"]
    assert (row["pairs"], row["same_block"]) == (10, 1.0)
    assert row["speedup"] > 0


def test_fewer_episodes_are_a_part_of_what_is_there(store: StudyStore) -> None:
    swept(store, threshold_study(["reach-v3"], episodes=5))
    covered = swept(store, threshold_study(["reach-v3"], episodes=2))
    assert not covered.reasons
    assert table_of(store)["episodes"].tolist() == [2, 2, 2, 2]


def test_another_study_runs_only_what_it_does_not_share(store: StudyStore) -> None:
    swept(store, threshold_study(["reach-v3"]))
    other = StudyStore(store.root.parent.parent, "other")
    settings = {
        "renamed": settings_of("spec_vla", 3),
        "ar": settings_of("ar"),
        "new": settings_of("spec_vla", 15),
    }
    covered = swept(other, plan(settings, ["reach-v3"], IDENTITY, baseline="ar"))
    assert to_run(covered) == {("new", (100_000, 100_001, 100_002, 100_003)): "new setting"}
    assert len(covered.sources) == 2
    shutil.rmtree(store.root)  # the copies are the other study's own
    assert len(table_of(other)) == 3


def test_a_cell_that_is_damaged_in_another_study_runs_here(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])
    swept(store, cells)
    (store.cells / cells[0].id / "decodes.parquet").write_bytes(b"torn")
    other = StudyStore(store.root.parent.parent, "other")
    swept(other, cells)
    assert other.damages() == []
    assert table_of(other)["episodes"].tolist() == [4, 4, 4, 4]


def test_times_of_other_blocks_are_no_ratio_until_they_are_taken_in_turn(store: StudyStore) -> None:
    swept(store, threshold_study(["reach-v3"], radii=(3,)))
    swept(store, threshold_study(["reach-v3"], radii=(3, 9)))
    table = table_of(store).reset_index()
    assert not_in_turn(table) == ["spec_vla r=9"]
    assert table.set_index("label").loc["spec_vla r=9", "pairs"] == 4  # successes are compared

    covered = swept(store, threshold_study(["reach-v3"], radii=(3, 9)), "timed")
    assert set(covered.reasons.values()) == {"times wanted in turn"}
    assert not_in_turn(table_of(store).reset_index()) == []
    assert not cover(threshold_study(["reach-v3"], radii=(3, 9)), Stock(store), "timed").reasons


def test_a_rerun_keeps_the_older_measurement_beside_it(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])
    first = swept(store, cells)
    covered = swept(store, cells, "all")
    assert set(covered.reasons.values()) == {"rerun=all"}
    assert len(store.folders()) == 8
    assert {cell.id for cell in covered.cells}.isdisjoint(cell.id for cell in first.cells)
    assert [c.id for c in cover(cells, Stock(store)).cells] == [c.id for c in covered.cells], "the newest counts"


def test_an_interrupted_rerun_goes_on(store: StudyStore) -> None:
    cells, words = threshold_study(["reach-v3"]), ["sweep", "rerun=all"]
    swept(store, cells)
    store.note_command(["sweep"])
    store.note_finished()
    assert store.interrupted_since(words) == ""
    store.note_command(words)
    since = store.interrupted_since(words)
    begun = cover(cells, Stock(store), "all", since)
    execute([cell for cell in begun.cells if cell.label == "ar"], prepare, store)
    status = store.cells / begun.cells[0].id / "status.json"
    value = json.loads(status.read_text())
    status.write_text(json.dumps({**value, "started": "2999-01-01T00:00:00"}))  # the synthetic episodes run in no time
    assert "ar" not in {label for label, _ in to_run(cover(cells, Stock(store), "all", since))}


def test_reasons_name_what_changed(store: StudyStore, monkeypatch: pytest.MonkeyPatch) -> None:
    swept(store, threshold_study(["reach-v3"]))

    def why(settings: RolloutSettings, task: str = "reach-v3", weights: dict[str, str] = IDENTITY) -> str:
        (cell,) = plan({"spec_vla r=3": settings}, [task], weights)
        return next(iter(cover([cell], Stock(store)).reasons.values()), "")

    same = settings_of("spec_vla", 3)
    assert why(same) == ""
    assert why(same, "push-v3") == "new task"
    assert why(settings_of("spec_vla", 4)) == "threshold.r 3 → 4"
    assert why(same, weights={**IDENTITY, "target": "c" * 64}) == "weights of mt10-vision changed"
    another = dataclasses.replace(same, policy=dataclasses.replace(same.policy, target="mine"))
    assert why(another, weights={**IDENTITY, "target": "c" * 64}) == "new setting"  # nobody's weights changed
    monkeypatch.setattr(identity, "ENGINE", 4)
    monkeypatch.setattr(identity.work_of, "__defaults__", (4,))
    monkeypatch.setattr("kerv_cli.lab.reuse.ENGINE", 4)
    assert why(same) == "engine 1 → 4"


def test_settings_without_an_effect_do_not_count(store: StudyStore) -> None:
    swept(store, threshold_study(["reach-v3"]))
    idle = settings_of("ar")
    idle.threshold.r = 5  # nothing is drafted
    (cell,) = plan({"ar": idle}, ["reach-v3"], IDENTITY)
    assert not cover([cell], Stock(store)).reasons


def test_what_depends_on_the_order_of_episodes_is_reused_whole(store: StudyStore) -> None:
    def cells(episodes: int) -> list[Cell]:
        settings = settings_of("retrieval", episodes=episodes)
        settings.skip = part("skip", "similarity", up=0.25)
        return plan({"ar": settings_of("ar", episodes=episodes), "heisd": settings}, ["reach-v3"], IDENTITY)

    swept(store, cells(2))
    covered = cover(cells(4), Stock(store))
    assert to_run(covered) == {
        ("ar", (100_002, 100_003)): "new seeds",
        ("heisd", (100_000, 100_001, 100_002, 100_003)): "new seeds",
    }


def test_the_same_work_with_other_results_is_said(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"], radii=())
    swept(store, cells)
    again = cover(cells, Stock(store), "all")

    def other(cell: Cell):  # type: ignore[no-untyped-def]
        run = prepare(cell)
        return lambda seed: dataclasses.replace(run(seed), success=not run(seed).success)

    execute(again.cells, other, store)
    told = disagreements(again.cells, Stock(store, others=False))
    assert len(told) == 2
    assert "are the same work (ar on reach-v3) and differ in 4 episodes, e.g. seed 100000" in told[0]


def test_a_damaged_cell_is_set_aside_and_run_again(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])
    swept(store, cells)
    (store.cells / cells[1].id / "decodes.parquet").write_bytes(b"torn")
    failed = execute(cover(cells, Stock(store)).cells, prepare, store).failed
    assert [one.cell.label for one in failed] == ["naive_sd"]
    assert "sets it aside" in failed[0].reason
    (name,) = [name for name, _ in store.damages()]
    assert (store.set_aside(name) / "decodes.parquet").read_bytes() == b"torn"
    run, calls = count_calls()
    execute(cover(cells, Stock(store)).cells, run, store)
    assert calls == ["naive_sd"]


def test_a_study_renamed_by_hand_is_the_study_of_its_new_name(store: StudyStore) -> None:
    swept(store, threshold_study(["reach-v3"]))
    store.root.rename(store.root.with_name("better"))
    assert load_study(StudyStore(store.root.parent.parent, "better")).plan.name == "better"
    assert not cover(threshold_study(["reach-v3"]), Stock(store)).reasons, "found in the other folder"
