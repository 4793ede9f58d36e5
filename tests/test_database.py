"""The tables of a results folder: whole or unchanged, whoever dies, whoever else writes, whatever the file holds."""

import contextlib
import dataclasses
import json
import resource
import signal
import sqlite3
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from command import kerv, told
from conftest import python, refused, until
from studies_synthetic import episode, settings_of, study_of, swept, threshold_study

from kerv_cli.base.errors import CheckpointError, StorageError, UsageError
from kerv_cli.cli.common import with_results
from kerv_cli.episodes.rows import decodes_table, episode_row
from kerv_cli.lab import database as module
from kerv_cli.lab.command import STORE, noted, without_passwords
from kerv_cli.lab.database import BLOCKS, DECODES, EPISODES, FILE, RUNS, STUDIES, WANTED, Database, Unanswered, opened
from kerv_cli.lab.runs import Run, making, pulse, run_rows, time_left
from kerv_cli.lab.store import (
    Study,
    counts_of,
    decodes_of,
    frame_of,
    loaded,
    remove_study,
    studies,
    sweep_command,
    version_of,
)
from kerv_cli.training.demonstrations import open_demos

STUDY = threshold_study(["reach-v3"])


def count(database: Database, table: sa.Table) -> int:
    with database.reading() as connection:
        return int(connection.scalar(sa.select(sa.func.count()).select_from(table)) or 0)


BEGUN = """
import os, signal, sys
from test_database import STUDIES, begun, opened
database = opened(sys.argv[1])
"""


def begun(database: Database, name: str) -> None:
    """Write the row of a study if there is none."""
    with database.writing() as connection:
        if connection.execute(STUDIES.select().where(STUDIES.c.name == name)).first() is None:
            connection.execute(STUDIES.insert().values(name=name, kind="sweep", created="", about={}))


@pytest.fixture(scope="module")
def damageable(tmp_path_factory):
    """Bytes of a database with a study."""
    folder = tmp_path_factory.mktemp("damageable")
    swept(folder, STUDY)
    return (folder / FILE).read_bytes()


def test_reading_creates_nothing(database, tmp_path):
    assert studies(database) == run_rows(database) == []
    assert counts_of(Study(opened(tmp_path), "threshold")) == (0, 0)
    assert list(tmp_path.iterdir()) == []


def test_an_episode_comes_back_as_it_was(database):
    setting = STUDY.settings[-1]
    records = {seed: episode(setting, "reach-v3", seed) for seed in range(100_000, 100_004)}
    decodes = records[100_000].decodes
    odd = dataclasses.replace(decodes[0], deviation=0.125, similarity=0.5, compensated=3, skipped=True)
    records[100_000] = dataclasses.replace(records[100_000], decodes=(odd, *decodes[1:]))
    store, _ = swept(database.results, study_of({"ar": settings_of("ar")}, ["reach-v3"]), lambda *_: records.get)
    frame = frame_of(store)
    assert list(frame["seed"]) == list(records)
    for row, record in zip(frame.to_dict("records"), records.values(), strict=True):
        stored = row | {"initial_state": list(row["initial_state"])}
        assert {name: stored[name] for name in episode_row(record)} == episode_row(record)
        assert list(row["decode_seconds"]) == [decode.seconds for decode in record.decodes]
        assert row["device_name"]
        assert decodes_of(store, [row["episode"]]).drop_columns("episode").equals(decodes_table(record))
    assert loaded(store).settings[0].settings == study_of({"ar": settings_of("ar")}, ["reach-v3"]).settings[0].settings


def test_a_failed_transaction_leaves_nothing(database):
    begun(database, "a")
    with pytest.raises(RuntimeError), database.writing() as connection:  # noqa: PT012
        connection.execute(sa.delete(STUDIES))
        raise RuntimeError
    with refused("nowhere", error=StorageError), database.writing() as connection:
        connection.execute(sa.delete(STUDIES))
        connection.execute(sa.text("SELECT * FROM nowhere"))
    with pytest.raises(KeyboardInterrupt), database.writing() as connection:  # noqa: PT012
        try:
            raise KeyboardInterrupt
        finally:  # as a driver may fail to roll back what Ctrl-C has left
            connection.execute(sa.text("SELECT * FROM nowhere"))
    assert count(database, STUDIES) == 1


def test_an_error_in_the_clean_up_after_an_interrupt_is_no_interrupt(database):
    with pytest.raises((StorageError, KeyboardInterrupt), match="nowhere"):  # noqa: PT012
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            with database.writing() as connection:
                connection.execute(sa.text("SELECT * FROM nowhere"))


WRITERS = """
others = []
while len(others) < 2 and (not others or others[-1]):
    others.append(os.fork())
for number in range(10):
    begun(database, f"{len(others)} {others[-1] == 0} {number}")
    begun(database, f"both{number}")
if all(others):
    assert [os.waitpid(other, 0)[1] for other in others] == [0, 0]
"""


def test_first_commands_at_once_create_one_set_of_tables(database, tmp_path):
    with python(BEGUN + WRITERS, tmp_path) as process:
        process.join(60)
        assert process.exitcode == 0
    assert count(database, STUDIES) == 40


def test_a_file_that_another_process_changes_is_waited_for(tmp_path):
    """SQLite refuses the first PRAGMA at once then, whatever the timeout."""
    other = sqlite3.connect(tmp_path / "kerv.db", isolation_level=None, check_same_thread=False)
    other.execute("CREATE TABLE own (x)")
    other.execute("BEGIN IMMEDIATE")
    threading.Timer(0.3, other.execute, ["COMMIT"]).start()
    database = Database(tmp_path)
    begun(database, "a")
    assert count(database, STUDIES) == 1
    other.close()


KILLED = """
with database.writing() as connection:
    connection.execute(STUDIES.delete())
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_kill_in_a_transaction_leaves_nothing(database, tmp_path):
    begun(database, "a")
    with python(BEGUN + KILLED, tmp_path) as process:
        process.join(60)
        assert process.exitcode == -signal.SIGKILL
    begun(database, "b")
    assert count(database, STUDIES) == 2


def test_tables_of_another_kerv_are_refused(database, monkeypatch):
    begun(database, "a")
    monkeypatch.setattr(module, "SCHEMA", "99")
    with refused("of another kerv (schema 2, this one reads 99): choose another folder", error=CheckpointError):
        studies(opened(database.results))
    with pytest.raises(CheckpointError):
        begun(opened(database.results), "b")


@pytest.mark.parametrize("harm", ["cut", "changed", "bits", "empty", "a folder"])
def test_a_damaged_file_is_one_line(tmp_path, harm):
    swept(tmp_path, STUDY)
    path = tmp_path / FILE
    content = path.read_bytes()
    if harm == "a folder":
        path.unlink()
        path.mkdir()
    else:
        path.write_bytes({
            "cut": content[:6000], "empty": b"",
            "changed": content[:4096] + bytes(len(content) - 4096),
            "bits": content.replace(b"CREATE TABLE runs", b"CREATE TABL\xc5 runs"),
        }[harm])  # fmt: skip
    if harm == "empty":  # as a process leaves it that is killed before its first commit
        assert studies(opened(tmp_path)) == []
        return
    remedy = () if harm == "a folder" else ("is damaged", "restore a copy of it, or move it aside")
    with refused(str(path), *remedy):
        frame_of(Study(opened(tmp_path), "threshold"))
    result = kerv("runs", "list", f"results={tmp_path}", code=None)
    assert result.exit_code in (0, 1)
    assert "Traceback" not in result.output


def test_an_error_text_and_numbers_that_databases_refuse_are_stored(database):
    study = study_of({"ar": settings_of("ar"), "naive_sd": settings_of("naive_sd")}, ["reach-v3"])

    def run(setting, task):
        def run_episode(seed):
            if setting.label != "ar":
                raise ValueError("a\0b \udc80")
            record = episode(setting, task, seed)
            decodes = (dataclasses.replace(record.decodes[0], deviation=np.nan), *record.decodes[1:])
            return dataclasses.replace(record, decodes=decodes, initial_state=np.array([np.nan, np.inf, 1.5]))

        return run_episode

    store, outcome = swept(database.results, study, run)
    assert [len(failure.episodes) for failure in outcome.failed] == [4]
    frame = frame_of(store)
    assert frame["initial_state"].tolist() == [(None, None, 1.5)] * 4
    assert frame["deviation_sum"].isna().all()
    with database.reading() as connection:
        errors = set(connection.scalars(sa.select(WANTED.c.error).where(WANTED.c.error.is_not(None))))
    assert all(r"a\x00b \udc80" in error for error in errors)
    with pytest.raises(ValueError, match=r"^a"), Run(database, "target", "mine", ["train", "target"]):
        raise ValueError("a\0b")
    assert run_rows(database, "target")[0].message == r"a\x00b"


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_a_statement_that_takes_too_long_ends(database, monkeypatch):
    monkeypatch.setattr("kerv_cli.lab.database.STATEMENT_SECONDS", 1)
    with refused("statement timeout", error=StorageError), database.reading() as connection:
        connection.execute(sa.text("SELECT pg_sleep(20)"))
    with refused("refused a statement", "check the rights", error=StorageError), database.reading() as connection:
        connection.execute(sa.text("SELECT * FROM nowhere"))


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_a_suspended_transaction_lets_others_write(database, monkeypatch):
    monkeypatch.setattr("kerv_cli.lab.database.IDLE_SECONDS", 1)
    number = sa.select(sa.func.count()).select_from(RUNS)
    with refused("failed", "check that the server runs", error=Unanswered), database.writing() as suspended:
        suspended.execute(sa.text("LOCK TABLE runs"))
        with Database(database.results, database.store).writing() as other:
            assert other.scalar(number) == 0  # it waits until the first has lost its lock
        suspended.scalar(number)


@pytest.mark.parametrize(
    "row",
    [
        "runs.message = CAST(x'ff' AS TEXT)", "studies.about = '{\"other\": 1}'",
        "settings.identity = '{\"target\": 5}'", "episodes.decode_seconds = x'ff'", "episodes.initial_state = '{'",
    ],
)  # fmt: skip
def test_a_damaged_row_is_one_line(damageable, tmp_path, row):
    table, _, change_of = row.partition(".")
    (tmp_path / FILE).write_bytes(damageable)
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as file, file:
        file.execute(f"UPDATE {table} SET {change_of} WHERE rowid = (SELECT min(rowid) FROM {table})")
    refusals = [
        kerv(*words, f"results={tmp_path}", code=None) for words in (["runs", "list"], ["report", "study=threshold"])
    ]
    assert any(run.exit_code == 1 and "is damaged" in run.output for run in refusals)
    assert all("internal error" not in run.output for run in refusals)


@pytest.mark.parametrize("name", ["a?b%20c#d", "mode=ro"])
def test_a_results_folder_may_have_any_name(tmp_path, monkeypatch, name):
    monkeypatch.delenv(STORE, raising=False)
    begun(opened(tmp_path / name), "a")
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")] == [name, f"{name}/{FILE}"]
    assert [one.name for one in studies(opened(tmp_path / name))] == ["a"]


def test_a_locked_file_says_what_else_to_use(tmp_path, monkeypatch):
    begun(opened(tmp_path), "a")
    monkeypatch.setattr(module, "LOCK_SECONDS", 0)
    other = sqlite3.connect(tmp_path / FILE)
    other.execute("BEGIN IMMEDIATE")
    with refused("locked", "local disk", "store=postgresql", error=StorageError):
        begun(opened(tmp_path), "b")
    assert len(studies(opened(tmp_path))) == 1  # readers go on
    other.close()


def test_a_full_disk_keeps_what_was_committed(tmp_path, monkeypatch):
    """A limit on the size of files stands for the disk."""
    study = threshold_study(["reach-v3", "push-v3"], episodes=5)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def filling(setting, task):
        def run(seed):
            if seed == 100_002:
                resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
            return episode(setting, task, seed)

        return run

    try:
        with refused(str(tmp_path / FILE), error=StorageError):
            swept(tmp_path, study, filling)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    store = Study(opened(tmp_path), "threshold")
    assert counts_of(store) == (8, 40)
    assert len(frame_of(store)) == 8
    monkeypatch.setattr("kerv_cli.lab.runs.LAPSE_SECONDS", 1.0)
    swept(tmp_path, study)  # in this process, whose claim could not be released
    assert counts_of(store) == (40, 40)


def test_a_study_that_is_not_there_names_what_to_run(database, tmp_path):
    with refused("no study 'threshold'", "run `kerv sweep study=threshold", error=UsageError):
        loaded(Study(opened(tmp_path), "threshold"))
    for name in ("../up", "a/b", "", ".hidden"):
        with pytest.raises(UsageError, match="study name"):
            Study(opened(tmp_path), name)


def test_a_removed_study_leaves_nothing_but_what_others_want(database):
    store, _ = swept(database.results, STUDY)
    other, _ = swept(database.results, threshold_study(["reach-v3"], radii=(3,), name="other"))
    swept(database.results, STUDY, rerun="all")  # the replaced episodes are the study's, too
    remove_study(store)
    assert [one.name for one in studies(database)] == ["other"]
    assert (count(database, EPISODES), count(database, DECODES)) == (12, 12)
    assert counts_of(other) == (12, 12)
    remove_study(other)
    assert [count(database, table) for table in (EPISODES, DECODES, BLOCKS, STUDIES)] == [0] * 4


def test_a_run_has_a_row_from_its_first_second_to_its_end(database, monkeypatch):
    monkeypatch.setattr("kerv_cli.lab.runs.BEAT_SECONDS", 0.05)

    def row():
        (row,) = run_rows(database, "target", "mine")
        assert row.command == ["train", "target"]
        return row.status, row.done, row.total, row.message

    with Run(database, "target", "mine", ["train", "target"], total=9) as record:
        assert row() == ("running", 0, 9, "")
        record.beat(4)
        until(lambda: row()[1] > 0)  # at the next heartbeat
        assert row() == ("running", 4, 9, "")
    assert row() == ("complete", 9, 9, "")
    with database.writing() as connection:
        connection.execute(sa.delete(RUNS))
    with pytest.raises(ValueError, match="two"), Run(database, "target", "mine", ["train", "target"]):
        raise ValueError("two\nlines")
    assert row() == ("failed", 0, 0, "two lines")


def test_one_query_says_whether_anything_has_changed(database):
    seen = [pulse(database)]
    with Run(database, "target", "mine", ["train", "target"]) as record:
        seen.append(pulse(database))
        record.beat(3, 9)
        seen.append(pulse(database))
        assert time_left(run_rows(database)[0]).endswith("left")
    seen.append(pulse(database))
    store, _ = swept(database.results, STUDY)
    seen.append(pulse(database))
    assert [is_live for _, is_live in seen] == [False, True, True, False, False]
    assert len({version for version, _ in seen}) == len(seen)
    assert pulse(database) == seen[-1]
    before = version_of(store)
    swept(database.results, STUDY, rerun="all")
    assert version_of(store) != before


# --- rows of what was begun, and which database holds them


HOLD = """
import sys
import time
from pathlib import Path
from kerv_cli.lab.command import noted
from kerv_cli.lab.database import opened
from kerv_cli.lab.runs import making
results = Path(sys.argv[1])
words = ["demos", "name=mine", "episodes=7", f"results={results}"]
with noted(words), making(opened(results), "demos", results / "artifacts/demos/mine") as record:
    record.beat(3, 7)
    (results / "begun").touch()
    time.sleep(60)
"""


def listed(results: Path) -> list[dict[str, Any]]:
    return json.loads(told("runs", "list", f"results={results}", "--json"))


def test_a_name_in_use_is_refused_and_a_killed_command_is_listed_with_how_to_go_on(tmp_path):
    again = "kerv demos name=mine episodes=7 results="
    place = tmp_path / "artifacts/demos/mine"
    with python(HOLD, tmp_path) as process:
        until((tmp_path / "begun").exists)
        line = told("demos", "name=mine", "task=reach", f"results={tmp_path}", code=2)
        assert "demos mine is being made on " in line
        assert listed(tmp_path)[0]["state"] == "running, 3 of 7"
        assert "is running" in told("runs", "rm", "demos/mine", "--yes", f"results={tmp_path}", code=2)
        process.kill()
        process.join()
    words = ["demos", "name=mine", "episodes=8"]
    with pytest.raises(UsageError), noted(words), making(opened(tmp_path), "demos", place):
        raise UsageError("these are others")
    (row,) = listed(tmp_path)
    assert (row["id"], row["state"], row["command"][:2]) == ("demos/mine", "interrupted, 3 of 7", ["kerv", "demos"])
    assert again in told("runs", "show", "demos/mine", f"results={tmp_path}")
    place.mkdir(parents=True)
    (place / "recording.json").write_text("{}")
    plan = told("demos", "name=mine", "task=reach", "--plan", f"results={tmp_path}", code=2)
    assert "holds demonstrations with format=None" in plan
    with pytest.raises(CheckpointError, match=again):
        open_demos(Database(tmp_path), "mine")
    told("runs", "rm", "demos/mine", "--yes", f"results={tmp_path}")
    assert listed(tmp_path) == []


def test_a_command_whose_input_cannot_be_read_leaves_no_row(tmp_path):
    """Unless it has made something before, which the row explains."""
    words = ("demos", "import", f"source={tmp_path / 'mistyped'}", "name=mine", f"results={tmp_path}")
    told(*words, code=1)
    assert listed(tmp_path) == []
    folder = tmp_path / "artifacts/target/mine"
    folder.mkdir(parents=True)
    with pytest.raises(CheckpointError), making(opened(tmp_path), "target", folder):
        raise CheckpointError("resume.pt is damaged")
    assert [row.status for row in run_rows(opened(tmp_path))] == ["failed"]


def test_a_store_is_used_by_one_command_and_no_password_is_kept(tmp_path, monkeypatch):
    monkeypatch.delenv(STORE, raising=False)
    url, where = f"sqlite:///{tmp_path}/other.db", f"results={tmp_path}"
    other = Database(tmp_path, url)
    assert other.words == [where, f"store={url}"]  # a suggested command works as it is printed
    with noted(["sweep", "study=demo", f"store={url}", where]), Run(other, "sweep", "demo"):
        pass
    suggested = sweep_command(Study(other, "demo"), "episodes=9")
    assert suggested.split() == ["kerv", "sweep", "study=demo", "episodes=9", where, f"store={url}"]
    assert with_results(f"run '{suggested}'", [where, f"store={url}"]) == f"run '{suggested}'"
    told(*suggested.split()[1:], "--cfg")
    (tmp_path / "artifacts/target/openvla").mkdir(parents=True)  # without a folder the command would leave no row
    told("build", "target", f"checkpoint={tmp_path}", f"store={url}", where, code=1)
    assert [row.status for row in run_rows(other, "target")] == ["failed"]
    assert run_rows(opened(tmp_path)) == []
    monkeypatch.setenv(STORE, url)
    assert len(run_rows(opened(tmp_path), "target")) == 1
    assert run_rows(Database(tmp_path)) == []  # only the command itself reads the variable
    monkeypatch.delenv(STORE)
    store = "store=postgresql://me:secret@127.0.0.1:1/kerv"
    assert "store: postgresql://me@127.0.0.1:1/kerv" in told("build", "target", store, "--cfg")
    query = "store=postgresql://me@127.0.0.1:1/kerv?password=secret&connect_timeout=3&sslpassword=secret"
    shown = told("build", "target", query, "--cfg")
    assert "postgresql://me@127.0.0.1:1/kerv?connect_timeout=3" in shown
    assert "secret" not in shown
    assert "secret" not in told("runs", "list", query, where, code=1)
    line = told("runs", "list", store, where, code=1)
    assert "127.0.0.1:1" in line
    assert "secret" not in line
    assert (
        without_passwords("postgresql://me:se/c?ret@host:1/kerv?sslmode=off")
        == "postgresql://me@host:1/kerv?sslmode=off"
    )
    assert without_passwords("postgresql://host:1/kerv") == "postgresql://host:1/kerv"
    for url in ("nonsense", "mysql://server/kerv", "postgresql://kerv@host:port/kerv"):
        assert "postgresql://USER@HOST/DB" in told("runs", "list", f"store={url}", where, code=2)
