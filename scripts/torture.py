"""Kills kerv's commands at random moments and at every write, and feeds them strange settings and damaged files.

    python scripts/torture.py [--short] [--minutes 15] [--jobs CORES] [--seed 0] [--only kills,requests,artifacts]

What must hold: a killed command, started again, ends with the artifacts and tables of an undisturbed run and leaves no
file and no process behind; a wrong request or a damaged file gives exit 1 or 2 and one line, or the same result;
nothing hangs. The figures are printed; the exit code is 1 where something did not hold. Every command runs in a fork of
this process, so that Python and torch load once; the trials of all parts are shared out among `--jobs` processes.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))
warnings.simplefilter("ignore")

from torture_cases import PLANNED, TASK, damage, wrong_request  # noqa: E402
from torture_runs import Ended, Kill, learn, load, names_below, run, warm  # noqa: E402
from torture_states import state  # noqa: E402

from kerv_cli.base.config import conf_dir  # noqa: E402

LONGEST = 10.0  # seconds of CPU that a wrong request or a damaged file may take
HANGS = 300.0  # seconds after which a command that waits for something is ended; a busy machine is slow, too
TRIALS = {"kills": 60, "requests": 1000, "artifacts": 1000}  # kills: at random, besides those at every write
NAME = "mine"
FEW = [f"task={TASK}", "world.horizon=8"]
NANO = ["target=nano", "target.observation=state", "target.chunk=2", "train.batch=4", "train.validate_every=2"]
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
READERS = {
    "rollout": ["rollout", *FEW, *POLICY, "episodes=1", "record=0", "method=heisd"],
    "resume": COMMANDS["train target"],
    "build": [*COMMANDS["build"], "name=again"],
    "report": COMMANDS["report"],
    "sweep": [*COMMANDS["sweep"], "--plan"],
}


@dataclass(frozen=True)
class Trial:
    """One thing to try. number: its place among the trials of its part, which decides what is drawn at random.
    command, at: of a kill, the command and the write before which it happens; 0: a random moment."""

    part: str
    number: int
    command: str = ""
    at: int = 0


@dataclass
class Tally:
    """What was tried and what did not hold. slowest: seconds of CPU of a request or of a reader of damaged files."""

    kills: int = 0
    at_writes: int = 0
    requests: int = 0
    artifacts: int = 0
    refused: int = 0
    same: int = 0
    slowest: float = 0.0
    faults: list[str] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Adds what another process tried."""
        for name, value in vars(other).items():
            both = (getattr(self, name), value)
            setattr(self, name, max(both) if name == "slowest" else both[0] + both[1])


class Torture:
    """The undisturbed runs in a temporary folder, and the trials that are compared with them."""

    def __init__(self, folder: Path, seed: int, ends: float) -> None:
        self.folder, self.seed, self.ends = folder, seed, ends
        self.tally, self.writes, self.seconds = Tally(), dict[str, int](), dict[str, float]()
        self.wanted, self.names = dict[str, dict[str, str]](), dict[str, set[str]]()

    def prepare(self) -> None:
        """Runs every command undisturbed, and learns what it loads; what lies in `results` before each is kept for its
        trials. Then a second time, which must not change the results, and tells how long a command takes that finds
        everything loaded."""
        conf = self.folder / "conf"
        shutil.copytree(conf_dir(), conf)
        (conf / "study/tortured.yaml").write_text(STUDY)
        os.environ["KERV_CONF_DIR"] = str(conf)
        whole, log = self.folder / "whole", self.folder / "log"
        whole.mkdir()
        for command, words in COMMANDS.items():
            shutil.copytree(whole, self.folder / f"before {command}")
            os.chdir(whole)
            self.undisturbed(command, words, log)
            self.wanted[command], self.names[command] = state(Path("results"), command), names_below(whole)
            self.writes[command] = learn(log)
        for name, words in PLANNED.items():
            self.undisturbed(f"the plan of {name}", words, log)
            learn(log)
        warm(TASK)
        for command in COMMANDS:
            began = time.monotonic()
            self.kill(command, [], random.Random())
            self.seconds[command] = time.monotonic() - began
            print(f"{command}: {self.writes[command]} writes, {self.seconds[command]:.1f} s", flush=True)

    def undisturbed(self, name: str, words: list[str], log: Path) -> None:
        """Runs a command that must succeed."""
        ended = run(words, limit=HANGS, log=log)
        if ended.code:
            raise SystemExit(f"{name} does not run: {ended.text[-600:]}")

    def trials(self, parts: list[str], share: int) -> list[Trial]:
        """All trials, in an order drawn at random, so that a run that ends early has tried some of everything. share:
        of so many takes one."""
        kills = [(command, at) for command in COMMANDS for at in range(1, self.writes[command] + 1)]
        kills += [(command, 0) for command, _ in zip(_forever([*COMMANDS]), range(TRIALS["kills"]), strict=False)]
        found = [Trial("kills", number, *kill) for number, kill in enumerate(kills)]
        found += [Trial(part, number) for part in ("requests", "artifacts") for number in range(TRIALS[part])]
        random.Random(self.seed).shuffle(found)
        return [trial for trial in found if trial.part in parts and trial.number % share == 0]

    def __call__(self, trial: Trial) -> Tally:
        """Makes one trial, in a folder of this process -> what came of it. Nothing once time is up."""
        self.tally = Tally()
        if time.monotonic() < self.ends:
            draw = random.Random(f"{self.seed} {trial.part} {trial.number}")
            try:
                if trial.part == "kills":
                    self.kill(trial.command, self.moments(trial, draw), draw)
                else:
                    getattr(self, trial.part)(draw)
            except Exception:  # noqa: BLE001 - one trial that cannot be made must not end the others
                self.tally.faults.append(f"{trial}: {traceback.format_exc()[-600:]}")
        return self.tally

    def place(self, content: str) -> Path:
        """Goes to a new folder of this process with the content of one of the prepared ones."""
        os.chdir(self.folder)
        place = self.folder / f"process {os.getpid()}" / "below" / "here"
        shutil.rmtree(place.parent, ignore_errors=True)
        shutil.copytree(self.folder / content, place)
        os.chdir(place)
        return place

    def moments(self, trial: Trial, draw: random.Random) -> list[Kill]:
        """When a command is killed; at random moments up to three times, so that a command that goes on is killed
        too."""
        if trial.at:
            return [Kill(at=trial.at)]
        return [Kill(after=draw.uniform(0.0, self.seconds[trial.command])) for _ in range(draw.choice((1, 1, 2, 3)))]

    def kill(self, command: str, moments: list[Kill], draw: random.Random) -> None:
        """Kills a command, starts it again, compares."""
        place, name = self.place(f"before {command}"), f"{command}, killed {', then '.join(map(str, moments))}"
        ended = [run(COMMANDS[command], limit=HANGS, kill=moment) for moment in moments]
        ended.append(run(COMMANDS[command], limit=HANGS))
        self.tally.kills += sum(one.was_killed for one in ended[:-1])
        self.tally.at_writes += sum(one.was_killed and bool(kill.at) for one, kill in zip(ended, moments, strict=False))
        if ended[-1].code:
            self.tally.faults.append(f"{name}: started again: exit {ended[-1].code}: {ended[-1].text[-300:]}")
        elif (found := state(Path("results"), command)) != (wanted := self.wanted[command]):
            differing = sorted(name for name in {*found, *wanted} if found.get(name) != wanted.get(name))
            self.tally.faults.append(f"{name}: other results: {', '.join(differing[:5])}")
        elif (names := names_below(place)) != self.names[command]:
            self.tally.faults.append(f"{name}: other files: {', '.join(sorted(names ^ self.names[command])[:5])}")
        if any(one.left for one in ended):
            self.tally.faults.append(f"{name}: processes outlived it")

    def requests(self, draw: random.Random) -> None:
        """A wrong or strange request."""
        words, place = wrong_request(draw), self.place("whole")
        self.tally.requests += 1
        self.judge(" ".join(words), run(words, limit=HANGS))
        left = names_below(place.parent.parent) ^ {f"below/here/{name}" for name in self.names["report"]}
        if left - {"below/", "below/here/"}:
            self.tally.faults.append(f"{' '.join(words)[:200]!r}: left {', '.join(sorted(left)[:5])}")

    def artifacts(self, draw: random.Random) -> None:
        """A damaged file, met by the command that reads it."""
        place = self.place("whole")
        damaged = damage(draw, place / "results")
        damaged.apply(place / "results")
        self.tally.artifacts += 1
        self.judge(damaged.name, run(READERS[damaged.reader], limit=HANGS))
        left = [name for name in names_below(place) if name.endswith((".tmp", ".tmp/")) or "/claims/" in name[:-1]]
        if left:
            self.tally.faults.append(f"{damaged.name}: left {', '.join(left[:5])}")

    def judge(self, what: str, ended: Ended) -> None:
        """Notes a refusal that is not one line, a crash or a hang."""
        self.tally.slowest = max(self.tally.slowest, ended.cpu)
        lines = [line for line in ended.text.splitlines() if line.startswith("kerv: ")]
        self.tally.refused += ended.code in (1, 2)
        self.tally.same += ended.code == 0
        if ended.code not in (0, 1, 2) or ended.cpu > LONGEST or ended.left:
            fault = f"exit {ended.code} after {ended.cpu:.1f} s of CPU, {ended.wall:.1f} in all: {ended.text[-200:]}"
        elif ended.code and (len(lines) != 1 or "internal error" in lines[0] or "Traceback" in ended.text):
            fault = f"exit {ended.code}: {(lines or [ended.text[-200:]])[0]}"
        else:
            return
        self.tally.faults.append(f"{what[:200]!r}: {fault}")


def _forever(names: list[str]) -> Iterator[str]:
    while True:
        yield from names


def share_out(torture: Torture, trials: list[Trial], jobs: int) -> Tally:
    """Makes the trials in `jobs` forks of this process -> the sum of what came of them."""
    whole, told = Tally(), time.monotonic()
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("fork")) as pool:
        try:
            for done in as_completed([pool.submit(torture, trial) for trial in trials]):
                whole.add(done.result())
                if time.monotonic() > told + 60:
                    told = time.monotonic()
                    print(_summary(whole), flush=True)
        except BrokenProcessPool:
            whole.faults.append("a process that makes the trials ended; the machine may be short of memory")
    return whole


def _summary(tally: Tally) -> str:
    figures = {**vars(tally), "slowest": round(tally.slowest, 1), "faults": len(tally.faults)}
    return json.dumps(figures)


def main() -> None:
    """Runs the parts and prints the figures."""
    began = time.monotonic()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="a tenth of everything")
    parser.add_argument("--minutes", type=float, default=15.0, help="longest time of all together")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="processes that make the trials")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(TRIALS))
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="kerv-torture-") as folder:
        torture = Torture(Path(folder), asked.seed, began + 60 * 0.98 * asked.minutes)  # what has begun must end, too
        load()
        torture.prepare()
        print(f"ready after {time.monotonic() - began:.0f} s", flush=True)
        trials = torture.trials(asked.only.split(","), 10 if asked.short else 1)
        tally = share_out(torture, trials, asked.jobs)
        tally.faults += torture.tally.faults
        os.chdir("/")
    for fault in tally.faults:
        print(f"FAULT {' '.join(fault.split())}")
    print(f"{_summary(tally)} in {(time.monotonic() - began) / 60:.1f} minutes, {asked.jobs} processes")
    sys.exit(bool(tally.faults))


if __name__ == "__main__":
    main()
