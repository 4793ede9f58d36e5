"""Weights are part of a claim, and a lock of the operating system says who lives."""

import os
import shutil
import subprocess
import sys
import time

import pytest
from command import told
from conftest import python, refused, write_policy

from kerv_cli.base.errors import UsageError
from kerv_cli.episodes.runner import Runner
from kerv_cli.lab.database import opened
from kerv_cli.lab.runs import Presence, Run, bury, living, run_rows
from kerv_cli.lab.store import Study, frame_of

STUDY = """
common: policy=state policy.target=nano-state task=reach world.horizon=4 episodes=3 record=0
block: 1
settings: {ar: method=ar}
"""


def test_weights_that_are_replaced_while_a_sweep_runs_fail_the_setting(policies, tmp_path, monkeypatch):
    """Whatever replaces them: no episode of the new weights is stored under the old hash."""
    results = tmp_path / "results"
    target = results / "artifacts/target/nano-state"
    shutil.copytree(policies / "artifacts", results / "artifacts")
    write_policy(tmp_path / "anew", "nano-state", "state", seed=7)
    (tmp_path / "tiny.yaml").write_text(STUDY)
    episode, ran = Runner.episode, []

    def replacing(self, seed, recorded=False):
        ran.append(seed)
        if len(ran) == 2:
            shutil.rmtree(target)
            shutil.copytree(tmp_path / "anew/artifacts/target/nano-state", target)
        return episode(self, seed, recorded)

    monkeypatch.setattr(Runner, "episode", replacing)
    words = ("sweep", f"study={tmp_path / 'tiny.yaml'}", f"results={results}")
    said = told(*words, code=1)
    assert "2 run, 0 reused, 1 failed" in said
    assert "the target of ar has changed from" in said
    assert str(target) in said
    first = set(frame_of(Study(opened(results), "tiny"))["episode"])
    assert "3 run, 0 reused, 0 failed" in told(*words)
    assert first.isdisjoint(frame_of(Study(opened(results), "tiny"))["episode"])


MAKES = """
import sys
from kerv_cli.base.errors import UsageError
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import Run
try:
    with Run(Database(sys.argv[1]), "target", "mine"):
        print("made")
except UsageError as error:
    print(error)
"""


def test_only_one_process_makes_an_artifact(tmp_path):
    """Also in another container with the same host name, where process ids mean something else."""
    apart = ["unshare", "--pid", "--fork"]
    if not shutil.which("unshare") or subprocess.run([*apart, "true"], capture_output=True, check=False).returncode:
        apart = []  # no right to make a namespace here
    command = [*apart, sys.executable, "-c", MAKES, str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}

    def made() -> str:
        return subprocess.run(command, capture_output=True, text=True, env=environment, check=True).stdout

    with Run(opened(tmp_path), "target", "mine"):
        assert "target mine is being made on " in made()
        with refused("target mine is being made", error=UsageError), Run(opened(tmp_path), "target", "mine"):
            pass
    assert made() == "made\n"


DIES = """
import os, sys
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import Presence
with Presence(Database(sys.argv[1]), "a run"):
    os.kill(os.getpid(), 9)
"""


def test_a_killed_process_of_this_machine_is_known_at_once(tmp_path):
    with python(DIES, tmp_path) as killed:
        killed.join(60)
        assert killed.exitcode == -9
    database = opened(tmp_path)
    with Presence(database, "another") as presence, database.reading() as connection:
        assert living(database, connection) == {presence.worker: "another"}
        assert len(list((tmp_path / ".workers").iterdir())) == 2
    bury(database)
    assert not list((tmp_path / ".workers").iterdir())


def test_a_command_that_cannot_make_its_lock_leaves_no_row(tmp_path):
    database, folder = opened(tmp_path), tmp_path / ".workers"
    folder.write_text("")  # in the way of the folder of locks
    with pytest.raises(FileExistsError), Run(database, "target", "mine", ["train"]):
        pass
    assert run_rows(database) == []
    folder.unlink()
    with Run(database, "target", "mine", ["train"]):
        with refused("is being made", error=UsageError), Run(database, "target", "mine", ["train"]):
            pass
        assert len(list(folder.iterdir())) == 1


def test_an_interrupt_in_a_transaction_frees_its_lock_before_the_heart_is_awaited(tmp_path, monkeypatch):
    """As SQLAlchemy leaves it if Ctrl-C comes between BEGIN and the code that would roll back."""
    monkeypatch.setattr("kerv_cli.lab.runs.BEAT_SECONDS", 0.05)
    database, began = opened(tmp_path), time.monotonic()
    with pytest.raises(KeyboardInterrupt), Presence(database):  # noqa: PT012
        left = database.writing()
        left.__enter__()
        time.sleep(0.3)  # the heart waits for the lock
        raise KeyboardInterrupt
    assert time.monotonic() - began < 30.0
