"""Running cells: resume, isolation of failures, processes that are killed, what is told meanwhile."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console
from studies_synthetic import (
    count_calls,
    episode,
    misbehave,
    prepare,
    run_cell,
    slow_elsewhere,
    threshold_study,
    unhurried,
)

from kerv_cli.base.errors import StorageError, UsageError
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.cli.progress import ProgressDisplay
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.lab.claims import is_claimed
from kerv_cli.lab.events import BlockRuns, BlockStarted, CellEnd, Event, SweepStarted
from kerv_cli.lab.execute import RunEpisode, execute
from kerv_cli.lab.plan import Cell, blocks_of
from kerv_cli.lab.reuse import Stock, cover, estimate
from kerv_cli.lab.store import StudyStore


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


def test_the_settings_of_a_block_take_turns_in_a_recorded_order(store: StudyStore) -> None:
    """Seed by seed, every setting once per seed, not always in the same order."""
    cells = threshold_study(["reach-v3"], episodes=7)  # two blocks: five seeds and two
    ran: list[tuple[str, int]] = []

    def noting(cell: Cell) -> RunEpisode:
        def run(seed: int) -> EpisodeRecord:
            ran.append((cell.label, seed))
            return episode(cell, seed)

        return run

    execute(cells, noting, store)
    assert [seed for _, seed in ran] == sorted(4 * list(range(100_000, 100_007)))
    orders = [tuple(label for label, seed in ran if seed == wanted) for wanted in range(100_000, 100_007)]
    assert {frozenset(order) for order in orders} == {frozenset(labels(cells))}
    assert len(set(orders)) > 2
    table = pd.concat([store.read_cell(cell.id).episodes.assign(label=cell.label) for cell in cells])
    table = table.sort_values(["started", "order"])
    assert list(zip(table["label"], table["seed"], strict=True)) == ran
    assert list(table["order"]) == [*range(20), *range(8)]
    assert table["block"].nunique() == 2
    assert table["started"].is_monotonic_increasing
    (again,) = blocks_of([cell for cell in threshold_study(["reach-v3"], episodes=7) if len(cell.seeds) == 5])
    assert [tuple(again.cells[i].label for i in again.order(seed)) for seed in again.seeds] == orders[:5]


def test_a_setting_that_raises_is_dropped_from_its_block_alone(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])
    bad, third = cells[1], cells[1].seeds[2]
    tried = []

    def breaking(cell: Cell) -> RunEpisode:
        def run(seed: int) -> EpisodeRecord:
            if cell is bad:
                tried.append(seed)
                if seed == third:
                    raise RuntimeError("the gripper\nfell off")
            return episode(cell, seed)

        return run

    events: list[Event] = []
    outcome = execute(cells, breaking, store, on_event=events.append)
    assert tried == list(bad.seeds[:3])
    assert len(outcome.done) == 3
    (failure,) = outcome.failed
    assert failure.cell is bad
    assert re.fullmatch(r"RuntimeError: the gripper fell off \(test_studies_execute\.py:\d+\)", failure.reason)
    trace = store.failures / f"{bad.id}.txt"
    assert "fell off" in trace.read_text()
    assert not store.has_cell(bad.id)
    kinds = [type(event) for event in events]
    assert kinds[:2] == [SweepStarted, BlockStarted]
    assert kinds[2:] == [CellEnd] * 4
    assert [event for event in events if isinstance(event, CellEnd) and event.reason] == [failure]
    assert execute(cells, prepare, store).failed == []
    assert not trace.exists()
    store.write_failure(bad.id, "of a command that was killed before it removed this")
    assert len(execute(cells, prepare, store).reused) == len(cells)
    assert not store.failures.exists()


def test_an_error_of_kerv_is_told_in_its_own_words(store: StudyStore) -> None:
    def unprepared(cell: Cell) -> RunEpisode:
        raise UsageError("no drafter fits this target: run `kerv train drafter`")

    outcome = execute(threshold_study(["reach-v3"])[:1], unprepared, store)
    assert outcome.failed[0].reason == "no drafter fits this target: run `kerv train drafter`"


def test_a_full_disk_ends_the_sweep(store: StudyStore) -> None:
    def full(cell: Cell) -> RunEpisode:
        raise StorageError("cannot write rollouts/x.rrd: the disk is full")

    with pytest.raises(StorageError, match="disk is full"):
        execute(threshold_study(["reach-v3"]), full, store)


def test_an_interrupt_keeps_what_is_complete(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3", "push-v3"])

    def interrupted(cell: Cell) -> RunEpisode:
        if cell is cells[6]:
            raise KeyboardInterrupt
        return prepare(cell)

    with pytest.raises(KeyboardInterrupt):
        execute(cells, interrupted, store)
    assert [store.has_cell(cell.id) for cell in cells] == [True] * 4 + [False] * 4
    assert list(store.claims.iterdir()) == []


def test_a_damaged_cell_is_a_failure_not_a_crash(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])
    execute(cells[:1], prepare, store)
    (store.cells / cells[0].id / "episodes.parquet").unlink()
    outcome = execute(cells, prepare, store)
    assert labels(outcome.done) == labels(cells[1:])
    assert "sets it aside" in outcome.failed[0].reason


def test_a_cell_that_is_completed_meanwhile_is_not_run_again(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])[:2]
    run, calls = count_calls()

    def with_company(cell: Cell) -> RunEpisode:
        store.write_cell(cells[1], run_cell(cells[1]), {})
        return run(cell)

    events: list[Event] = []
    outcome = execute(cells, with_company, store, on_event=events.append)
    assert calls == ["ar"]
    assert labels(outcome.reused) == ["naive_sd"]
    assert any(isinstance(event, CellEnd) and event.reused for event in events)


def test_two_sweeps_share_the_work(store: StudyStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """Started together, they run every cell once, and both end with all of them."""
    monkeypatch.setattr("kerv_cli.lab.execute._POLL_SECONDS", 0.02)
    cells = threshold_study(["reach-v3", "push-v3", "door-open-v3"])
    ran: list[tuple[str, str]] = []

    def noting(cell: Cell) -> RunEpisode:
        ran.append((cell.label, cell.task))
        time.sleep(0.02)
        return prepare(cell)

    with ThreadPoolExecutor(2) as pool:
        outcomes = [future.result() for future in [pool.submit(execute, cells, noting, store) for _ in range(2)]]
    assert sorted(ran) == sorted((cell.label, cell.task) for cell in cells)
    assert all(len(outcome.done) + len(outcome.reused) == len(cells) for outcome in outcomes)
    assert all(outcome.failed == [] for outcome in outcomes)


def test_over_processes_only_the_guilty_cells_fail(store: StudyStore) -> None:
    """One cell kills its process, one raises what cannot be pickled; the rest of their blocks still runs in turns."""
    cells = threshold_study(["reach-v3", "push-v3"], radii=(1, 3, 5, 9))
    for cell in cells:
        cell.settings["runtime"]["threads"] = 3
    outcome = execute(cells, misbehave, store, RuntimeSettings(workers=2))
    reasons = {failure.cell.label: failure.reason for failure in outcome.failed}
    assert sorted(labels([failure.cell for failure in outcome.failed])) == 2 * ["spec_vla r=1"] + 2 * ["spec_vla r=5"]
    assert reasons["spec_vla r=1"] == "its worker process was killed by SIGKILL"
    assert reasons["spec_vla r=5"].startswith("Odd: 1 and 2")
    assert len(outcome.done) == 8
    stored = [store.read_cell(cell.id) for cell in outcome.done]
    assert os.getpid() not in {cell.status["pid"] for cell in stored}
    assert {cell.status["workers"] for cell in stored} == {2}
    assert len({cell.status["run"] for cell in stored}) == 1
    assert len({block for cell in stored for block in cell.episodes["block"]}) == 2  # one attempt per task
    assert {seconds for cell in stored for seconds in cell.episodes["wall_seconds"]} == {3.0}  # OMP_NUM_THREADS
    assert list(store.claims.iterdir()) == []
    again = execute(cells, prepare, store)
    assert sorted(labels(again.done)) == sorted(labels([failure.cell for failure in outcome.failed]))


KILLED_PARENT = """
import sys
from studies_synthetic import slow_elsewhere, threshold_study
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.lab.execute import RunEpisode, execute
from kerv_cli.lab.store import StudyStore

cells = threshold_study(["reach-v3", "push-v3"])
execute(cells, slow_elsewhere, StudyStore(sys.argv[1], "threshold"), RuntimeSettings(workers=2))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_workers_of_a_killed_sweep_end_and_complete_cells_stay(store: StudyStore, tmp_path: Path) -> None:
    assert slow_elsewhere  # what the script runs: the first task quickly, the other for minutes
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, "-c", KILLED_PARENT, str(tmp_path)], env=environment)
    cells = threshold_study(["reach-v3", "push-v3"])
    deadline = time.monotonic() + 60
    while not all(store.has_cell(cell.id) for cell in cells[:4]) and time.monotonic() < deadline:
        time.sleep(0.05)
    while not is_claimed(store.claims, cells[4]) and time.monotonic() < deadline:
        time.sleep(0.05)
    worker = json.loads((store.claims / f"{cells[4].id}.json").read_text())["pid"]
    assert Path(f"/proc/{worker}").exists()
    process.send_signal(signal.SIGKILL)
    process.wait()
    while Path(f"/proc/{worker}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()
    assert not is_claimed(store.claims, cells[4])
    assert [store.has_cell(cell.id) for cell in cells] == [True] * 4 + [False] * 4
    assert len(execute(cells, prepare, store).done) == 4


def test_estimates_say_what_they_rest_on(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3", "push-v3"])
    guess = estimate(cover(cells, Stock(store)), 1, 10.0)
    assert (guess.seconds, guess.to_run, guess.reused) == (8 * 4 * 10.0, 8, 0)
    assert "guess" in guess.source
    execute(cells[:2], prepare, store)
    wall = {c.label: store.read_cell(c.id).episodes["wall_seconds"].mean() for c in cells[:2]}
    found = estimate(cover(cells, Stock(store)), 2, 10.0)
    mean = (wall["ar"] + wall["naive_sd"]) / 2
    assert found.seconds == pytest.approx((4 * wall["ar"] + 4 * wall["naive_sd"] + 16 * mean) / 2)
    assert (found.to_run, found.reused) == (6, 2)
    assert "measured on 8 stored episodes" in found.source


def test_progress_without_a_terminal_is_plain_lines(store: StudyStore) -> None:
    cells = threshold_study(["reach-v3"])
    execute(cells[:1], prepare, store)
    written = io.StringIO()

    def run(cell: Cell) -> RunEpisode:
        if cell.label == "naive_sd":
            raise ValueError("[bold] is not markup")
        return prepare(cell)

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
    assert "16/16 episodes" in written.getvalue()  # cells of a block end together
    assert written.getvalue().count("\x1b[?25h") == 1  # the cursor is shown again


def test_a_block_in_another_process_tells_its_episodes_as_they_end(
    store: StudyStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kerv_cli.lab.execute._POLL_SECONDS", 0.02)
    monkeypatch.setattr("kerv_cli.cli.progress.LOG_SECONDS", -1.0)
    written, events = io.StringIO(), list[Event]()
    with ProgressDisplay(Console(file=written, width=60)) as display:

        def on_event(event: Event) -> None:
            events.append(event)
            display(event)

        execute(threshold_study(["reach-v3"]), unhurried, store, RuntimeSettings(workers=2), on_event)
    told = [event.ended for event in events if isinstance(event, BlockRuns)]
    assert told == sorted(told)
    assert told[0] == 0
    assert len(set(told)) > 4
    told_first = r"^0/16 episodes, reach-v3 100000-100003: 4 settings in turn$"
    told_later = r"^\d+/16 episodes, about \d+ s left; reach-v3 100000-100003: 4 settings in turn$"
    assert all(re.search(line, written.getvalue(), re.M) for line in (told_first, told_later))


def test_no_workers_is_refused(store: StudyStore) -> None:
    with pytest.raises(UsageError, match=r"runtime\.workers=0: from 1 to"):
        execute([], prepare, store, RuntimeSettings(workers=0))
