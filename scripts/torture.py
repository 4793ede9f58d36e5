"""Kills kerv's commands at random moments and at every write, and feeds them strange settings and damaged files.

    python scripts/torture.py [--short] [--minutes 15] [--jobs CORES] [--seed 0] [--only kills,requests,artifacts]

What must hold: a killed command, started again, ends with the artifacts and tables of an undisturbed run and leaves no
file and no process behind; a wrong request or a damaged file gives exit 1 or 2 and one line, or the same result;
nothing hangs. The figures are printed; the exit code is 1 where something did not hold. Every command runs in a fork of
this process, so that Python and torch load once; the trials of all parts are shared out among `--jobs` processes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))
warnings.simplefilter("ignore")

import pandas as pd  # noqa: E402
import torch  # noqa: E402
from torture_cases import PLANNED, TASK, damage, keys_for, wrong_request  # noqa: E402
from torture_runs import NEVER, Ended, Kill, learn, run  # noqa: E402

from kerv_cli.base.config import conf_dir  # noqa: E402
from kerv_cli.base.provenance import stamp  # noqa: E402
from kerv_cli.lab.code import code_hash  # noqa: E402
from kerv_cli.worlds import spec_of  # noqa: E402
from kerv_cli.worlds.camera import choose_backend  # noqa: E402

LONGEST = 10.0  # seconds of CPU that a wrong request or a damaged file may take
HANGS = 300.0  # seconds after which a command that waits for something is ended; a busy machine is slow, too
TRIALS = {"kills": 60, "requests": 1000, "artifacts": 1000}  # kills: at random, besides those at every write
POLICY = "policy=state policy.target=mine"
STUDY = f"""
name: tortured
common: task={TASK} episodes=3 world.horizon=8 record=0 {POLICY}
block: 1
settings:
  ar: method=ar
  spec_vla: method=spec_vla
"""
TRAIN = "train.batch=4 train.validate_every=2"
NANO = "target=nano target.observation=state target.chunk=2 train.steps=6"
COMMANDS = {  # in the order in which each needs what the ones before it made
    "demos": f"demos task={TASK} episodes=4 name=few frame_stride=16",
    "train target": f"train target task={TASK} name=mine demos=few {NANO} {TRAIN}",
    "train drafter": f"train drafter {POLICY} demos=few drafter.samples=12 train.steps=4 {TRAIN}",
    "build": f"build datastore task={TASK} {POLICY} demos=few",
    "calibrate": f"calibrate task={TASK} {POLICY} demos=few held_out=0.4 decodes=3",
    "sweep": "sweep study=tortured",
    "report": "report study=tortured",
}
READERS = {
    "rollout": f"rollout task={TASK} world.horizon=8 {POLICY} episodes=1 record=0 method=heisd",
    "resume": COMMANDS["train target"],
    "build": COMMANDS["build"] + " name=again",
    "report": COMMANDS["report"],
    "sweep": COMMANDS["sweep"] + " --plan",
}
FOLDERS = {  # command -> the folder of results whose files it must make again byte for byte
    "demos": "artifacts/demos",
    "train target": "artifacts/target",
    "train drafter": "artifacts/drafter",
    "build": "artifacts/datastore",
    "calibrate": "artifacts/calibration",
    "report": "report",
}
NO_CLOCK = ["task", "seed", "success", "steps", "forwards", "tokens", "accepted"]


def state(results: Path, command: str) -> dict[str, str]:
    """What a command must make again after a kill: file -> hash. Of a sweep: the plan, and the columns that no clock
    decides."""
    if command in FOLDERS:
        files = [path for path in (results / FOLDERS[command]).rglob("*") if path.is_file()]
        contents = {str(path.relative_to(results)): path.read_bytes() for path in files}
    else:
        cells = sorted(results.glob("studies/tortured/cells/*/episodes.parquet"))
        contents = {path.parent.name: pd.read_parquet(path, columns=NO_CLOCK).to_csv().encode() for path in cells}
        contents["plan.yaml"] = (results / "studies/tortured/plan.yaml").read_bytes()
    return {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}


def names_below(folder: Path) -> set[str]:
    """Every file and folder below, relative; of a folder its name with a slash."""
    return {f"{path.relative_to(folder)}{'/' if path.is_dir() else ''}" for path in folder.rglob("*")}


def undisturbed(words: str, log: Path) -> int:
    """Runs a command that must succeed, and loads what it loads -> its number of writes."""
    ended = run(words.split(), limit=HANGS, log=log)
    if ended.code:
        raise SystemExit(f"{words} does not run: {ended.text[-600:]}")
    return learn(log)


class Trial(NamedTuple):
    """One thing to try. number: its place among the trials of its part, which decides what is drawn at random.
    command, at: of a kill, the command and the write before which it happens; 0: a random moment."""

    part: str
    number: int
    command: str = ""
    at: int = 0


@dataclass
class Tally:
    """What was tried and what did not hold. slowest: seconds of CPU of a request or of a reader of damaged files."""

    counts: Counter[str] = field(default_factory=Counter)
    slowest: float = 0.0
    faults: list[str] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Adds what another process tried."""
        self.counts.update(other.counts)
        self.slowest = max(self.slowest, other.slowest)
        self.faults += other.faults

    def __str__(self) -> str:
        return json.dumps({**self.counts, "slowest": round(self.slowest, 1), "faults": len(self.faults)})


class Torture:
    """The undisturbed runs in a temporary folder, and the trials that are compared with them."""

    def __init__(self, folder: Path, seed: int, ends: float) -> None:
        self.folder, self.seed, self.ends, self.tally = folder, seed, ends, Tally()
        self.writes, self.seconds = dict[str, int](), dict[str, float]()
        self.expected = dict[str, tuple[dict[str, str], set[str]]]()  # command -> state, names of files

    def prepare(self) -> None:
        """Runs every command undisturbed, and loads what it loads; what lies in `results` before each is kept for its
        trials. Then a second time, which must not change the results, and tells how long a command takes that finds
        everything loaded."""
        shutil.copytree(conf_dir(), self.folder / "conf")
        (self.folder / "conf/study/tortured.yaml").write_text(STUDY)
        os.environ["KERV_CONF_DIR"] = str(self.folder / "conf")
        torch.set_num_threads(1)
        choose_backend()
        stamp("cpu")
        code_hash()
        whole, log = self.folder / "whole", self.folder / "log"
        whole.mkdir()
        os.chdir(whole)
        for command, words in COMMANDS.items():
            shutil.copytree(whole, self.folder / f"before {command}")
            self.writes[command] = undisturbed(words, log)
            self.expected[command] = state(Path("results"), command), names_below(whole)
        for command, words in PLANNED.items():
            undisturbed(words, log)
            keys_for(command)
        with spec_of(TASK).open_world(TASK) as world:  # draws the placements of the first seeds
            for seeds in (world.spec.seeds.training, world.spec.seeds.evaluation):
                world.reset(seeds.start)
        for command in COMMANDS:
            began = time.monotonic()
            self.kill(command, [])
            self.seconds[command] = time.monotonic() - began
            print(f"{command}: {self.writes[command]} writes, {self.seconds[command]:.1f} s", flush=True)

    def trials(self, parts: list[str], share: int) -> list[Trial]:
        """All trials, in an order drawn at random, so that a run that ends early has tried some of everything. share:
        of so many takes one."""
        kills = [(command, at) for command in COMMANDS for at in range(1, self.writes[command] + 1)]
        kills += [([*COMMANDS][number % len(COMMANDS)], 0) for number in range(TRIALS["kills"])]
        trials = [Trial("kills", number, *kill) for number, kill in enumerate(kills)]
        trials += [Trial(part, number) for part in ("requests", "artifacts") for number in range(TRIALS[part])]
        random.Random(self.seed).shuffle(trials)
        return [trial for trial in trials if trial.part in parts and trial.number % share == 0]

    def __call__(self, trial: Trial) -> Tally:
        """Makes one trial, in a folder of this process -> what came of it. Nothing once time is up."""
        self.tally = Tally()
        if time.monotonic() < self.ends:
            draw = random.Random(f"{self.seed} {trial.part} {trial.number}")
            try:
                getattr(self, trial.part)(trial, draw)
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

    def kills(self, trial: Trial, draw: random.Random) -> None:
        """A kill at a write, or up to three in a row at random moments: a command that goes on is killed, too."""
        longest = self.seconds[trial.command]
        random_ones = [Kill(after=draw.uniform(0.0, longest)) for _ in range(draw.choice((1, 1, 2, 3)))]
        self.kill(trial.command, [Kill(at=trial.at)] if trial.at else random_ones)

    def kill(self, command: str, moments: list[Kill]) -> None:
        """Kills a command, starts it again, compares."""
        place, words = self.place(f"before {command}"), COMMANDS[command].split()
        ended = [run(words, HANGS, moment) for moment in [*moments, NEVER]]
        killed = [moment for one, moment in zip(ended, moments, strict=False) if one.code == -signal.SIGKILL]
        self.tally.counts.update(kills=len(killed), at_writes=sum(bool(moment.at) for moment in killed))
        expected, names = self.expected[command]
        if ended[-1].code:
            self.fault(f"{command}, {moments}", f"started again: exit {ended[-1].code}: {ended[-1].text[-300:]}")
        elif (made := state(Path("results"), command)) != expected:
            differing = sorted(name for name in {*made, *expected} if made.get(name) != expected.get(name))
            self.fault(f"{command}, {moments}", f"other results: {', '.join(differing[:5])}")
        else:
            self.check_left(f"{command}, {moments}", names_below(place) ^ names)
        if any(one.left for one in ended):
            self.fault(f"{command}, {moments}", "processes outlived it")

    def requests(self, trial: Trial, draw: random.Random) -> None:
        """A wrong or strange request."""
        words, place = wrong_request(draw), self.place("whole")
        self.judge(trial.part, repr(" ".join(words)[:200]), run(words, limit=HANGS))
        there = {"below/", "below/here/", *(f"below/here/{name}" for name in self.expected["report"][1])}
        self.check_left(repr(" ".join(words)[:200]), names_below(place.parent.parent) ^ there)

    def artifacts(self, trial: Trial, draw: random.Random) -> None:
        """A damaged file, met by the command that reads it."""
        place = self.place("whole")
        what, reader = damage(draw, place / "results")
        self.judge(trial.part, what, run(READERS[reader].split(), limit=HANGS))
        temporary = {n for n in names_below(place) if n.endswith((".tmp", ".tmp/")) or "/claims/" in n[:-1]}
        self.check_left(what, temporary)

    def judge(self, part: str, what: str, ended: Ended) -> None:
        """Notes a refusal that is not one line, a crash or a hang."""
        self.tally.slowest = max(self.tally.slowest, ended.cpu)
        self.tally.counts.update({part: 1, "refused": int(ended.code in (1, 2)), "same": int(ended.code == 0)})
        lines = [line for line in ended.text.splitlines() if line.startswith("kerv: ")]
        if ended.code not in (0, 1, 2) or ended.cpu > LONGEST or ended.left:
            times = f"after {ended.cpu:.1f} s of CPU, {ended.wall:.1f} in all"
            self.fault(what, f"exit {ended.code} {times}: {ended.text[-200:]}")
        elif ended.code and (len(lines) != 1 or "internal error" in lines[0] or "Traceback" in ended.text):
            self.fault(what, f"exit {ended.code}: {(lines or [ended.text[-200:]])[0]}")

    def check_left(self, what: str, names: set[str]) -> None:
        """Notes files that should not be there, or are not."""
        if names:
            self.fault(what, f"other files: {', '.join(sorted(names)[:5])}")

    def fault(self, what: str, says: str) -> None:
        """Notes what did not hold."""
        self.tally.faults.append(f"{what}: {says}")


def share_out(torture: Torture, trials: list[Trial], jobs: int) -> Tally:
    """Makes the trials in `jobs` forks of this process -> the sum of what came of them."""
    whole, told = Tally(), time.monotonic()
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("fork")) as pool:
        try:
            for done in as_completed([pool.submit(torture, trial) for trial in trials]):
                whole.add(done.result())
                if time.monotonic() > told + 60:
                    told = time.monotonic()
                    print(whole, flush=True)
        except BrokenProcessPool:
            whole.faults.append("a process that makes the trials ended; the machine may be short of memory")
    return whole


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
        torture.prepare()
        print(f"ready after {time.monotonic() - began:.0f} s", flush=True)
        tally = torture.tally
        tally.add(share_out(torture, torture.trials(asked.only.split(","), 10 if asked.short else 1), asked.jobs))
        os.chdir("/")
    for fault in tally.faults:
        print(f"FAULT {' '.join(fault.split())}")
    print(f"{tally} in {(time.monotonic() - began) / 60:.1f} minutes, {asked.jobs} processes")
    sys.exit(bool(tally.faults))


if __name__ == "__main__":
    main()
