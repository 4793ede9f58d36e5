"""Running a study: resume, isolation of failures, processes that are killed, sweeps at once, executors."""

import contextlib
import gc
import importlib
import os
import re
import signal
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from command import told
from conftest import python, raising, refused, until
from studies_synthetic import (
    count_calls,
    episode,
    misbehave,
    part,
    settings_of,
    slow_elsewhere,
    study_of,
    swept,
    threshold_study,
    unhurried,
)

from kerv_cli.base.errors import KervError, StorageError, UsageError
from kerv_cli.base.files import visible
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.cli.common import progress_bar
from kerv_cli.cli.work import event_printer
from kerv_cli.lab.database import BLOCKS, EPISODES, RUNS, WANTED, Database
from kerv_cli.lab.events import BlockStarted, BlockWaits, EpisodeEnd, Event, SettingFailed
from kerv_cli.lab.execute import RunEpisode
from kerv_cli.lab.plan import Setting, Study, blocks_of
from kerv_cli.lab.store import StudyStore, plan_study
from kerv_cli.lab.study import estimate
from kerv_cli.report.tables import further_of, load_study

STUDY = threshold_study(["reach-v3"])
TWO = threshold_study(["reach-v3", "push-v3"])


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr("kerv_cli.lab.execute._POLL_SECONDS", 0.02)


def claims(database: Database) -> int:
    with database.reading() as connection:
        return len(connection.execute(sa.select(BLOCKS).where(BLOCKS.c.claim.is_not(None))).all())


def episodes(database: Database) -> int:
    with database.reading() as connection:
        return int(connection.scalar(sa.select(sa.func.count()).select_from(EPISODES)) or 0)


def errors(database: Database) -> list[str]:
    with database.reading() as connection:
        return list(connection.scalars(sa.select(WANTED.c.error).where(WANTED.c.error.is_not(None))))


def test_the_settings_of_a_block_take_turns_in_a_recorded_order(database):
    study, ran = threshold_study(["reach-v3"], episodes=7), []  # two blocks: five seeds and two

    def noting(setting, task):
        def run(seed):
            ran.append((setting.label, seed))
            return episode(setting, task, seed)

        return run

    store, _ = swept(database.results, study, noting)
    turns = [one for block in blocks_of(study.episodes, study.block) for one in block.turns()]
    assert ran == [(one.setting.label, one.seed) for one in turns]
    table = store.frame().sort_values(["started", "order"])
    assert list(zip(table["label"], table["seed"], strict=True)) == ran
    assert list(table["order"]) == [*range(20), *range(8)]
    assert table["block"].nunique() == 2
    run, calls = count_calls()
    _, outcome = swept(database.results, study, run)
    assert calls == outcome.done == []
    assert len(outcome.reused) == 28


def test_each_episode_is_committed_when_it_ends(database):
    told: list[tuple[int, int]] = []

    def on_event(event):
        if isinstance(event, EpisodeEnd):
            told.append(StudyStore(Database(database.results), "threshold").counts())

    store, _ = swept(database.results, STUDY, on_event=on_event)
    assert told == [(number, 16) for number in range(1, 17)]
    with pytest.raises(KeyboardInterrupt):
        swept(database.results, TWO, raising(KeyboardInterrupt(), "ar", [100_002]))
    assert store.counts()[0] in range(24, 28)  # two seeds of four settings, and some of the third
    assert claims(database) == 0
    there = store.counts()[0]
    _, outcome = swept(database.results, TWO)
    assert (len(outcome.reused), len(outcome.done)) == (there, 32 - there)


def test_a_setting_that_raises_is_dropped_from_its_block_alone(database):
    events: list[Event] = []
    bad = raising(RuntimeError("the gripper\nfell off"), "naive_sd", [100_002])
    store, outcome = swept(database.results, STUDY, bad, on_event=events.append)
    assert len(outcome.done) == 14
    (failure,) = outcome.failed
    assert [(one.setting.label, one.seed) for one in failure.episodes] == [("naive_sd", 100_002), ("naive_sd", 100_003)]
    assert failure.reason.startswith("RuntimeError: the gripper fell off (conftest.py:")
    assert ["fell off" in text for text in errors(database)] == [True, True]
    assert sum(isinstance(event, EpisodeEnd) for event in events) == 14
    assert [event for event in events if isinstance(event, SettingFailed)] == [failure]
    _, outcome = swept(database.results, STUDY)
    assert (len(outcome.done), outcome.failed, errors(database)) == (2, [], [])
    assert store.counts() == (16, 16)


def test_an_error_of_kerv_is_told_in_its_own_words(database):
    def unprepared(setting, task):
        raise UsageError("no drafter fits this target: run `kerv train drafter`")

    _, outcome = swept(database.results, STUDY, unprepared)
    assert {failure.reason for failure in outcome.failed} == {"no drafter fits this target: run `kerv train drafter`"}
    with pytest.raises(StorageError):
        swept(database.results, STUDY, raising(StorageError("cannot write x.rrd: the disk is full")))
    assert claims(database) == 0


@pytest.mark.parametrize("workers", [1, 2])
def test_a_study_that_is_deleted_while_it_runs_says_so(tmp_path, workers):
    def remove(event):
        if isinstance(event, EpisodeEnd):
            StudyStore(tmp_path, "threshold").remove()

    with pytest.raises(KervError, match="threshold was deleted"):
        swept(tmp_path, STUDY, unhurried, runtime=RuntimeSettings(workers=workers), on_event=remove)
    store, outcome = swept(tmp_path, STUDY)
    assert (outcome.failed, store.counts(), claims(store.database)) == ([], (16, 16), 0)


def test_a_sweep_goes_on_when_another_plans_fewer_episodes(database):
    """The study is what was planned last. What the longer sweep runs is kept, and found by the next one."""
    fewer = threshold_study(["reach-v3"], episodes=1)

    def plan_fewer(event):
        if isinstance(event, EpisodeEnd):
            StudyStore(database, "threshold").save(fewer)

    store, outcome = swept(database.results, STUDY, on_event=plan_fewer)
    assert (len(outcome.done), outcome.failed, store.counts()[1]) == (16, [], 4)
    _, outcome = swept(database.results, STUDY)
    assert (outcome.done, len(outcome.reused), store.counts()) == ([], 16, (16, 16))


SWEEP = """
import os
import sys
import studies_synthetic as s
from kerv_cli.lab import execute
execute._POLL_SECONDS = 0.02
execute.code_hash()  # once, before the processes part
study = s.threshold_study(["reach-v3", "push-v3"], episodes=2, radii=(3,))
workers, processes = int(sys.argv[3]), int(sys.argv[4])
children = []
while len(children) < processes - 1 and (not children or children[-1]):
    children.append(os.fork())
s.swept(sys.argv[1], study, getattr(s, sys.argv[2]), runtime=s.RuntimeSettings(workers=workers))
if all(children):
    assert [os.waitpid(child, 0)[1] for child in children] == [0] * len(children)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_workers_of_a_killed_sweep_end_and_its_claims_are_taken_over(tmp_path):
    store = StudyStore(tmp_path, "threshold")
    with python(SWEEP, tmp_path, "slow_elsewhere", 2, 1) as process:  # the first task at once, the other in a minute
        until(lambda: store.counts()[0] == 6)
        until(lambda: claims(store.database) == 1)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        assert children
        process.kill()
        process.wait()
    until(lambda: not any(Path(f"/proc/{child}").exists() for child in children), 10.0)
    assert (store.counts(), claims(store.database)) == ((6, 12), 1)
    _, outcome = swept(tmp_path, threshold_study(["reach-v3", "push-v3"], episodes=2, radii=(3,)))
    assert (len(outcome.reused), len(outcome.done), claims(store.database)) == (6, 6, 0)


FAR, SILENT = {"host": "far"}, {"heartbeat": 0.0}
CHANGES = [(SILENT, True), (FAR, True), (FAR | SILENT, False), ({"status": "failed"}, False)]


@pytest.mark.parametrize(("change", "held"), CHANGES)
def test_a_claim_lasts_as_long_as_its_run(database, change, held):
    """On another machine as long as it was heard of. What it runs meanwhile is not run again."""
    seen: list[bool] = []

    def claimed(event):
        if isinstance(event, BlockStarted):
            with database.writing() as connection:
                connection.execute(sa.update(RUNS).values(**change))
            with contextlib.suppress(InterruptedError):
                swept(database.results, STUDY, on_event=noted)

    def noted(event):
        if isinstance(event, BlockWaits | BlockStarted):
            seen.append(isinstance(event, BlockWaits))
            raise InterruptedError

    swept(database.results, STUDY, on_event=claimed)
    assert seen == [held]


def test_sweeps_at_once_run_each_episode_once(database):
    with python(SWEEP, database.results, "unhurried", 1, 4) as process:
        assert process.wait(60) == 0
    assert episodes(database) == 12
    assert StudyStore(database, "threshold").counts() == (12, 12)
    assert claims(database) == 0


def test_a_sweep_that_begins_in_the_middle_of_another_runs_nothing_twice(database):
    """Its blocks are smaller: some of their episodes were there when it was planned."""
    outcomes = []
    with ThreadPoolExecutor(1) as pool:

        def on_event(event):
            if isinstance(event, EpisodeEnd) and not outcomes and StudyStore(database, "threshold").counts()[0] == 5:
                outcomes.append(pool.submit(swept, database.results, STUDY))
                until(lambda: plan_study(database, STUDY).existing)
                time.sleep(0.3)

        swept(database.results, STUDY, on_event=on_event)
        _, outcome = outcomes[0].result()
    assert episodes(database) == 16
    assert (len(outcome.done), len(outcome.reused)) == (0, 16)


@pytest.mark.parametrize("seconds", [0.3, 60.0])
def test_episodes_whose_message_comes_late_are_waited_for(seconds, tmp_path, monkeypatch):
    """A network folder shows files late. Episodes that are never heard of have failed."""

    def shown(folder):
        return [path for path in visible(folder) if time.time() - path.stat().st_mtime > seconds]

    monkeypatch.setattr("kerv_cli.lab.execute.visible", shown)
    monkeypatch.setattr("kerv_cli.lab.execute.LATE_SECONDS", min(10.0, 60.0 - seconds), raising=False)
    store, outcome = swept(tmp_path, STUDY, runtime=RuntimeSettings(workers=2))
    lost = [one for failure in outcome.failed for one in failure.episodes]
    assert (len(outcome.done), len(lost)) == ((16, 0) if seconds < 1 else (0, 16))
    assert store.counts() == (len(outcome.done), 16)


def in_order() -> Study:
    """A setting whose result depends on the order of its episodes, beside one that is not so."""
    settings = settings_of("retrieval")
    settings.skip = part("skip", "similarity", up=0.25)
    return study_of({"ar": settings_of("ar"), "heisd": settings}, ["reach-v3"])


def killed_at_the_third(setting: Setting, task: str) -> RunEpisode:
    def run(seed):
        if (setting.label, seed) == ("ar", 100_002):
            os.kill(os.getpid(), signal.SIGKILL)
        return episode(setting, task, seed)

    return run


KILLS_ITS_PROCESS_ONCE = """
import os
import signal
from pathlib import Path
from examples.point_mass import PointWorld

start = PointWorld._start

def start_or_die(self, seed):
    armed = Path(__file__).with_name("armed")
    if seed == 100_002 and armed.exists():
        armed.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    return start(self, seed)

PointWorld._start = start_or_die
"""
POINTS = """
baseline: short
common: task=POINT policy=expert episodes=6 record=0
block: 1
settings: {short: world.horizon=30, long: world.horizon=60}
"""


def test_workers_run_each_episode_once_though_one_is_killed(tmp_path, monkeypatch):
    """A worker lives on after its first block. The episode that was running is lost, and the same command runs it."""
    importlib.import_module("examples.point_mass")
    (tmp_path / "killing.py").write_text(KILLS_ITS_PROCESS_ONCE)
    (tmp_path / "armed").touch()
    monkeypatch.setenv("KERV_PLUGINS", "killing")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, sys.path)]))
    monkeypatch.syspath_prepend(str(tmp_path))  # loky gives it to its workers
    (tmp_path / "points.yaml").write_text(POINTS)
    words = ("sweep", f"study={tmp_path / 'points.yaml'}", f"results={tmp_path / 'results'}")

    def sweep(workers: int, code: int | None) -> tuple[int, int]:
        counts = re.search(r"(\d+) run, (\d+) reused", told(*words, f"runtime.workers={workers}", code=code))
        assert counts
        return int(counts[1]), int(counts[2])

    run, reused = sweep(2, None)
    assert (run in (11, 12), reused) == (True, 0)
    assert not (tmp_path / "armed").exists()
    assert sweep(1, 0) == (12 - run, run)
    assert episodes(Database(tmp_path / "results")) == 12


def test_episodes_whose_order_counts_run_whole_again_when_their_process_dies(tmp_path):
    store, outcome = swept(tmp_path, in_order(), killed_at_the_third, runtime=RuntimeSettings(workers=2))
    assert [one.setting.label for failure in outcome.failed for one in failure.episodes] == ["ar", "ar"]
    assert len(outcome.done) == 2 + 4
    frame = store.frame().query("label == 'heisd'")
    assert (len(frame), frame["block"].nunique()) == (4, 1)
    assert {one.setting.label for one in plan_study(store.database, in_order()).missing} == {"ar"}


def test_estimates_say_what_they_rest_on(database):
    def planned(workers):
        return plan_study(database, TWO, runtime=RuntimeSettings(workers=workers))

    seconds, source = estimate(planned(1), 10.0)
    assert (seconds, "guess" in source) == (32 * 10.0, True)
    store, _ = swept(database.results, threshold_study(["reach-v3"], radii=()))
    wall = store.frame().groupby("label")["wall_seconds"].mean()
    seconds, source = estimate(planned(2), 10.0)
    assert seconds == pytest.approx((4 * wall.sum() + 16 * wall.mean()) / 2)
    assert source == "measured on 8 stored episodes"


def test_progress_without_a_terminal_is_plain_lines(tmp_path, capsys):
    swept(tmp_path, threshold_study(["reach-v3"], episodes=1))
    with progress_bar("episodes") as show:
        bad = raising(ValueError("[bold] is not markup"), "naive_sd")
        swept(tmp_path, STUDY, bad, on_event=event_printer(show))
    written = capsys.readouterr().err
    lines = written.splitlines()
    assert lines[0] == "4 episodes there already"
    assert any(line.startswith("naive_sd on reach-v3: failed: ValueError: [bold] is not markup") for line in lines)
    assert re.fullmatch(r"12/12 .* on reach-v3, seed 100003: (success|failure), \d\.\d s", lines[-2])
    assert re.fullmatch(r"episodes 12/12, reach-v3 100001-100003: 4 settings in turn", lines[-1])
    assert "\x1b" not in written


@pytest.mark.parametrize(("load", "lines"), [(2.0, 0), (3.0, 1)])
def test_a_busy_machine_is_said_once_and_kept(load, lines, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("os.getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    with progress_bar("episodes") as show:
        store, _ = swept(tmp_path, STUDY, on_event=event_printer(show))
    assert capsys.readouterr().err.count("the load average is 1.5 per core") == lines
    (told,) = {about["provenance"]["load"] for about in further_of(load_study(store))["labels"].values()}
    assert told == str(load / 2)


def runtime(executor: str, **options: Any) -> RuntimeSettings:
    return RuntimeSettings(workers=2, executor=executor, executor_options=options)


@pytest.fixture
def cluster(monkeypatch):
    """Slurm jobs, as processes on this machine."""
    pytest.importorskip("submitit")
    # seconds that it waits for the result of a job that was killed
    monkeypatch.setattr("submitit.core.core.Job._results_timeout_s", 1)
    # workers import this folder's modules
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # submitit's: files left to the collector
        yield runtime("slurm", cluster="local")
        gc.collect()


@pytest.mark.parametrize(
    ("executor", "tasks", "killed", "threads"),
    [
        ("local", ["reach-v3", "push-v3"], "its worker process was killed by SIGKILL", 3.0),
        ("slurm", ["reach-v3"], "its job", 1.0),  # Slurm itself would set the variable
    ],
)
def test_only_the_guilty_settings_fail(executor, tasks, killed, threads, request, tmp_path):
    """One setting kills its process, one raises what cannot be pickled; the rest of their blocks still takes turns."""
    where = request.getfixturevalue("cluster") if executor == "slurm" else RuntimeSettings(workers=2)
    study = threshold_study(tasks, episodes=2, radii=(1, 3, 5))
    for setting in study.settings:
        setting.settings["runtime"]["threads"] = 3  # type: ignore[index]
    store, outcome = swept(tmp_path, study, misbehave, runtime=where)
    reasons = {failure.episodes[0].setting.label: failure.reason for failure in outcome.failed}
    assert len(outcome.failed) == 2 * len(tasks)
    assert killed in reasons["spec_vla r=1"]
    assert reasons["spec_vla r=5"].startswith("Odd: 1 and 2")
    done = len(tasks) * (3 * 2 + 1)
    assert len(outcome.done) == done
    table = store.frame()
    assert (set(table["executor"]), set(table["workers"])) == ({executor}, {2})
    assert table["run"].nunique() == 1
    assert set(table["wall_seconds"]) == {threads}  # OMP_NUM_THREADS
    assert claims(store.database) == 0
    assert not list(tmp_path.glob(".spool*"))
    _, again = swept(tmp_path, study)
    assert (len(again.reused), len(again.done)) == (done, 10 * len(tasks) - done)


def test_an_interrupt_ends_a_clusters_work(cluster, tmp_path):
    ended: list[Event] = []

    def interrupt(event):
        ended.extend([event] if isinstance(event, EpisodeEnd) else [])
        if len(ended) == 16:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        swept(tmp_path, TWO, slow_elsewhere, runtime=cluster, on_event=interrupt)
    store = StudyStore(tmp_path, "threshold")
    assert (store.counts(), claims(store.database)) == ((16, 32), 0)


WRONG = {
    "did you mean slurm": RuntimeSettings(executor="slrum"),
    "runtime.workers=0": RuntimeSettings(workers=0),
    "minutes": runtime("slurm", minutes="long"),
    "partition: unexpected": runtime("local", partition="x"),
    "Slurm cannot be used": runtime("slurm"),
    "pip install 'kerv[slurm]'": runtime("slurm", cluster="local"),
}


@pytest.mark.parametrize("message", WRONG)
def test_a_wrong_executor_is_refused_in_one_line(message, tmp_path, monkeypatch):
    settings = WRONG[message]
    if "pip install" in message:
        monkeypatch.setattr(importlib.util, "find_spec", lambda package: None)
    elif settings.executor == "slurm":
        pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", "")  # no srun, wherever the test runs
    with refused(message, error=UsageError):
        swept(tmp_path, STUDY, runtime=settings)


def test_a_job_that_slurm_refuses_is_refused_in_one_line(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    for name, script in (
        ("srun", ""),
        ("sbatch", "echo 'error: Memory specification can not be satisfied' >&2; exit 1"),
    ):
        (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    with refused("Memory specification can not be satisfied", "runtime.executor_options", error=UsageError):
        swept(tmp_path / "results", STUDY, runtime=runtime("slurm", memory_gb=100_000))
