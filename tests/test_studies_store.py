"""The results folder: complete or absent, whoever dies and whoever else writes."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from studies_synthetic import episode, run_cell, threshold_settings, threshold_study

from kerv_cli.base.errors import CheckpointError, StorageError, UsageError
from kerv_cli.base.leftovers import is_left_over
from kerv_cli.engine.record import PHASES
from kerv_cli.lab import claims, rows
from kerv_cli.lab.plan import Cell
from kerv_cli.lab.store import ROLLOUTS, StudyStore, begun_studies

STATUS = {"run": "r", "workers": 1, "device_name": "test"}


@pytest.fixture
def store(tmp_path: Path) -> StudyStore:
    return StudyStore(tmp_path, "threshold")


@pytest.fixture
def cell() -> Cell:
    return threshold_study(["reach-v3"])[-1]


def python(script: str, *arguments: object) -> subprocess.Popen[str]:
    """A real process that knows the tests' helpers."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", script, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str]) -> str:
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    return out


def test_records_come_back_as_they_were(store: StudyStore, cell: Cell) -> None:
    records = run_cell(cell)
    first = dataclasses.replace(records[0].decodes[0], deviation=0.125, similarity=0.5, compensated=3, skipped=True)
    records[0] = dataclasses.replace(records[0], decodes=(first, *records[0].decodes[1:]))
    assert store.write_cell(cell, records, STATUS)
    stored = pq.read_table(store.cells / cell.id / "decodes.parquet").to_pylist()
    expected = [row for record in records for row in rows.decode_rows(record)]
    assert stored == json.loads(json.dumps(expected))  # tuples are lists there
    for row, decode in zip(stored, (d for record in records for d in record.decodes), strict=True):
        assert tuple(row["tokens"]) == decode.tokens
        assert row["actions"] == decode.actions.tolist()
        assert [r["accepted"] for r in row["rounds"]] == [r.accepted for r in decode.rounds]
        assert row["seconds"] == decode.seconds
    assert (stored[0]["deviation"], stored[0]["similarity"], stored[0]["skipped"]) == (0.125, 0.5, True)
    seconds = store.read_cell(cell.id).episodes["decode_seconds"]
    assert [list(s) for s in seconds] == [[d.seconds for d in record.decodes] for record in records]


def test_a_cell_tells_what_it_is(store: StudyStore, cell: Cell) -> None:
    store.write_cell(cell, run_cell(cell), STATUS)
    stored = store.read_cell(cell.id)
    assert stored.config["settings"] == cell.settings
    assert stored.config["identity"] == cell.identity
    assert stored.status["device_name"] == "test"
    assert set(stored.episodes["worker_pid"]) == {os.getpid()}
    assert list(stored.episodes["seed"]) == list(cell.seeds)
    assert sorted(path.name for path in stored.folder.iterdir()) == [
        "config.yaml",
        "decodes.parquet",
        "episodes.parquet",
        "status.json",
    ]


def test_episode_rows_sum_their_decodes(cell: Cell) -> None:
    record = episode(cell, 100_000)
    row = rows.episode_row(record, rows.Circumstances())
    assert sum(row[f"seconds.{phase}"] for phase in PHASES) == pytest.approx(row["seconds"])
    assert row["seconds.verify"] == pytest.approx(sum(d.phases["verify"] for d in record.decodes))
    assert row["committed"] + row["decodes"] == row["tokens"]  # the prefill gives one token of each chunk
    assert row["committed"] > row["accepted"]


def test_an_unknown_phase_is_refused(cell: Cell) -> None:
    record = episode(cell, 100_000)
    odd = dataclasses.replace(record.decodes[0], phases={"thinking": 1.0})
    with pytest.raises(ValueError, match="thinking"):
        rows.episode_row(dataclasses.replace(record, decodes=(odd,)), rows.Circumstances())


def test_records_of_other_seeds_are_refused(store: StudyStore, cell: Cell) -> None:
    with pytest.raises(ValueError, match="other episodes"):
        store.write_cell(cell, run_cell(cell)[:-1], STATUS)
    assert not store.has_cell(cell.id)


KILLED_WRITER = """
import os, signal, sys
from studies_synthetic import run_cell, threshold_study
from pathlib import Path
from kerv_cli.base import files
from kerv_cli.lab import store as module

cell = threshold_study(["reach-v3"])[-1]
store = module.StudyStore(sys.argv[1], "threshold")
records = run_cell(cell)
write, sync = Path.write_bytes, files.sync
for stage in range(9):  # within each of the four files, before each sync
    child = os.fork()
    if child == 0:
        left = [stage]
        def die_when_due():
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            left[0] -= 1
        def half_written(path, content):
            write(path, content[: len(content) // 2])
            die_when_due()
            write(path, content)
        Path.write_bytes = half_written
        files.sync = lambda folder: (die_when_due(), sync(folder))
        store.write_cell(cell, records, {})
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL, (stage, status)
    assert not store.has_cell(cell.id), stage
"""


def test_a_writer_killed_at_any_point_leaves_no_half_cell(store: StudyStore, cell: Cell, tmp_path: Path) -> None:
    finish(python(KILLED_WRITER, tmp_path))
    left = list(store.cells.iterdir())
    assert len(left) == 1  # each attempt removed what the one before it left
    assert all(is_left_over(folder) for folder in left)
    assert store.write_cell(cell, run_cell(cell), STATUS)
    assert store.has_cell(cell.id)
    assert [folder.name for folder in store.cells.iterdir()] == [cell.id]


def test_a_new_run_appears_with_its_plan_and_its_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = StudyStore(tmp_path, "20260301-142530-ar", ROLLOUTS)

    def full(old: Path, new: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "rename", full)
    with pytest.raises(StorageError):
        store.begin(threshold_settings(), threshold_study(["reach-v3"]), ["rollout"])
    assert list((tmp_path / ROLLOUTS).iterdir()) == []
    monkeypatch.undo()
    for _ in range(2):
        store.begin(threshold_settings(), threshold_study(["reach-v3"]), ["rollout"])
    assert sorted(path.name for path in store.root.iterdir()) == ["plan.yaml", "run.json"]
    assert [command.arguments for command in store.commands()] == [("rollout",)] * 2


def test_the_folder_of_failures_goes_with_the_last_one(store: StudyStore) -> None:
    for name in ("a", "b"):
        store.write_failure(name, "trace")
    store.clear_failure("a")
    assert store.failures.is_dir()
    store.clear_failure("b")
    assert not store.failures.exists()


def test_claims_exclude_others_until_their_process_is_gone(store: StudyStore) -> None:
    cells, folder = threshold_study(["reach-v3"]), store.claims
    assert claims.claim(folder, cells[:2], "run", "block1")
    assert not claims.claim(folder, cells[1:], "other", "block2")  # one of them is taken: none is
    assert not claims.is_claimed(folder, cells[2])
    claims.note_running(folder, cells[1], "block1", 3)
    assert claims.running_cell(folder, cells, "block1") is cells[1]
    assert claims.running_cell(folder, cells, "block2") is None
    assert [claims.episodes_ended(folder, block) for block in ("block1", "block2")] == [3, 0]
    claims.release(folder, cells, "block2")
    assert claims.is_claimed(folder, cells[0])
    claims.release(folder, cells, "block1")
    assert list(folder.iterdir()) == []


def test_what_a_killed_sweep_claimed_is_removed(store: StudyStore) -> None:
    cells, folder = threshold_study(["reach-v3"]), store.claims
    assert claims.claim(folder, cells[:1], "run", "living")
    claims.note_running(folder, cells[0], "living")
    assert claims.claim(folder, cells[1:2], "run", "dead")
    claims.note_running(folder, cells[1], "dead")
    path = folder / f"{cells[1].id}.json"
    path.write_text(path.read_text().replace(str(os.getpid()), "999999999"))
    (folder / "old.running").write_text("x")
    (folder / f"{cells[2].id}.json").write_text("[")
    claims.clean_void(folder)
    assert sorted(p.name for p in folder.iterdir()) == sorted([f"{cells[0].id}.json", "living.running"])


@pytest.mark.parametrize(("host", "pid", "hours", "held"), [
    ("here", "dead", 0, False), ("here", "alive", 0, True), ("here", "alive", 7, False),
    ("elsewhere", "dead", 0, True), ("elsewhere", "dead", 7, False),
])  # fmt: skip
def test_claims_expire(store: StudyStore, cell: Cell, host: str, pid: str, hours: float, held: bool) -> None:
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)
    assert claims.claim(store.claims, [cell], "run", "block")
    path = store.claims / f"{cell.id}.json"
    value = json.loads(path.read_text())
    value |= {"host": value["host"] if host == "here" else host, "pid": child if pid == "dead" else os.getpid()}
    path.write_text(json.dumps(value))
    os.utime(path, (0, time.time() - 3600 * hours))
    assert claims.is_claimed(store.claims, cell) is held
    assert claims.claim(store.claims, [cell], "other", "block2") is not held
    if hours and host == "elsewhere":  # a block whose episodes still begin is alive, however old its claim
        path.write_text(json.dumps({**value, "block": "block3"}))
        os.utime(path, (0, time.time() - 3600 * hours))
        claims.note_running(store.claims, cell, "block3")
        assert claims.is_claimed(store.claims, cell)


CONCURRENT_WRITER = """
import pathlib, sys, time
from studies_synthetic import run_cell, threshold_settings, threshold_study
from kerv_cli.lab.store import StudyStore

results, me, task = sys.argv[1:]
store = StudyStore(results, "threshold")
shared = threshold_study(["reach-v3", "push-v3", "door-open-v3", "drawer-open-v3"], episodes=1, radii=(1, 3, 5, 9, 15))
records = {cell.id: run_cell(cell) for cell in shared}
pathlib.Path(results, me).touch()
while len(list(pathlib.Path(results).glob("writer*"))) < 2:
    time.sleep(0.001)
won = sum(store.write_cell(cell, records[cell.id], {"writer": me}) for cell in shared)
for _ in range(5):
    store.write_plan(threshold_settings(), threshold_study([task], episodes=1))
print(won)
"""


def test_two_writers_in_one_folder(store: StudyStore, tmp_path: Path) -> None:
    writers = [
        python(CONCURRENT_WRITER, tmp_path, "writer1", "reach-v3"),
        python(CONCURRENT_WRITER, tmp_path, "writer2", "push-v3"),
    ]
    won = [int(finish(writer)) for writer in writers]
    names = sorted(path.name for path in store.cells.iterdir())
    assert sum(won) == len(names) == 28  # each cell by exactly one of them, nothing temporary left
    assert all(store.has_cell(name) for name in names)
    assert {cell.task for cell in store.read_plan().cells} == {"reach-v3", "push-v3"}


def test_the_first_writer_wins(store: StudyStore, cell: Cell) -> None:
    assert store.write_cell(cell, run_cell(cell), {**STATUS, "writer": 1})
    assert not store.write_cell(cell, run_cell(cell), {**STATUS, "writer": 2})
    assert store.read_cell(cell.id).status["writer"] == 1


@pytest.mark.parametrize("file", ["config.yaml", "episodes.parquet", "decodes.parquet", "status.json"])
@pytest.mark.parametrize("harm", ["cut", "gone", "changed"])
def test_a_damaged_cell_is_named_with_its_remedy(store: StudyStore, cell: Cell, file: str, harm: str) -> None:
    store.write_cell(cell, run_cell(cell), STATUS)
    path = store.cells / cell.id / file
    content = path.read_bytes()
    if harm == "gone":
        path.unlink()
    elif harm == "cut":
        path.write_bytes(content[: len(content) // 2])
    else:
        path.write_bytes(content.replace(b"s", b"z", 40))
    for look in (store.has_cell, store.read_cell):
        with pytest.raises(CheckpointError) as caught:
            look(cell.id)
        message = str(caught.value)
        assert str(store.cells / cell.id) in message
        assert "`kerv doctor --repair` sets it aside" in message
        assert "\n" not in message


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EACCES])
@pytest.mark.parametrize("function", ["fsync", "mkdir", "rename"])
def test_a_disk_that_refuses(
    store: StudyStore, cell: Cell, monkeypatch: pytest.MonkeyPatch, function: str, code: int
) -> None:
    records = run_cell(cell)
    store.cells.mkdir(parents=True)

    def refuse(*arguments: Any, **keywords: Any) -> None:
        raise OSError(code, os.strerror(code))

    with monkeypatch.context() as patched:
        patched.setattr(os, function, refuse)
        with pytest.raises(StorageError) as caught:
            store.write_cell(cell, records, STATUS)
    assert str(store.cells / cell.id) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(store.cells.iterdir()) == []


def test_a_plan_on_a_full_disk_keeps_the_old_one(store: StudyStore, monkeypatch: pytest.MonkeyPatch) -> None:
    store.write_plan(threshold_settings(), threshold_study(["reach-v3"]))
    before = store.plan_path.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match="disk is full"):
        store.write_plan(threshold_settings(), threshold_study(["push-v3"]))
    assert store.plan_path.read_bytes() == before


def test_a_study_that_is_not_there_names_what_to_run(store: StudyStore, cell: Cell) -> None:
    with pytest.raises(UsageError, match=r"no study 'threshold'.*run `kerv sweep study=threshold`"):
        store.read_plan()
    with pytest.raises(UsageError, match=r"no complete cell: run `kerv sweep study=threshold`"):
        store.read_cells([cell])
    with pytest.raises(CheckpointError, match="is missing: run `kerv sweep"):
        store.read_cell(cell.id)


@pytest.mark.parametrize("name", ["../up", "a/b", "", ".hidden"])
def test_a_study_name_is_a_folder_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match="study name"):
        StudyStore(tmp_path, name)


def test_listing(store: StudyStore, tmp_path: Path) -> None:
    cells = threshold_study(["reach-v3"])
    store.write_plan(threshold_settings(), cells)
    store.write_cell(cells[0], run_cell(cells[0]), STATUS)
    StudyStore(tmp_path, "planned").write_plan(dataclasses.replace(threshold_settings(), name="planned"), cells)
    assert begun_studies(tmp_path) == ["threshold"]
    assert begun_studies(tmp_path / "nowhere") == []


def test_status_is_json_for_people(store: StudyStore, cell: Cell) -> None:
    store.write_cell(cell, run_cell(cell), STATUS)
    status = json.loads((store.cells / cell.id / "status.json").read_text())
    assert status["state"] == "complete"
    assert status["episodes"] == 4
