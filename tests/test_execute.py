"""Running a study: resume, isolation of failures, workers that are killed or stopped, sweeps at once."""

import contextlib
import os
import re
import signal
import sqlite3
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import sqlalchemy as sa
import torch
from command import told
from conftest import python, raising, refused, until
from examples.point_mass import SPEC as POINT_MASS
from studies_synthetic import (
    brisk,
    episode,
    episodes_of,
    part,
    planned,
    pretending,
    settings_of,
    study_of,
    swept,
    threshold_study,
)

from kerv_cli.base.errors import Interrupted, KervError, StorageError, UsageError
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.cli.common import progress_bar
from kerv_cli.cli.studies import event_printer
from kerv_cli.lab.database import EPISODES, UNFINISHED, WANTED, WORKERS, Database, clock, opened
from kerv_cli.lab.plan import blocks_of
from kerv_cli.lab.queue import MOST_DEATHS, ClaimLost, Queue
from kerv_cli.lab.runs import Presence
from kerv_cli.lab.store import Study, counts_of, frame_of, remove_study
from kerv_cli.lab.study import save
from kerv_cli.lab.work import (
    BlockStarted,
    Counted,
    EpisodeEnd,
    Event,
    Preparing,
    SettingFailed,
    work,
)
from kerv_cli.lab.workers import TimeLeft, begun, workers
from kerv_cli.report.report import further_of
from kerv_cli.report.tables import load_study
from kerv_cli.worlds import EnvironmentPart

pytestmark = pytest.mark.usefixtures("quick_report")

on_sqlite = pytest.mark.parametrize("database", ["sqlite"], indirect=True)
"""For what no database decides."""

STUDY = threshold_study(["reach-v3"])
TWO = threshold_study(["reach-v3", "push-v3"])


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr("kerv_cli.lab.work.POLL_SECONDS", 0.05)
    monkeypatch.setattr("kerv_cli.lab.work.FOLLOW_SECONDS", 0.1)


def queued(database: Database) -> int:
    """Return how many episodes wait or run."""
    with database.reading() as connection:
        return int(connection.scalar(sa.select(sa.func.count()).select_from(WANTED).where(UNFINISHED)) or 0)


def episodes(database: Database) -> int:
    with database.reading() as connection:
        return int(connection.scalar(sa.select(sa.func.count()).select_from(EPISODES)) or 0)


def running(database: Database) -> list[int]:
    """Return the seeds of the episodes that run."""
    with database.reading() as connection:
        return list(connection.scalars(sa.select(WANTED.c.seed).where(UNFINISHED, WANTED.c.attempts > 0)))


def silence(database: Database, seconds: float = 60.0) -> None:
    """Let all heartbeats be so old."""
    with database.writing() as connection:
        connection.execute(sa.update(WORKERS).values(heartbeat=clock(connection) - seconds))


def waiting(database: Database, study: Study) -> Study:
    """Plan a study and save the plan. Nobody runs it yet."""
    plan = planned(database, study)
    save(plan)
    return plan.study


@pytest.fixture
def present():
    """Return the queue of a new worker that lives until the end of the test."""
    with contextlib.ExitStack() as stack:
        yield lambda store: Queue(store, stack.enter_context(Presence(store.database)).worker)


def ran(store: Study, prepare=episodes_of, on_event=lambda event: None) -> None:
    """Run what a study waits for, in a worker of its own."""
    with Presence(store.database) as presence:
        work(Queue(store, presence.worker), prepare, on_event)


def errors(database: Database) -> list[str]:
    with database.reading() as connection:
        return list(connection.scalars(sa.select(WANTED.c.error).where(WANTED.c.error.is_not(None))))


@on_sqlite
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
    table = frame_of(store).sort_values(["started", "order"])
    assert list(zip(table["label"], table["seed"], strict=True)) == ran
    assert list(table["order"]) == [*range(20), *range(8)]
    assert table["block"].nunique() == 2
    _, outcome = swept(database.results, study, lambda *_: pytest.fail("prepared"))
    assert outcome.done == []
    assert len(outcome.reused) == 28


def test_each_episode_is_committed_when_it_ends(database):
    told: list[tuple[int, int]] = []

    def on_event(event):
        if isinstance(event, EpisodeEnd):
            told.append(counts_of(Study(opened(database.results), "threshold")))

    store, _ = swept(database.results, STUDY, on_event=on_event)
    assert told == [(number, 16) for number in range(1, 17)]
    with pytest.raises(Interrupted, match="of 32 episodes of threshold are kept: run the same command to resume"):
        swept(database.results, TWO, raising(KeyboardInterrupt(), "ar", [100_002]))
    assert counts_of(store)[0] in range(24, 28)  # two seeds of four settings, and some of the third
    assert queued(database) == 0
    there = counts_of(store)[0]
    _, outcome = swept(database.results, TWO)
    assert (len(outcome.reused), len(outcome.done)) == (there, 32 - there)


@on_sqlite
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
    (event,) = [event for event in events if isinstance(event, SettingFailed)]
    assert event.reason == failure.reason
    assert [one.key for one in event.episodes] == [one.key for one in failure.episodes]
    _, outcome = swept(database.results, STUDY)
    assert (len(outcome.done), outcome.failed, errors(database)) == (2, [], [])
    assert counts_of(store) == (16, 16)


@on_sqlite
def test_an_error_of_kerv_is_told_in_its_own_words(database):
    def unprepared(setting, task):
        raise UsageError("no drafter fits this target: run `kerv train drafter`")

    _, outcome = swept(database.results, STUDY, unprepared)
    assert {failure.reason for failure in outcome.failed} == {"no drafter fits this target: run `kerv train drafter`"}
    with pytest.raises(StorageError):
        swept(database.results, STUDY, raising(StorageError("cannot write x.rrd: the disk is full")))
    assert queued(database) == 0


def test_a_study_that_is_deleted_while_it_runs_says_so(tmp_path):
    def remove(event):
        if isinstance(event, Counted) and event.left < 16:
            remove_study(Study(opened(tmp_path), "threshold"))

    with pytest.raises(KervError, match="threshold was deleted"):
        swept(tmp_path, STUDY, on_event=remove)
    store, outcome = swept(tmp_path, STUDY)
    assert (outcome.failed, counts_of(store), queued(store.database)) == ([], (16, 16), 0)


@on_sqlite
def test_a_study_removed_elsewhere_takes_no_episode_away(database):
    """Between plan and save, or while another study runs: its episodes count, or run again."""
    other = threshold_study(["reach-v3"], name="other")
    swept(database.results, other)
    plan = planned(database, STUDY)
    assert not plan.missing
    remove_study(Study(database, "other"))
    save(plan)
    ran(plan.study)
    assert (counts_of(plan.study), errors(database)) == ((16, 16), [])
    swept(database.results, other)

    def remove(event):
        if isinstance(event, EpisodeEnd):
            remove_study(Study(database, "other"))

    _, outcome = swept(database.results, TWO, on_event=remove)
    assert (len(outcome.done), len(outcome.reused), outcome.failed) == (16, 16, [])


@on_sqlite
def test_a_row_number_is_never_given_again(database):
    """A plan that links to episodes of a study that is removed finds none of another's in their place."""
    swept(database.results, STUDY)
    plan = planned(database, STUDY)
    remove_study(Study(database, "threshold"))
    swept(database.results, study_of({"ar": settings_of("ar"), "late": settings_of("jacobi")}, ["push-v3"], "another"))
    save(plan)
    assert (counts_of(plan.study), counts_of(Study(database, "another"))) == ((0, 16), (8, 8))


@pytest.mark.parametrize(
    "others",
    [threshold_study(["reach-v3", "push-v3"], episodes=2), threshold_study(["reach-v3"], 6, radii=(3, 9, 15))],
)
def test_a_second_sweep_while_one_runs_takes_nothing_away(others, database):
    """With fewer, more and other episodes: both end with a table of all that they planned."""
    both = []
    with ThreadPoolExecutor(1) as pool:

        def on_event(event):
            if isinstance(event, EpisodeEnd) and not both:
                both.append(pool.submit(swept, database.results, others))
                until(lambda: counts_of(Study(database, "threshold"))[1] >= len(others.episodes))
                time.sleep(0.2)

        store, one = swept(database.results, STUDY, on_event=on_event)
        _, other = both[0].result()
    for study, outcome in ((STUDY, one), (others, other)):
        assert outcome.failed == []
        assert len(outcome.done) + len(outcome.reused) == len(study.episodes)
    keys = {(each.setting.label, each.task, each.seed) for each in (*STUDY.episodes, *others.episodes)}
    assert counts_of(store) == (len(keys), len(keys))
    assert (episodes(database), queued(database)) == (len(keys), 0)


@on_sqlite
def test_other_settings_under_a_label_are_refused_while_the_study_runs(database):
    changed = study_of({"ar": settings_of("ar"), "naive_sd": settings_of("spec_vla", 9)}, ["reach-v3"])

    def on_event(event):
        if isinstance(event, EpisodeEnd):
            with refused("threshold is running", "other settings of naive_sd", error=UsageError):
                swept(database.results, changed)

    store, _ = swept(database.results, STUDY, on_event=on_event)
    assert counts_of(store) == (16, 16)
    assert swept(database.results, changed)[1].failed == []
    assert counts_of(store) == (8, 8)


SWEEP = """
import sys
import studies_synthetic as s
from kerv_cli.lab import work
work.POLL_SECONDS, work.FOLLOW_SECONDS = 0.05, 0.1
study = s.threshold_study(["reach-v3", "push-v3"], episodes=2, radii=(3,))
s.swept(sys.argv[1], study, s.slow_elsewhere, runtime=s.RuntimeSettings(workers=2))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_workers_of_a_killed_sweep_end_and_the_next_one_begins_at_once(tmp_path):
    """Its lock is free: nobody waits for its heartbeat to lapse."""
    store = Study(opened(tmp_path), "threshold")
    with python(SWEEP, tmp_path) as process:  # the second task takes a minute
        until(lambda: counts_of(store)[0] == 6, 120.0)
        until(lambda: running(store.database))
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        assert children
        process.kill()
    until(lambda: not any(Path(f"/proc/{child}").exists() for child in children), 5.0)
    assert (counts_of(store), queued(store.database)) == ((6, 12), 6)
    began = time.monotonic()
    _, outcome = swept(tmp_path, threshold_study(["reach-v3", "push-v3"], episodes=2, radii=(3,)))
    assert time.monotonic() - began < 20.0
    assert (len(outcome.reused), len(outcome.done), queued(store.database)) == (6, 6, 0)


def test_an_episode_takes_one_transaction(tmp_path, monkeypatch):
    """Nor is SQLite's log flushed to the disk after each."""
    monkeypatch.setattr("kerv_cli.lab.runs.BEAT_SECONDS", 60.0)
    store, begun = waiting(Database(tmp_path), STUDY), []
    writing = Database.writing
    monkeypatch.setattr(Database, "writing", lambda self: begun.append(1) or writing(self))

    def on_event(event: Event) -> None:
        if isinstance(event, EpisodeEnd):
            assert (tmp_path / "kerv.db-wal").exists()

    ran(store, episodes_of, on_event)
    assert counts_of(store) == (16, 16)
    # the worker comes and goes; two claims; four settings are prepared, and the first episode begins
    assert len(begun) <= 16 + 2 + 2 + 4 + 1


@on_sqlite
def test_a_worker_that_was_silent_keeps_its_block_if_nobody_took_it(database):
    store, ended = waiting(database, STUDY), []

    def lapse(event: Event) -> None:
        if isinstance(event, EpisodeEnd):
            ended.append(event)
            silence(database)

    ran(store, episodes_of, lapse)
    assert (counts_of(store), queued(database), episodes(database), len(ended)) == ((16, 16), 0, 16, 16)


@pytest.mark.parametrize(("silent", "is_held"), [(25.0, True), (35.0, False)])
def test_a_claim_lasts_as_long_as_its_heartbeat(database, silent, is_held, monkeypatch, present):
    """By the database's clock: the clocks of two machines may differ by an hour."""
    store = waiting(database, STUDY)
    first, second = present(store), present(store)
    claim = first.claim()
    assert second.claim() is None
    silence(database, silent)
    monkeypatch.setattr("time.time", lambda: 3600.0)
    assert (second.claim() is None) == is_held
    if is_held:
        first.begin(claim.block.episodes[0])
    else:
        with pytest.raises(ClaimLost):
            first.begin(claim.block.episodes[0])


@on_sqlite
def test_a_worker_that_was_silent_did_not_die_in_its_episode(database, present, monkeypatch):
    monkeypatch.setattr("kerv_cli.lab.runs.BEAT_SECONDS", 1000.0)
    store, late = waiting(database, STUDY), []

    def taken(setting, task):
        def run(seed):
            silence(database)
            late.append(present(store).claim())
            return episode(setting, task, seed)

        return run

    for number in range(1, MOST_DEATHS + 2):
        with Presence(database) as here:
            work(Queue(store, here.worker), taken, is_done=lambda number=number: len(late) == number)
        silence(database)
    ran(store)
    assert (errors(database), counts_of(store)) == ([], (16, 16))


def test_no_two_workers_run_an_episode_that_two_studies_share(database, present):
    """Nor does one study's block wait for another's that shares nothing with it."""
    one = waiting(database, STUDY)
    other = waiting(database, threshold_study(["reach-v3", "push-v3"], radii=(3,), name="other"))
    with Presence(database) as presence:
        assert Queue(one, presence.worker).claim() is not None
        claim = present(other).claim()
        assert claim is not None
        assert claim.block.task == "push-v3"
        assert present(other).claim() is None
    ran(one)
    again = present(other).claim()
    assert again is not None
    assert (again.block.episodes, counts_of(other)) == ((), (12, 24))


STOPS = """
import sys
import studies_synthetic as s
from kerv_cli.lab import runs, work
from kerv_cli.lab.database import opened
from kerv_cli.lab.queue import Queue
from kerv_cli.lab.store import Study
runs.LAPSE_SECONDS, runs.BEAT_SECONDS = 1.0, 0.3
with runs.Presence(opened(sys.argv[1])) as here:
    work.work(Queue(Study(opened(sys.argv[1]), "threshold"), here.worker), s.stops)
"""


@pytest.mark.parametrize("is_taken", [True, False])
def test_a_worker_that_was_stopped_writes_nothing_twice(database, monkeypatch, is_taken):
    monkeypatch.setattr("kerv_cli.lab.runs.LAPSE_SECONDS", 1.0)
    store = waiting(database, STUDY)
    with python(STOPS, database.results) as process:
        until(lambda: running(database) == [100_002])
        until(lambda: Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0] == "T")
        there = counts_of(store)[0]
        assert 0 < there < 16
        if is_taken:
            ran(store)
            assert (counts_of(store), queued(database)) == ((16, 16), 0)
        else:
            time.sleep(1.5)
        os.kill(process.pid, signal.SIGCONT)
        process.join(30)
        assert process.exitcode == 0
    assert (episodes(database), counts_of(store), queued(database)) == (16, (16, 16), 0)


CREW = """
import os
import sys
import studies_synthetic as s
from kerv_cli.lab import database, work
from kerv_cli.lab.database import Database, opened
from kerv_cli.lab.runs import Presence, bury
from kerv_cli.lab.queue import Queue
from kerv_cli.lab.store import Study
from kerv_cli.lab.study import save

work.POLL_SECONDS = 0.01
results, prepare = sys.argv[1], getattr(s, sys.argv[2])


def parted(function, *arguments, **options):
    child = os.fork()
    if child:
        return child
    database._server.cache_clear()  # a connection belongs to one process
    function(*arguments, **options)
    os._exit(0)


def ran(name):
    with Presence(opened(results)) as here:
        work.work(Queue(Study(opened(results), name), here.worker), prepare)


def crew(store, number):
    "Keep so many workers at work until every block has ended; return how many died."
    workers, died = [parted(ran, store.name) for _ in range(number)], 0
    while workers:
        child, status = os.wait()
        workers.remove(child)
        if status:
            died += 1
            bury(store.database)
            workers.append(parted(ran, store.name))
    return died
"""
MATRIX = """
for workers, block in ((1, 5), (2, 2), (4, 1)):
    study = s.threshold_study(["reach-v3"], episodes=5, radii=(), name=f"s{workers}{block}", block=block)
    for number, setting in enumerate(study.settings):  # no study shares an episode with another
        setting.settings["seed"] = 100_000 + 100 * block + 10 * workers
    episodes = s.all_episodes(study.settings, ["reach-v3"], block)
    study = s.replace(study, episodes=episodes)
    save(s.planned(opened(results), study))
    crew(Study(opened(results), study.name), workers)
"""


def test_any_number_of_workers_run_each_episode_once_though_some_are_killed(database):
    """Each is killed in the seventh episode that it begins. Blocks have 2, 4 and 10 episodes."""
    with python(CREW + MATRIX, database.results, "mortal") as process:
        process.join(120)
        assert process.exitcode == 0
    assert (episodes(database), queued(database), errors(database)) == (3 * 10, 0, [])
    assert [counts_of(Study(database, name)) for name in ("s15", "s22", "s41")] == [(10, 10)] * 3


AT_ONCE = """
study = s.threshold_study(["reach-v3", "push-v3"], episodes=4, radii=(3,), block=2)
save(s.planned(opened(results), study))
children = [parted(ran, study.name) for _ in range(3)] + [parted(s.swept, results, study, prepare) for _ in range(2)]
assert [os.waitpid(child, 0)[1] for child in children] == [0] * 5
"""


def test_two_sweeps_and_three_workers_at_once_run_each_episode_once(database):
    with python(CREW + AT_ONCE, database.results, "brisk") as process:
        process.join(60)
        assert process.exitcode == 0
    assert (episodes(database), queued(database)) == (24, 0)
    assert counts_of(Study(database, "threshold")) == (24, 24)


@on_sqlite
def test_a_block_that_failures_have_emptied_does_not_come_back(database):
    """All of its settings fail in the first worker; the second finds nothing to do."""
    store, seen = waiting(database, STUDY), []
    ran(store, raising(RuntimeError("the gripper fell off")))
    ran(store, episodes_of, seen.append)
    assert (seen, queued(database), len(errors(database))) == ([], 0, 16)


def in_order() -> Study:
    """A setting whose result depends on the order of its episodes, beside one that is not so."""
    settings = settings_of("retrieval")
    settings.skip = part("skip", "similarity", up=0.25)
    return study_of({"ar": settings_of("ar"), "heisd": settings}, ["reach-v3"])


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
Path(__file__).with_name("threads").write_text(os.environ.get("OMP_NUM_THREADS", ""))
"""
POINTS = """
baseline: short
common: task=POINT policy=expert episodes=6 record=0 runtime.threads=3
block: 1
settings: {short: world.horizon=30, long: world.horizon=60}
"""


def test_workers_run_each_episode_once_though_one_is_killed(tmp_path, monkeypatch):
    """A worker that dies is replaced, and the episode that it ran is repeated."""
    EnvironmentPart(POINT_MASS.name)(lambda: POINT_MASS)
    (tmp_path / "killing.py").write_text(KILLS_ITS_PROCESS_ONCE)
    (tmp_path / "armed").touch()
    monkeypatch.setenv("KERV_PLUGINS", "killing")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, sys.path)]))
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "points.yaml").write_text(POINTS)
    words = ("sweep", f"study={tmp_path / 'points.yaml'}", f"results={tmp_path / 'results'}")
    assert "12 run, 0 reused, 0 failed" in told(*words, "runtime.workers=2")
    torch.set_num_threads(1)
    assert not (tmp_path / "armed").exists()
    assert (tmp_path / "threads").read_text() == "3"
    assert "0 run, 12 reused, 0 failed" in told(*words)
    assert episodes(opened(tmp_path / "results")) == 12


IN_ORDER = """
from test_execute import in_order
study = in_order()
save(s.planned(opened(results), study))
assert crew(Study(opened(results), study.name), 1) == 3
"""


@on_sqlite
def test_episodes_whose_order_counts_run_whole_again_when_their_process_dies(database):
    """A setting in which three workers die fails in the block."""
    with python(CREW + IN_ORDER, database.results, "killed_at_the_third") as process:
        process.join(60)
        assert process.exitcode == 0
    store = Study(database, "threshold")
    assert counts_of(store) == (2 + 4, 8)
    assert errors(database) == ["3 workers died in this episode\n"] * 2
    frame = frame_of(store).query("label == 'heisd'")
    assert (len(frame), frame["block"].nunique()) == (4, 1)
    assert {one.setting.label for one in planned(database, in_order()).missing} == {"ar"}


@on_sqlite
def test_estimates_say_what_they_rest_on(database, monkeypatch):
    def left(workers):
        return TimeLeft(planned(database, TWO, runtime=RuntimeSettings(workers=workers)), 10.0)

    assert (left(1).seconds, "guess" in left(1).source) == (32 * 10.0, True)
    store, _ = swept(database.results, threshold_study(["reach-v3"], radii=()))
    estimate = left(2)
    assert estimate.seconds == pytest.approx(24 * frame_of(store)["wall_seconds"].mean() / 2)
    assert estimate.source == "measured on 8 stored episodes"
    began = time.monotonic()
    monkeypatch.setattr("time.monotonic", lambda: began + 6.0)
    estimate.see(Counted(24))
    assert estimate.seconds == left(2).seconds, "nothing has ended"
    estimate.see(Counted(6))
    assert estimate.seconds == pytest.approx(2.0, rel=0.1), "a quarter is left after 6 s"


def test_progress_without_a_terminal_is_plain_lines(tmp_path, capsys):
    swept(tmp_path, threshold_study(["reach-v3"], episodes=1))
    with progress_bar("episodes") as show:
        bad = raising(ValueError("[bold] is not markup"), "naive_sd")
        left = TimeLeft(planned(opened(tmp_path), STUDY), 1.0)
        swept(tmp_path, STUDY, bad, on_event=event_printer(show, left))
    written = capsys.readouterr().err
    lines = written.splitlines()
    assert lines[0].startswith("4 episodes there already, 12 to run, about ")
    assert any(line.startswith("naive_sd on reach-v3: failed: ValueError: [bold] is not markup") for line in lines)
    assert re.fullmatch(r"12/12 .* on reach-v3, seed 100003: (success|failure), \d\.\d s", lines[-2])
    assert re.fullmatch(r"episodes 12/12, about .* left, reach-v3 100001-100003: 4 settings in turn", lines[-1])
    assert "\x1b" not in written


def test_progress_begins_before_the_first_episode(tmp_path, capsys):
    study = threshold_study(["reach-v3"], episodes=26)
    plan = planned(Database(tmp_path), study)
    (block, *_), setting = plan.blocks, study.settings[0]
    with progress_bar("episodes", has_estimate=True) as show:
        on_event = event_printer(show, TimeLeft(plan, 60.0))
        for event in (BlockStarted(block), Preparing(setting, 1, 4)):
            on_event(event)
        for one in study.episodes:
            on_event(EpisodeEnd(one, True, 2.0))
    lines = capsys.readouterr().err.splitlines()
    assert lines[:3] == [
        "104 to run, about 104 min (a guess of 60 s per episode)",
        "episodes 0/104, about 104 min left, starting",
        "preparing ar, 1 of 4",
    ]
    each = [line for line in lines if ", seed 1" in line]
    assert each[0].startswith("1/104 ")
    assert len(each) == 100, "a line per episode, though the study has more than 100"
    assert any(re.fullmatch(r"episodes 52/104, about .* left, .* in turn", line) for line in lines)


def test_a_busy_machine_is_said_once_and_kept(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("os.getloadavg", lambda: (3.0, 0.0, 0.0))
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    with progress_bar("episodes") as show:
        left = TimeLeft(planned(opened(tmp_path), STUDY), 1.0)
        store, _ = swept(tmp_path, STUDY, on_event=event_printer(show, left))
    assert capsys.readouterr().err.count("the load average is 1.5 per core") == 1
    (told,) = {about["provenance"]["load"] for about in further_of(load_study(store))["labels"].values()}
    assert told == "1.5"


def shell(tmp_path: Path, name: str, script: str) -> Path:
    path = tmp_path / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return path


def test_workers_that_cannot_begin_end_the_sweep_in_one_line(tmp_path, monkeypatch):
    """One that says why, and those that are killed again and again."""
    for script, line in (("echo 'kerv: no such thing' >&2; exit 2", "no such thing"), ("kill -9 $$", "enough memory")):
        monkeypatch.setattr(sys, "executable", str(shell(tmp_path, "python", script)))
        with refused(line):
            swept(tmp_path, TWO, runtime=RuntimeSettings(workers=2))
        assert queued(opened(tmp_path)) == 0


@pytest.mark.parametrize(("visible", "device", "seen"), [
    ("0,GPU-b", "cuda", {"0": 2, "GPU-b": 1}), ("0,1", "cuda:1", {"0,1": 3}),
])  # fmt: skip
def test_each_local_worker_sees_one_gpu(visible, device, seen, tmp_path, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    study = threshold_study(["reach-v3"], block=1)
    for setting in study.settings:
        setting.settings["runtime"] |= {"device": device}
    plan = planned(opened(tmp_path), study, runtime=RuntimeSettings(workers=3))
    script = f'echo "$CUDA_VISIBLE_DEVICES" > {tmp_path}/gpu$$; sleep 60'
    monkeypatch.setattr(sys, "executable", str(shell(tmp_path, "python", script)))
    with workers(plan, ""):
        until(lambda: sum(path.stat().st_size > 0 for path in tmp_path.glob("gpu*")) == 3)
    found = [path.read_text().strip() for path in tmp_path.glob("gpu*")]
    assert {one: found.count(one) for one in found} == seen


def test_a_database_that_does_not_answer_is_asked_again_for_two_minutes(tmp_path, monkeypatch):
    """Then the worker ends in one line. What it had finished is kept."""
    monkeypatch.setattr("kerv_cli.lab.database.LOCK_SECONDS", 0)
    store = waiting(opened(tmp_path), STUDY)
    locks: list[sqlite3.Connection] = []

    def lock(event: object) -> None:
        """Lock the file after the fourth and the eighth episode."""
        if isinstance(event, EpisodeEnd) and counts_of(store)[0] in (4, 8):
            locks.append(sqlite3.connect(tmp_path / "kerv.db", check_same_thread=False))
            locks[-1].execute("BEGIN IMMEDIATE")
            if len(locks) > 1:
                threading.Timer(0.5, locks[-1].close).start()

    monkeypatch.setattr("kerv_cli.lab.queue.PATIENCE_SECONDS", 0.3)
    with refused("locked", "finished episodes are kept", error=StorageError):
        ran(store, episodes_of, lock)
    locks[-1].close()
    assert counts_of(store) == (4, 16)
    monkeypatch.setattr("kerv_cli.lab.queue.PATIENCE_SECONDS", 20.0)
    silence(store.database)  # the block could not be freed
    ran(store, episodes_of, lock)
    assert (len(locks), counts_of(store), episodes(store.database)) == (2, (16, 16), 16)


def test_a_command_that_starts_no_workers_is_refused_in_one_line(tmp_path):
    with refused("runtime.launch: echo no queue; exit 3 failed: no queue"):
        swept(tmp_path, STUDY, runtime=RuntimeSettings(launch="echo no queue; exit 3"))
    assert queued(opened(tmp_path)) == 0


def test_a_command_starts_workers_and_the_sweep_follows_them(tmp_path):
    """As with any engine that runs `kerv work`. Its line is typed in a shell."""
    launch = f"{sys.executable} -m kerv_cli $(echo '{{command}}' | cut -d' ' -f2-) 2>{tmp_path}/said &"
    with pretending(brisk):
        store, outcome = swept(tmp_path, STUDY, brisk, runtime=RuntimeSettings(launch=launch))
    assert (len(outcome.done), counts_of(store)) == (16, (16, 16)), (tmp_path / "said").read_text()


def test_a_sweep_without_workers_says_how_to_start_some(tmp_path):
    """And Ctrl-C lets workers elsewhere end: nothing is asked for any more."""
    said, store = [], Study(opened(tmp_path), "threshold")
    plan = planned(opened(tmp_path), STUDY, runtime=RuntimeSettings(workers=0))
    with pytest.raises(Interrupted), begun(plan) as record:  # noqa: PT012
        save(plan, record.id)
        with workers(plan, record.id, said.append):
            assert queued(store.database) == 16
            raise KeyboardInterrupt
    assert said == [f"start workers, as many as you like: kerv work study=threshold results={tmp_path}"]
    assert (queued(store.database), counts_of(store)) == (0, (0, 16))
    other = planned(Database(tmp_path, f"sqlite:///{tmp_path}/other.db"), STUDY, runtime=RuntimeSettings(workers=0))
    with workers(other, "", said.append):
        assert said[1].endswith(f"results={tmp_path} store=sqlite:///{tmp_path}/other.db")
