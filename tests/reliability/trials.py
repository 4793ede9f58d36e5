"""Seeded trials of the queue: sweeps and workers that are killed, stopped and continued while others plan and remove.

`make trials` runs 200, the odd ones in PostgreSQL; `tests/test_reliability.py` runs twenty. An episode is a function
here: no world, no model.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import random
import resource
import secrets
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import server
import sqlalchemy as sa
import studies_synthetic as synthetic

from kerv_cli.base.errors import CheckpointError, KervError
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.lab import database as tables
from kerv_cli.lab import queue, runs, work, workers
from kerv_cli.lab.database import BLOCKS, EPISODES, RUNS, SETTINGS, STUDIES, UNFINISHED, WANTED, WORKERS, Database
from kerv_cli.lab.store import Study, remove_study

SECONDS = 1.5
"""Time in which things happen. Then everybody is left in peace."""
PATIENCE = 60.0
"""Seconds until an actor that is left in peace has to end."""
LAPSE, BEAT = 0.6, 0.15
QUIET = 10.0
"""Longest silence of a sweep, seconds."""
CLONE_NEWPID = 0x20000000
MAIN, OTHER = "threshold", "other"


@dataclass
class Actor:
    """A process of the trial, and what it may end with."""

    name: str
    pid: int
    begun: float = field(default_factory=time.monotonic)
    codes: set[int] = field(default_factory=lambda: {0})
    is_stopped: bool = False


class Trial:
    """One trial in a folder of its own.

    Args:
        seed: What happens depends on it alone, as far as the machine's speed allows.
        results: The results folder.
        store: URL of an empty database, or empty for SQLite.
    """

    def __init__(self, seed: int, results: Path, store: str = "") -> None:
        self.draw, self.results, self.store = random.Random(seed), results, store
        self.actors: list[Actor] = []
        self.log: list[str] = []
        self.reruns = 0
        self.stopped: set[int] = set()
        self.deaths = 0
        self.weights = results / "weights"
        results.mkdir(parents=True, exist_ok=True)
        self.weights.write_text("planned")

    def database(self) -> Database:
        """Return the database, for this process."""
        return Database(self.results, self.store)

    def study(self, name: str, episodes: int, tasks: int, block: int) -> Study:
        """Return a study. Those of one name share settings; the two names share the setting `ar`."""
        radii = (3, 9) if name == MAIN else (5,)
        return replace(synthetic.threshold_study(["reach-v3", "push-v3"][:tasks], episodes, radii, name, block=block),
                       database=self.database())  # fmt: skip

    def prepare(self, setting: Any, task: str) -> Callable[[int], Any]:
        """Build the episodes of a setting. They take 2 to 20 ms, and need the weights of the plan."""
        if self.weights.read_text() != "planned":
            raise CheckpointError(f"{self.weights} has changed")

        def run(seed: int) -> Any:
            time.sleep(0.002 + 0.018 * random.random())
            return synthetic.episode(setting, task, seed)

        return run

    def begin(
        self, name: str, job: Callable[[Trial], object], codes: Sequence[int] = (0,), apart: bool = False
    ) -> Actor:
        """Start a process. `apart`: in a namespace of process ids of its own."""
        sys.stdout.flush()
        pid = os.fork()
        if pid:
            actor = Actor(f"{name}{len(self.actors)}", pid, codes=set(codes))
            self.actors.append(actor)
            self.log.append(f"{time.monotonic():.2f} begin {actor.name} {pid}{' apart' if apart else ''}")
            return actor
        code = 70
        try:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            if apart and ctypes.CDLL(None).unshare(CLONE_NEWPID) == 0:
                child = os.fork()
                if child:
                    signal.signal(signal.SIGINT, lambda *_: os.kill(child, signal.SIGINT))
                    os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) % 256)
                ctypes.CDLL(None).prctl(1, signal.SIGKILL)
            code = self._in_child(name, job)
        finally:
            os._exit(code)

    def _in_child(self, name: str, job: Callable[[Trial], object]) -> int:
        tables._server.cache_clear()  # a connection belongs to one process
        runs.LAPSE_SECONDS, runs.BEAT_SECONDS = LAPSE, BEAT
        work.POLL_SECONDS, work.FOLLOW_SECONDS, queue.PATIENCE_SECONDS = 0.05, 0.05, 20.0
        random.seed(os.getpid())
        try:
            job(self)
        except KervError as error:
            self._tell(name, {"error": str(error)})
            return error.exit_code
        except KeyboardInterrupt:
            return 130
        except BaseException:  # noqa: BLE001 - the trial reports it
            self._tell(name, {"error": traceback.format_exc()})
            return 70
        return 0

    def _tell(self, name: str, what: dict[str, Any]) -> None:
        (self.results / f"{name}-{os.getpid()}-{secrets.token_hex(4)}.told").write_text(json.dumps(what))

    def sweep(self, study: Study, rerun: str = "never") -> Callable[[Trial], object]:
        """Return a job: sweep a study, and tell what came of it."""

        def job(trial: Trial) -> None:
            last, quiet = time.monotonic(), 0.0

            def on_event(event: object) -> None:
                nonlocal last, quiet
                quiet, last = max(quiet, time.monotonic() - last), time.monotonic()

            command = ["sweep", f"study={study.name}"]
            plan = synthetic.planned(trial.database(), study, rerun, runtime=RuntimeSettings(), command=command)
            with workers.begun(plan) as record:
                workers.save(plan, record.id)
                outcome = work.follow(plan, record, lambda left: None, trial.prepare, on_event)
            failed = sum(len(failure.episodes) for failure in outcome.failed)
            told = {"study": study.name, "planned": len(study.episodes), "done": len(outcome.done),
                    "reused": len(outcome.reused), "failed": failed, "quiet": quiet, "pid": os.getpid()}  # fmt: skip
            trial._tell("sweep", told | {"reasons": [failure.reason for failure in outcome.failed]})

        return job

    def worker(self, name: str = MAIN) -> Callable[[Trial], object]:
        """Return a job: what `kerv work` does."""

        def job(trial: Trial) -> None:
            database = trial.database()
            with runs.Presence(database) as here:
                work.work(queue.Queue(Study(database, name), here.worker), trial.prepare)

        return job

    def removal(self, study: Study) -> Callable[[Trial], object]:
        """Return a job: remove a study and plan it again, a few times."""

        def job(trial: Trial) -> None:
            for _ in range(4):
                time.sleep(0.15)
                remove_study(Study(trial.database(), study.name))
                workers.save(synthetic.planned(trial.database(), study))

        return job

    def full_disk(self, job: Callable[[Trial], object], size: int) -> Callable[[Trial], object]:
        """Return a job whose files may not grow beyond a size."""

        def limited(trial: Trial) -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
            job(trial)

        return limited

    def run(self) -> list[str]:
        """Run the trial. Return what is wrong."""
        draw, until = self.draw, time.monotonic() + SECONDS
        block = draw.choice((1, 2, 5))
        base = self.study(MAIN, draw.choice((3, 4, 6)), draw.choice((1, 2)), block)
        other = self.study(OTHER, draw.choice((2, 5)), 1, block)
        if draw.random() < 0.3:
            self.begin("first", self.sweep(base))
            self.wait()
        self.begin("sweep", self.sweep(base))
        for _ in range(draw.randrange(4)):
            self.begin("worker", self.worker(), apart=draw.random() < 0.4)
        while time.monotonic() < until:
            time.sleep(draw.uniform(0.02, 0.25))
            self.event(base, other)
        return self.in_peace(base, other)

    def event(self, base: Study, other: Study) -> None:
        """Let something happen."""
        draw, kind = self.draw, self.draw.choices(
            ("kill", "stop", "interrupt", "worker", "sweep", "same", "rerun", "other", "remove", "weights", "disk"),
            (5, 5, 2, 4, 3, 2, 1, 2, 1, 1, 1),
        )[0]  # fmt: skip
        alive = [actor for actor in self.actors if self.is_alive(actor)]
        if kind in ("kill", "stop", "interrupt") and alive:
            actor = draw.choice(alive)
            self.log.append(f"{time.monotonic():.2f} {kind} {actor.name}")
            number = {"kill": signal.SIGKILL, "stop": signal.SIGSTOP, "interrupt": signal.SIGINT}[kind]
            actor.codes |= {"kill": {-9, 137}, "stop": set(), "interrupt": {130}}[kind]
            self.deaths += kind == "kill" or (kind == "stop" and not actor.is_stopped)
            if kind == "stop":
                os.kill(actor.pid, signal.SIGCONT if actor.is_stopped else number)
                self.stopped.add(actor.pid)
                actor.is_stopped = not actor.is_stopped
            else:
                os.kill(actor.pid, number)
        elif kind == "worker":
            self.begin("worker", self.worker(draw.choice((MAIN, MAIN, OTHER))), apart=draw.random() < 0.3)
        elif kind in ("sweep", "same"):
            episodes = draw.choice((1, 2, 5, 8)) if kind == "sweep" else base.settings[0].settings["episodes"]
            tasks = draw.choice((1, 2)) if kind == "sweep" else len(base.tasks)
            self.begin("sweep", self.sweep(self.study(MAIN, episodes, tasks, base.block)))
        elif kind == "rerun":
            self.reruns += 1
            self.begin("rerun", self.sweep(base, "all"))
        elif kind == "other":
            self.begin("other", self.sweep(other), (0, 1))  # it may be removed
        elif kind == "remove":
            self.begin("remove", self.removal(other))
        elif kind == "weights":
            new = self.weights.with_name("new")
            new.write_text("planned" if self.weights.read_text() != "planned" else "trained anew")
            new.replace(self.weights)
            self.log.append(f"{time.monotonic():.2f} weights {self.weights.read_text()}")
        elif kind == "disk":
            self.begin("disk", self.full_disk(self.sweep(base), draw.randrange(4096, 400_000)), (0, 1))

    def is_alive(self, actor: Actor) -> bool:
        """Return whether a process has not ended."""
        return os.waitid(os.P_PID, actor.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None

    def wait(self) -> list[str]:
        """Wait for all actors. Return what is wrong with their ends."""
        wrong, until = [], time.monotonic() + PATIENCE
        for actor in self.actors:
            os.kill(actor.pid, signal.SIGCONT)
        for actor in self.actors:
            while self.is_alive(actor):
                if time.monotonic() > until:
                    wrong.append(f"{actor.name} does not end")
                    os.kill(actor.pid, signal.SIGKILL)
                    break
                time.sleep(0.01)
            code = os.waitstatus_to_exitcode(os.waitpid(actor.pid, 0)[1])
            if code not in actor.codes:
                wrong.append(f"{actor.name} ended with {code}")
        self.actors.clear()
        return wrong

    def told(self) -> Iterator[dict[str, Any]]:
        """Yield what the actors have told since."""
        for path in self.results.glob("*.told"):
            yield json.loads(path.read_text())
            path.unlink()

    def in_peace(self, base: Study, other: Study) -> list[str]:
        """Wait until all is over, sweep once more, and look at what is in the database."""
        wrong = self.wait()
        for told in self.told():
            if "Traceback" in told.get("error", ""):
                wrong.append(told["error"])
            if "planned" in told and told["done"] + told["reused"] + told["failed"] != told["planned"]:
                wrong.append(f"counts do not add up: {told}")
            if told.get("quiet", 0.0) > QUIET and told["pid"] not in self.stopped:
                wrong.append(f"nothing was said for {told['quiet']:.1f} s")
            if self.deaths < queue.MOST_DEATHS and any("workers died" in why for why in told.get("reasons", ())):
                wrong.append(f"{self.deaths} workers were killed or stopped, more were counted: {told}")
        self.weights.write_text("planned")
        for study in (base, other):
            self.begin("last", self.sweep(study))
            wrong += self.wait()
            for told in self.told():
                if told.get("failed", 1) or told["done"] + told["reused"] != len(study.episodes):
                    wrong.append(f"the last sweep of {study.name}: {told}")
        wrong += self.look(base)
        return wrong

    def look(self, base: Study) -> list[str]:
        """Return what is wrong in the database."""
        wrong, database = [], self.database()
        with database.reading() as connection:
            left = connection.scalar(sa.select(sa.func.count()).select_from(WANTED).where(UNFINISHED))
            alive = connection.scalar(sa.select(sa.func.count()).select_from(WORKERS))
            key = EPISODES.c.work, EPISODES.c.task, EPISODES.c.seed
            mine = sa.select(RUNS.c.id).where(RUNS.c.name == base.name)
            number = sa.select(*key, sa.func.count().label("number")).join(BLOCKS).where(BLOCKS.c.run.in_(mine))
            twice = [row for row in connection.execute(number.group_by(*key)) if row.number > 1 + self.reruns]
            wanted = sa.select(sa.func.count()).select_from(WANTED.join(SETTINGS).join(STUDIES))
            wanted = wanted.where(STUDIES.c.name == base.name, WANTED.c.episode_id.is_not(None))
            wanted = wanted.where(WANTED.c.task.in_(base.tasks))  # rows of another task may stay
            there = connection.scalar(wanted)
        if left:
            wrong.append(f"{left} rows are left unfinished")
        if twice:
            wrong.append(f"run more than once: {twice[:3]}")
        if there != len(base.episodes):
            wrong.append(f"{there} rows of {base.name} have an episode, {len(base.episodes)} were planned")
        if alive and not any("kill" in line or "disk" in line for line in self.log):
            wrong.append(f"{alive} rows of workers are left")
        database.close()
        return wrong


def trial(seed: int, url: str = "") -> list[str]:
    """Run a trial, in SQLite or in a new database of a PostgreSQL server. Return what is wrong, and what happened."""
    with tempfile.TemporaryDirectory(prefix="kerv-trial-") as folder, contextlib.ExitStack() as stack:
        store = ""
        if url:
            import psycopg

            store = f"{url}/kerv_{secrets.token_hex(4)}"
            connection = stack.enter_context(psycopg.connect(f"{url}/postgres", autocommit=True))
            connection.execute(f"CREATE DATABASE {store.rpartition('/')[2]}")
            stack.callback(connection.execute, f"DROP DATABASE {store.rpartition('/')[2]} WITH (FORCE)")
        one = Trial(seed, Path(folder) / "results", store)
        wrong = one.run()
        return [*wrong, *one.log] if wrong else []


def main() -> None:
    """Run trials: `trials.py NUMBER [FIRST]`. Print a line per trial, and what went wrong."""
    number, first, failed = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0, []
    with server.running() as url:
        for seed in range(first, first + number):
            began = time.monotonic()
            wrong = trial(seed, url if seed % 2 else "")
            failed += [seed] if wrong else []
            where, end = "PostgreSQL" if seed % 2 else "SQLite", "FAILED" if wrong else "well"
            print(f"seed {seed} {where}: {end}, {time.monotonic() - began:.0f} s", *wrong, sep="\n  ", flush=True)
    print(f"{number - len(failed)} of {number} trials went well; failed: {failed}")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
