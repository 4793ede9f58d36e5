"""Kills kerv's commands at random moments and at every write, and feeds them strange settings and damaged files.

    python scripts/torture.py [--short] [--minutes 15] [--seed 0] [--only kills,overrides,artifacts]

What must hold: a killed command, started again, ends with the artifacts and tables of an undisturbed run and leaves no
temporary file; a wrong request or a damaged file gives exit 1 or 2 and one line, or the same result; nothing hangs.
The figures are printed; the exit code is 1 where something did not hold. Every command runs in a fork of this process,
so that Python and torch load once.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))
warnings.simplefilter("ignore")

from torture_cases import damages, wrong_requests  # noqa: E402

from kerv_cli.config import conf_dir  # noqa: E402

LONGEST = 10.0  # seconds of CPU that a wrong request or a damaged file may take
TASK, NAME = "drawer-close", "mine"
FEW = [f"task={TASK}", "world.horizon=8"]
NANO = ["target=nano", "target.observation=state", "train.batch=4", "train.validate_every=2"]
POLICY = ["policy=state", f"policy.target={NAME}"]
STUDY = f"""
name: tortured
common: task={TASK} episodes=3 world.horizon=8 record=0 {" ".join(POLICY)}
block: 1
settings:
  ar: method=ar
  spec_vla: method=spec_vla
"""
COMMANDS = {  # in the order in which each needs what the ones before it made
    "demos": ["demos", f"task={TASK}", "episodes=4", "name=few", "frame_stride=16"],
    "train target": ["train", "target", f"task={TASK}", f"name={NAME}", "demos=few", *NANO, "train.steps=6"],
    "train drafter": [
        *("train", "drafter", *POLICY, "demos=few", "drafter.samples=12"),
        *("train.batch=4", "train.steps=4", "train.validate_every=2"),
    ],
    "build": ["build", "datastore", f"task={TASK}", *POLICY, "demos=few"],
    "calibrate": ["calibrate", f"task={TASK}", *POLICY, "demos=few", "held_out=0.4", "decodes=3"],
    "sweep": ["sweep", "study=tortured"],
    "report": ["report", "study=tortured"],
}


@dataclass
class Tally:
    """What was tried and what did not hold."""

    kills: int = 0
    at_writes: int = 0
    requests: int = 0
    artifacts: int = 0
    refused: int = 0
    same: int = 0
    slowest: float = 0.0
    faults: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Ended:
    """How a command ended. code: its exit code, negative for a signal. cpu: seconds."""

    code: int
    cpu: float
    text: str


def run(
    words: list[str], limit: float = 900.0, kill_at: int = 0, kill_after: float = 0.0, log: Path | None = None
) -> Ended:
    """Runs a command in a fork of this process, in its own process group.

    kill_at: SIGKILL before this write, counted from 1. kill_after: SIGKILL after so many seconds. log: gets a byte for
    every write.
    """
    output = tempfile.TemporaryFile()  # noqa: SIM115 - shared with the child
    child = os.fork()
    if child == 0:
        _be_command(words, output.fileno(), kill_at, log)
    with contextlib.suppress(OSError):  # the child does the same: whoever is first
        os.setpgid(child, child)
    deadline, killed = time.monotonic() + (kill_after or limit), False
    while True:
        ended, status, used = os.wait4(child, os.WNOHANG)
        if ended:
            break
        if not killed and time.monotonic() > deadline:
            os.killpg(child, signal.SIGKILL)
            killed = True
        time.sleep(0.003)
    output.seek(0)
    text = output.read().decode(errors="replace")
    return Ended(os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, text)


def _be_command(words: list[str], output: int, kill_at: int, log: Path | None) -> None:
    os.setpgid(0, 0)
    os.dup2(output, 1)
    os.dup2(output, 2)
    _count_writes(kill_at, log)
    code: object = 0
    try:
        from kerv_cli.app import app

        app(words)
    except SystemExit as error:
        code = error.code or 0
    except BaseException:  # noqa: BLE001 - told apart by the exit code
        import traceback

        traceback.print_exc()
        code = 99
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else 98)


def _count_writes(kill_at: int, log: Path | None) -> None:
    """Counts what changes the disk for good, renames and syncs, in this process."""
    done = [0]

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def counting(*arguments: Any, **keywords: Any) -> Any:
            done[0] += 1
            if done[0] == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)
            if log is not None:
                with log.open("ab") as file:
                    file.write(b".")
            return function(*arguments, **keywords)

        return counting

    os.replace, os.rename, os.fsync = counted(os.replace), counted(os.rename), counted(os.fsync)


def state(results: Path, command: str) -> dict[str, str]:
    """What a command must make again after a kill: file -> hash. Of a sweep, the columns that no clock decides."""
    places = {"train target": "target", "train drafter": "drafter", "build": "datastore", "calibrate": "calibration"}
    if command == "sweep":
        return dict(_sweep_state(results))
    folder = results / ("report" if command == "report" else f"artifacts/{places.get(command, 'demos')}")
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(results)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _sweep_state(results: Path) -> Iterator[tuple[str, str]]:
    import pandas as pd

    plan = results / "studies/tortured/plan.yaml"
    yield "plan.yaml", hashlib.sha256(plan.read_bytes()).hexdigest()
    for path in sorted(results.glob("studies/tortured/cells/*/episodes.parquet")):
        table = pd.read_parquet(path, columns=["task", "seed", "success", "steps", "forwards", "tokens", "accepted"])
        yield path.parent.name, table.to_csv()


class Torture:
    """Runs the three parts in a temporary folder. short: a tenth of everything."""

    def __init__(self, folder: Path, seed: int, minutes: float, short: bool) -> None:
        self.folder, self.random, self.short = folder, random.Random(seed), short
        self.ends = time.monotonic() + 60 * minutes
        self.tally, self.writes, self.seconds = Tally(), dict[str, int](), dict[str, float]()

    def enter(self, name: str) -> None:
        """Makes a folder and goes there: `results` means the same in every run."""
        (self.folder / name).mkdir()
        os.chdir(self.folder / name)

    def prepare(self) -> None:
        """Runs every command undisturbed; what lies in `results` before each is kept for the trials of that command."""
        conf = self.folder / "conf"
        shutil.copytree(conf_dir(), conf)
        (conf / "study/tortured.yaml").write_text(STUDY)
        os.environ["KERV_CONF_DIR"] = str(conf)
        self.enter("whole")
        for command, words in COMMANDS.items():
            if Path("results").exists():
                shutil.copytree("results", self.folder / f"before {command}")
            log, began = self.folder / "writes", time.monotonic()
            log.unlink(missing_ok=True)
            ended = run(words, log=log)
            if ended.code:
                raise SystemExit(f"{command} does not run: {ended.text[-600:]}")
            self.writes[command] = log.stat().st_size
            self.seconds[command] = time.monotonic() - began
            print(f"{command}: {self.writes[command]} writes, {self.seconds[command]:.1f} s", flush=True)

    def time_left(self) -> bool:
        """Whether another trial may begin."""
        return time.monotonic() < self.ends

    def kills(self, at_random: int) -> None:
        """Kills each command at every write (short: at every tenth), and at `at_random` random moments in all."""
        step = 10 if self.short else 1
        trials: list[tuple[str, int]] = [(c, at) for c in COMMANDS for at in range(1, self.writes[c] + 1, step)]
        trials += [(self.random.choice([*COMMANDS]), 0) for _ in range(at_random)]
        self.random.shuffle(trials)
        wanted = {command: state(self.folder / "whole/results", command) for command in COMMANDS}
        for command, at in trials:
            if not self.time_left():
                break
            self.kill(command, at, wanted[command])

    def kill(self, command: str, at: int, wanted: dict[str, str]) -> None:
        """One trial: kill, start again, compare."""
        self.enter("killed")
        before = self.folder / f"before {command}"
        if before.exists():
            shutil.copytree(before, "results")
        after = 0.0 if at else self.random.uniform(0.0, 1.2 * self.seconds[command])
        first = run(COMMANDS[command], kill_at=at, kill_after=after)
        self.tally.kills += first.code == -signal.SIGKILL
        self.tally.at_writes += bool(at) and first.code == -signal.SIGKILL
        again = run(COMMANDS[command])
        what = f"{command}, killed {f'at write {at}' if at else f'after {after:.2f} s'}"
        if again.code:
            self.tally.faults.append(f"{what}: started again: exit {again.code}: {again.text[-300:]}")
        elif (found := state(Path("results"), command)) != wanted:
            differing = sorted(name for name in {*found, *wanted} if found.get(name) != wanted.get(name))
            self.tally.faults.append(f"{what}: other results: {', '.join(differing[:5])}")
        left = [*Path("results").rglob(".*.tmp"), *Path("results").glob("studies/*/claims/*")]
        if left:
            self.tally.faults.append(f"{what}: left {', '.join(map(str, left[:5]))}")
        os.chdir(self.folder)
        shutil.rmtree("killed")

    def overrides(self, count: int) -> None:
        """Wrong and strange requests, each with --plan or --cfg so that nothing long begins."""
        os.chdir(self.folder / "whole")
        for words in wrong_requests(self.random, count):
            if not self.time_left():
                break
            self.tally.requests += 1
            self.judge(" ".join(words), run(words, limit=12 * LONGEST))

    def artifacts(self, count: int) -> None:
        """Damaged files, each met by the command that reads it."""
        whole = self.folder / "whole/results"
        for damage in damages(self.random, count, whole):
            if not self.time_left():
                break
            self.tally.artifacts += 1
            with damage.applied(whole):
                os.chdir(self.folder / "whole")
                self.judge(damage.name, run(READERS[damage.reader], limit=12 * LONGEST))

    def judge(self, what: str, ended: Ended) -> None:
        """Notes a refusal that is not one line, a crash or a hang."""
        self.tally.slowest = max(self.tally.slowest, ended.cpu)
        lines = [line for line in ended.text.splitlines() if line.startswith("kerv: ")]
        self.tally.refused += ended.code in (1, 2)
        self.tally.same += ended.code == 0
        if ended.code not in (0, 1, 2) or ended.cpu > LONGEST:
            fault = f"exit {ended.code} after {ended.cpu:.1f} s of CPU: {ended.text[-200:]}"
        elif ended.code and (len(lines) != 1 or "internal error" in lines[0] or "Traceback" in ended.text):
            fault = f"exit {ended.code}: {(lines or [ended.text[-200:]])[0]}"
        else:
            return
        self.tally.faults.append(f"{what[:200]!r}: {fault}")


READERS = {
    "rollout": ["rollout", *FEW, *POLICY, "episodes=1", "record=0", "method=heisd"],
    "resume": COMMANDS["train target"],
    "build": [*COMMANDS["build"], "name=again"],
    "report": COMMANDS["report"],
    "sweep": [*COMMANDS["sweep"], "--plan"],
}


def main() -> None:
    """Runs the parts and prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="a tenth of everything")
    parser.add_argument("--minutes", type=float, default=15.0, help="longest time of all together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="kills,overrides,artifacts")
    asked = parser.parse_args()
    share = 10 if asked.short else 1
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="kerv-torture-") as folder:
        torture = Torture(Path(folder), asked.seed, asked.minutes, asked.short)
        _load()
        if asked.only == "overrides":
            torture.enter("whole")
        else:
            torture.prepare()
        for part, count in (("kills", 60), ("overrides", 1000), ("artifacts", 1000)):
            if part in asked.only.split(","):
                getattr(torture, part)(count // share)
        os.chdir("/")
    figures = {**vars(torture.tally), "faults": len(torture.tally.faults), "minutes": (time.monotonic() - began) / 60}
    for fault in torture.tally.faults:
        print(f"FAULT {' '.join(fault.split())}")
    print(json.dumps({key: round(value, 1) for key, value in figures.items()}))
    sys.exit(bool(torture.tally.faults))


def _load() -> None:
    """Imports what the commands need, so that forks need not."""
    import torch

    import kerv_cli.app
    import kerv_cli.reporting.report
    import kerv_cli.rollouts.cells
    import kerv_cli.training.calibration
    import kerv_cli.training.datastore
    import kerv_cli.training.runs  # noqa: F401
    from kerv_cli.environments.camera import choose_backend

    torch.set_num_threads(1)
    choose_backend()


if __name__ == "__main__":
    main()
