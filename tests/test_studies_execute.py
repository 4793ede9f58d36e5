"""Running cells: resume, isolation of failures, processes that are killed, what is told meanwhile."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console
from studies_synthetic import count_calls, misbehave, run_cell, slow_cell, threshold_study

from kerv_cli.decoding.record import EpisodeRecord
from kerv_cli.errors import StorageError, UsageError
from kerv_cli.studies.events import CellDone, CellFailed, CellReused, CellStarted, Event, SweepFinished, SweepStarted
from kerv_cli.studies.execute import estimate, execute
from kerv_cli.studies.plan import Cell
from kerv_cli.studies.progress import ProgressDisplay
from kerv_cli.studies.store import StudyStore


@pytest.fixture
def store(tmp_path: Path) -> StudyStore:
    return StudyStore(tmp_path, "threshold")


def labels(cells: list[Cell]) -> list[str]:
    return [cell.label for cell in cells]


def test_only_missing_cells_are_run(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])
    run, calls = count_calls()
    execute(cells[:2], run, store)
    outcome = execute(cells, run, store)
    assert calls == labels(cells)
    assert labels(outcome.reused) == labels(cells[:2])
    assert labels(outcome.done) == labels(cells[2:])
    assert execute(cells, run, store).done == []


def test_two_labels_of_one_result_run_once(store: StudyStore) -> None:
    cell = threshold_study(["reach-v3"])[0]
    run, calls = count_calls()
    outcome = execute([cell, Cell(**{**vars(cell), "label": "again"})], run, store)
    assert calls == ["ar"]
    assert len(outcome.done) == 1


def test_a_cell_that_raises_does_not_end_the_others(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])
    bad = cells[1]

    def run(cell: Cell) -> list[EpisodeRecord]:
        if cell is bad:
            raise RuntimeError("the gripper\nfell off")
        return run_cell(cell)

    events: list[Event] = []
    outcome = execute(cells, run, store, on_event=events.append)
    assert len(outcome.done) == 3
    (failure,) = outcome.failed
    assert failure.cell is bad
    assert re.fullmatch(r"RuntimeError: the gripper fell off \(test_studies_execute\.py:\d+\)", failure.reason)
    trace = store.failures / f"{bad.id}.txt"
    assert "fell off" in trace.read_text()
    assert not store.has_cell(bad.id)
    kinds = [type(event) for event in events]
    assert kinds[0] is SweepStarted
    assert kinds[-1] is SweepFinished
    assert kinds.count(CellStarted) == 4
    assert kinds.count(CellDone) == 3
    assert kinds.count(CellFailed) == 1
    assert execute(cells, run_cell, store).failed == []
    assert not trace.exists()


def test_an_error_of_kerv_is_told_in_its_own_words(store: StudyStore) -> None:
    def run(cell: Cell) -> list[EpisodeRecord]:
        raise UsageError("no drafter fits this target: run `kerv train drafter`")

    outcome = execute(threshold_study(["reach-v3"])[:1], run, store)
    assert outcome.failed[0].reason == "no drafter fits this target: run `kerv train drafter`"


def test_a_full_disk_ends_the_sweep(store: StudyStore) -> None:
    def run(cell: Cell) -> list[EpisodeRecord]:
        raise StorageError("cannot write rollouts/x.rrd: the disk is full")

    with pytest.raises(StorageError, match="disk is full"):
        execute(threshold_study(["reach-v3"]), run, store)


def test_an_interrupt_keeps_what_is_complete(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])

    def run(cell: Cell) -> list[EpisodeRecord]:
        if cell is cells[2]:
            raise KeyboardInterrupt
        return run_cell(cell)

    with pytest.raises(KeyboardInterrupt):
        execute(cells, run, store)
    assert [store.has_cell(cell.id) for cell in cells] == [True, True, False, False]


def test_a_damaged_cell_is_a_failure_not_a_crash(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])
    execute(cells[:1], run_cell, store)
    (store.cells / cells[0].id / "episodes.parquet").unlink()
    outcome = execute(cells, run_cell, store)
    assert labels(outcome.done) == labels(cells[1:])
    assert "delete that folder" in outcome.failed[0].reason


def test_a_cell_that_another_sweep_completes_meanwhile_is_not_run_again(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])[:2]
    run, calls = count_calls()

    def with_company(cell: Cell) -> list[EpisodeRecord]:
        store.write_cell(cells[1], run_cell(cells[1]), {})
        return run(cell)

    events: list[Event] = []
    outcome = execute(cells, with_company, store, on_event=events.append)
    assert calls == ["ar"]
    assert labels(outcome.reused) == ["naive_sd"]
    assert any(isinstance(event, CellReused) for event in events)


def test_over_processes_only_the_guilty_cells_fail(store: StudyStore) -> None:
    """One cell kills its process, one raises what cannot be pickled; the workers serve more than one cell each."""
    cells = threshold_study(["reach-v3"], radii=(1, 3, 5, 9, 15, 20))
    for cell in cells:
        cell.settings["runtime"]["threads"] = 3
    outcome = execute(cells, misbehave, store, workers=2)
    reasons = {failure.cell.label: failure.reason for failure in outcome.failed}
    assert set(reasons) == {"spec_vla r=1", "spec_vla r=5"}
    assert reasons["spec_vla r=1"] == "its worker process was killed by SIGKILL"
    assert reasons["spec_vla r=5"].startswith("Odd: 1 and 2")
    assert len(outcome.done) == 6
    stored = [store.read_cell(cell.id) for cell in outcome.done]
    pids = {cell.status["pid"] for cell in stored}
    assert os.getpid() not in pids
    assert 2 <= len(pids) <= 3
    assert {cell.status["workers"] for cell in stored} == {2}
    assert len({cell.status["run"] for cell in stored}) == 1
    assert {seconds for cell in stored for seconds in cell.episodes["wall_seconds"]} == {3.0}  # OMP_NUM_THREADS
    again = execute(cells, run_cell, store)
    assert sorted(labels(again.done)) == ["spec_vla r=1", "spec_vla r=5"]


KILLED_PARENT = """
import sys
from studies_synthetic import slow_cell, threshold_study
from kerv_cli.studies.execute import execute
from kerv_cli.studies.store import StudyStore

execute(threshold_study(["reach-v3"]), slow_cell, StudyStore(sys.argv[1], "threshold"), workers=2)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_workers_of_a_killed_sweep_end_and_complete_cells_stay(store: StudyStore, tmp_path: Path) -> None:
    assert slow_cell  # what the script runs: the first cell quickly, the others for a minute
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, "-c", KILLED_PARENT, str(tmp_path)], env=environment)
    first = threshold_study(["reach-v3"])[0]
    deadline = time.monotonic() + 30
    while not (store.cells / first.id).exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    worker = store.read_cell(first.id).status["pid"]
    assert Path(f"/proc/{worker}").exists()
    process.send_signal(signal.SIGKILL)
    process.wait()
    while Path(f"/proc/{worker}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()
    assert store.has_cell(first.id)
    assert [path.name for path in store.cells.iterdir()] == [first.id]


def test_estimates_say_what_they_rest_on(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3", "push-v3"])
    guess = estimate(cells, store, 1, 10.0)
    assert (guess.seconds, guess.to_run, guess.reused, guess.measured) == (8 * 4 * 10.0, 8, 0, False)
    assert "guess" in guess.source
    execute(cells[:2], run_cell, store)
    wall = {c.label: store.read_cell(c.id).episodes["wall_seconds"].mean() for c in cells[:2]}
    found = estimate(cells, store, 2, 10.0)
    mean = (wall["ar"] + wall["naive_sd"]) / 2
    assert found.seconds == pytest.approx((4 * wall["ar"] + 4 * wall["naive_sd"] + 16 * mean) / 2)
    assert (found.to_run, found.reused, found.measured) == (6, 2, True)


def test_progress_without_a_terminal_is_plain_lines(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])
    execute(cells[:1], run_cell, store)
    written = io.StringIO()

    def run(cell: Cell) -> list[EpisodeRecord]:
        if cell.label == "naive_sd":
            raise ValueError("[bold] is not markup")
        return run_cell(cell)

    with ProgressDisplay(Console(file=written, width=60)) as display:
        execute(cells, run, store, on_event=display)
    lines = written.getvalue().splitlines()
    assert lines[0] == "1 cells are complete already"
    assert re.match(r"1/3 naive_sd on reach-v3: failed: ValueError: \[bold\] is not markup", lines[1])
    assert re.fullmatch(r"3/3 spec_vla r=9 on reach-v3: \d/4 succeeded, \d\.\d s per episode", lines[3])
    assert "\x1b" not in written.getvalue()


def test_progress_on_a_terminal_is_a_bar_that_goes_away(store: StudyStore) -> None:
    written = io.StringIO()
    with ProgressDisplay(Console(file=written, width=100, force_terminal=True)) as display:
        execute(threshold_study(["reach-v3"]), run_cell, store, on_event=display)
    assert "4/4" in written.getvalue()
    assert written.getvalue().count("\x1b[?25h") == 1  # the cursor is shown again


def test_no_workers_is_refused(store: StudyStore) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        execute([], run_cell, store, workers=0)
