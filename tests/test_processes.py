"""No process of a command outlives it, however it ends."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import until

JOB = """
import os, time
class Config:
    workers = 2
def job(config, path, task, seeds, make_actor):
    with open(path, "a") as file:
        file.write(f"{os.getpid()}\\n")
    while task == "dies":
        with open(path) as file:
            if len(file.read().split()) == 2:
                os._exit(9)
    time.sleep(60)
"""
DEMOS = """
import signal, sys
import job
from kerv_cli.worlds.demos import recording
signal.signal(signal.SIGINT, signal.default_int_handler)
recording._record_seeds = job.job
try:
    list(recording._run_jobs(job.Config, sys.argv[1], [(sys.argv[2], range(1)), ("sleeps", range(1))], None))
except (recording.KervError, KeyboardInterrupt) as error:
    print(type(error).__name__, error, flush=True)
"""
COMMAND = """
import signal, sys, time
import kerv_cli.__main__ as kerv
import kerv_cli.cli.app

def run():
    try:
        import library
        time.sleep(60)
    except KeyboardInterrupt:
        print("cleared", flush=True)

kerv_cli.cli.app.program.main = run
kerv.main()
"""
WRITER = """
import random, signal, sys
import kerv_cli.__main__ as kerv
import kerv_cli.cli.app, kerv_cli.lab.database as lab
import sqlalchemy as sa

def insert(database, key):
    with database.writing() as connection:
        connection.execute(sa.insert(lab.ABOUT).values(key=key, value=""))

def run():
    lab.LOCK_SECONDS = 0.2
    sys.unraisablehook = lambda _: None  # kerv would end
    insert(lab.Database(sys.argv[1]), "all is imported")
    signal.signal(signal.SIGVTALRM, lambda *_: signal.raise_signal(signal.SIGINT))
    for trial in range(30):
        database, kerv._is_interrupted = lab.Database(sys.argv[1]), False
        try:
            signal.setitimer(signal.ITIMER_VIRTUAL, random.uniform(1e-4, 6e-3))
            for number in range(500):
                insert(database, f"{trial} {number}")
        except KeyboardInterrupt:
            insert(database, f"{trial} interrupted")
        database.close()
    print("all written")

kerv_cli.cli.app.program.main = run
kerv.main()
"""


def ended(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.fixture
def recording(tmp_path):
    """Start a process that records with two workers. Return it and the processes that it and they have started."""
    (tmp_path / "job.py").write_text(JOB)
    path, started = tmp_path / "pids", []

    def begin(first="sleeps"):
        command = [sys.executable, "-c", DEMOS, str(path), first]
        env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env))
        until(lambda: path.exists() and len(path.read_text().split()) == 2, 120)
        found = [int(pid) for pid in path.read_text().split()]
        children = Path(f"/proc/{started[0].pid}/task/{started[0].pid}/children")
        return started[0], [*found, *map(int, children.read_text().split() if children.exists() else ())]

    yield begin
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
def test_workers_that_record_end_with_a_killed_command(recording):
    """One that is stopped, too, and what else the command has started."""
    process, found = recording()
    os.kill(found[0], signal.SIGSTOP)
    process.kill()
    until(lambda: all(map(ended, found)), 5)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
def test_workers_that_record_end_at_once_with_ctrl_c(recording):
    process, found = recording()
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=5)[0].startswith("KeyboardInterrupt")
    until(lambda: all(map(ended, found)), 5)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
def test_a_worker_that_dies_ends_the_recording_and_the_other_workers(recording):
    process, found = recording("dies")
    said = process.communicate(timeout=10)[0]
    assert said == "KervError a worker process was killed: run the same command again to go on\n"
    until(lambda: all(map(ended, found)), 5)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_import_is_ended_at_once(number, tmp_path):
    (tmp_path / "library.py").write_text("import time\nprint('begun', flush=True)\ntime.sleep(60)\n")
    begun = subprocess.Popen(
        [sys.executable, "-c", COMMAND], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    )  # fmt: skip
    assert begun.stdout.readline() == "begun\n"
    begun.send_signal(number)
    assert begun.communicate(timeout=20) == ("", "kerv: interrupted\n")
    assert begun.returncode == 130


def test_a_second_interrupt_ends_at_once(tmp_path):
    slow = COMMAND.replace('print("cleared", flush=True)', 'print("cleaning", flush=True); time.sleep(60)')
    begun = subprocess.Popen(
        [sys.executable, "-c", slow.replace("import library", 'print("begun", flush=True)')],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    for line in ("begun\n", "cleaning\n"):
        assert begun.stdout.readline() == line
        begun.send_signal(signal.SIGINT)
    assert begun.communicate(timeout=20) == ("", "kerv: interrupted\n")
    assert begun.returncode == 130


def test_an_interrupt_leaves_no_transaction_open(tmp_path):
    """Otherwise the command itself would wait for the lock, and lose what it has written."""
    run = subprocess.run([sys.executable, "-c", WRITER, str(tmp_path)], capture_output=True, text=True, timeout=60)
    assert run.stdout == "all written\n", run.stderr
