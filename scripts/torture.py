"""Kills kerv's commands and lets their disk fail at every change of a file, and feeds them strange settings and files.

    python scripts/torture.py [--short] [--minutes 15] [--jobs CORES] [--seed N] [--only faults,requests,files,frames]

What must hold: a command that was killed or whose disk failed, started again, ends with the artifacts and tables of an
undisturbed run; before that, others work; no file and no process of it is left. A wrong request or a damaged file gives
exit 1 or 2 and one line, or the same result; a server goes on whatever clients send; nothing hangs. The figures are
printed; the exit code is 1 where something did not hold. Every command runs in a fork of this process, so that Python
and torch load once; the trials of all parts are shared out among `--jobs` processes. Faults come from torture.c,
preloaded where there is a compiler.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import hashlib
import json
import multiprocessing
import os
import random
import re
import secrets
import shutil
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
from torture_runs import ENDING, HINDERING, Ended, Fault, learn, preload, run  # noqa: E402

FAULTS = __name__ == "__main__" and preload()  # starts anew before anything large is loaded

import pandas as pd  # noqa: E402
import torch  # noqa: E402
from torture_cases import PLANNED, TASK, damage, keys_for, wrong_request  # noqa: E402
from torture_frames import DIALECTS, SERVE, Fire, seen_by  # noqa: E402

from kerv_cli.base.config import conf_dir  # noqa: E402
from kerv_cli.base.leftovers import left_over, remove  # noqa: E402
from kerv_cli.base.provenance import git_commit, stamp  # noqa: E402
from kerv_cli.lab.code import code_hash  # noqa: E402
from kerv_cli.worlds import spec_of  # noqa: E402
from kerv_cli.worlds.camera import choose_backend  # noqa: E402

LONGEST = 10.0  # seconds of CPU that a wrong request or a damaged file may take
MEMORY = 1024.0  # MiB that it may take beyond what a fork begins with
HANGS = 300.0  # seconds after which a command that waits for something is ended; a busy machine is slow, too
TRIALS = {"requests": 2000, "files": 1000, "frames": 20}
SHARE = 30.0  # seconds of CPU: a command of one second has as many trials, each with several faults
WORKERS = 6  # trials of one with worker processes, which start slowly
FURTHER = 16  # faults of a trial behind its first
PROBES = ("runs list", "doctor", "sweep study=tortured --plan")
POLICY = "policy=state policy.target=mine"
STUDY = f"""
name: tortured
common: task={TASK} episodes=2 world.horizon=8 record=0 {POLICY}
block: 1
settings:
  ar: method=ar
  spec_vla: method=spec_vla
"""
CERTIFY = STUDY.replace("tortured", "certified").replace("episodes=2", "episodes=1 seed=50000")
TRAIN = "train.batch=4 train.validate_every=2"
NANO = "target=nano target.chunk=2 train.steps=4"
SMALL = f"demos=few drafter.width=8 drafter.rank=2 train.steps=4 {TRAIN}"
TWO = "runtime.workers=2"


class Command(NamedTuple):
    """A command that is tortured. makes: pattern of what it must make again byte for byte below the results; of cells
    the columns that no clock decides. again: exit codes of the same command once it has done its work."""

    words: str
    makes: str
    again: tuple[int, ...] = (0,)


_COMMANDS = f"""
demos | demos task={TASK} episodes=4 name=few frame_stride=16 runtime.workers=1 | artifacts/demos/**/*
demos, two workers | demos task={TASK} episodes=8 name=two frame_stride=16 {TWO} | artifacts/demos/two/**/*
demos export | demos export demos=few | lerobot/**/*
demos import | demos import source=results/lerobot/few name=read | artifacts/demos/read/**/*
target | train target task={TASK} name=mine demos=few target.observation=state {NANO} {TRAIN} | artifacts/target/**/*
target, seeing | train target task={TASK} name=seeing demos=few {NANO} {TRAIN} | artifacts/target/seeing/**/*
drafter | train drafter {POLICY} demos=few drafter.samples=12 train.steps=4 {TRAIN} | artifacts/drafter/**/*
early | train drafter drafter=early {POLICY} {SMALL} drafter.samples=12 | artifacts/early/**/*
scout | train drafter drafter=scout policy.target=seeing {SMALL} train.scene_steps=2 | artifacts/scout/**/*
build | build datastore task={TASK} {POLICY} demos=few | artifacts/datastore/**/*
calibrate | calibrate task={TASK} {POLICY} demos=few held_out=0.4 decodes=3 | artifacts/calibration/**/*
calibrate success | calibrate success study=certified name=sure | artifacts/certificate/**/*
rollout | rollout task={TASK} world.horizon=8 {POLICY} episodes=2 record=1 method=ar | rollouts/**/episodes.parquet
sweep | sweep study=tortured | studies/**/episodes.parquet
sweep, two workers | sweep study=tortured episodes=4 {TWO} | studies/**/episodes.parquet
report | report study=tortured | report/**/*
runs export | runs export tortured | exports/**/*
runs rerun | runs rerun certified | studies/**/episodes.parquet
runs rm | runs rm tortured --yes | studies/*/plan.yaml
"""
COMMANDS = {  # in the order in which each needs what the ones before it made
    name: Command(words, makes, (0, 2) if name in ("demos import", "runs rm") else (0,))
    for name, words, makes in (line.split(" | ") for line in _COMMANDS.strip().splitlines())
}
READERS = {
    "rollout": f"rollout task={TASK} world.horizon=8 {POLICY} episodes=1 record=0 method=heisd",
    "resume": COMMANDS["target"].words,
    "record": COMMANDS["demos"].words,
    "build": COMMANDS["build"].words + " name=again",
    "import": COMMANDS["demos import"].words + "-again",
    "success": COMMANDS["calibrate success"].words,
    "report": COMMANDS["report"].words,
    "sweep": COMMANDS["sweep"].words + " --plan",
    "rerun": "runs rerun tortured --plan",
    "list": "runs list",
    "show": "runs show tortured",
    "compare": "runs compare tortured:ar tortured:spec_vla",
    "export": "runs export target/mine",
    "repair": "doctor --repair",
    "view": "view --summary results/rollouts",
}
NO_CLOCK = ["task", "seed", "success", "steps", "forwards", "tokens", "accepted"]


def state(command: str) -> dict[str, str]:
    """What a command must make again: file -> hash; of a cell: the columns that no clock decides."""
    results, here, made = Path("results"), os.getcwd().encode(), {}
    for path in (path for path in results.glob(COMMANDS[command].makes) if path.is_file()):
        cell = path.name == "episodes.parquet"
        content = (
            pd.read_parquet(path, columns=NO_CLOCK).to_csv().encode() if cell else path.read_bytes().replace(here, b"")
        )
        made[_undated(str(path))] = hashlib.sha256(content).hexdigest()
    return made


def _drawn(draw: random.Random, calls: int, count: int) -> list[int]:
    """Numbers of calls, more often early ones."""
    return [1 + int(calls ** draw.random()) for _ in range(count)]


def _undated(name: str) -> str:
    return re.sub(r"\d{8}-\d{6}(?=-)", "DATE", name)


def names_below(folder: Path) -> set[str]:
    """Every file and folder below, relative, without the dates of rollouts; of a folder its name with a slash."""
    return {_undated(f"{path.relative_to(folder)}{'/' if path.is_dir() else ''}") for path in folder.rglob("*")}


def undisturbed(words: str, log: Path) -> Ended:
    """Runs a command that must succeed, and loads what it loads. Of doctor also 1: a busy machine draws too slowly."""
    ended = run(words.split(), limit=HANGS, log=log)
    if ended.code not in (0, 1 if words == "doctor" else 0):
        raise SystemExit(f"{words} does not run: {ended.text[-600:]}")
    learn(log)
    return ended


class Trial(NamedTuple):
    """One thing to try. number: its place among the trials of its part, which decides what is drawn at random.
    command, at: of a fault, the command and the call that is struck first."""

    part: str
    number: int
    command: str = ""
    at: int = 0


@dataclass
class Tally:
    """What was tried and what did not hold. slowest: seconds of CPU of a request or of a reader of damaged files. seat:
    of waiting for a seat of the server."""

    counts: Counter[str] = field(default_factory=Counter)
    slowest: float = 0.0
    seat: float = 0.0
    faults: list[str] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Adds what another process tried."""
        self.counts.update(other.counts)
        self.slowest, self.seat = max(self.slowest, other.slowest), max(self.seat, other.seat)
        self.faults += other.faults

    def __str__(self) -> str:
        times = {"slowest": round(self.slowest, 1), "seat": round(self.seat, 1)}
        return json.dumps({**dict(sorted(self.counts.items())), **times, "wrong": len(self.faults)})


class Torture:
    """The undisturbed runs in a temporary folder, and the trials that are compared with them."""

    def __init__(self, folder: Path, seed: int, ends: float) -> None:
        self.folder, self.seed, self.ends, self.tally = folder, seed, ends, Tally()
        self.calls, self.cpu, self.memory = dict[str, int](), dict[str, float](), 0.0
        self.expected = dict[str, tuple[dict[str, str], set[str]]]()  # command -> state, names of files

    def prepare(self) -> None:
        """Runs every command undisturbed, and loads what it loads; what lies in `results` before each is kept for its
        trials."""
        torch.set_num_threads(1)
        choose_backend()
        stamp("cpu")
        kept, log, conf = self.folder / "prepared.json", self.folder / "log", conf_dir()
        os.environ["KERV_CONF_DIR"] = str(self.folder / "conf")
        code = f"{code_hash()} {git_commit()}"  # both stand in what commands make
        if kept.exists() and (known := json.loads(kept.read_text())).pop("code") == code:
            learn(log)
            self.calls, self.cpu, self.memory = known["calls"], known["cpu"], known["memory"]
            self.expected = {command: (made, set(names)) for command, (made, names) in known["expected"].items()}
        else:
            self.run_all(log, conf)
            expected = {command: (made, sorted(names)) for command, (made, names) in self.expected.items()}
            known = {
                "code": code,
                "calls": self.calls,
                "cpu": self.cpu,
                "memory": self.memory,
                "expected": expected,
            }
            kept.write_text(json.dumps(known))
        os.chdir(self.folder / "all")
        for command in PLANNED:
            keys_for(command)
        with spec_of(TASK).open_world(TASK) as world:  # draws the placements of the first seeds
            for seeds in (world.spec.seeds.training, world.spec.seeds.evaluation):
                world.reset(seeds.start)

    def run_all(self, log: Path, conf: Path) -> None:
        """Runs every command. log: gets the names of all modules that they load. conf: kerv's configuration."""
        if (self.folder / "prepared.json").exists():  # by other code
            shutil.rmtree(self.folder)
        shutil.copytree(conf, self.folder / "conf")
        (self.folder / "conf/study/tortured.yaml").write_text(STUDY)
        (self.folder / "conf/study/certified.yaml").write_text(CERTIFY)
        whole = self.folder / "whole"
        whole.mkdir()
        os.chdir(whole)
        for command, (words, _, _) in COMMANDS.items():
            if command == "runs rm":
                shutil.copytree(whole, self.folder / "all")
            shutil.copytree(whole, self.folder / f"before {command}")
            ended = undisturbed(words, log)
            self.calls[command], self.cpu[command] = ended.calls, ended.cpu
            self.expected[command] = state(command), names_below(whole)
            print(f"{command}: {ended.calls} calls, {ended.cpu:.1f} s of CPU", flush=True)
        os.chdir(self.folder / "all")
        for words in [*PLANNED.values(), *PROBES]:
            self.memory = undisturbed(words, log).memory
        log.write_text("\n".join(sys.modules))

    def trials(self, parts: list[str], share: int) -> list[Trial]:
        """All trials, in an order drawn at random, so that a run that ends early has tried some of everything. share:
        of so many takes one."""
        order = random.Random(self.seed)
        places = dict[str, list[int]]()
        for name, there in self.calls.items():
            most = WORKERS if "workers" in name else max(WORKERS, int(SHARE / self.cpu[name]))
            places[name] = order.sample(range(1, there + 1), min(most, there))
        calls = [(command, at) for command, ats in places.items() for at in ats]
        order.shuffle(calls)
        trials = [Trial("faults", number, *call) for number, call in enumerate(calls)]
        trials += [Trial(part, number) for part, most in TRIALS.items() for number in range(most)]
        order.shuffle(trials)
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

    def faults(self, trial: Trial, draw: random.Random) -> None:
        """A fault at a call, and more at random, while they end the command: one that goes on is struck, too."""
        calls, most = self.calls[trial.command], 4 if "workers" in trial.command else FURTHER
        faults = [Fault(draw.choice(ENDING), at) for at in (trial.at, *_drawn(draw, calls, draw.randrange(most)))]
        if draw.random() < 0.5:
            faults += [Fault(draw.choice(HINDERING), at) for at in _drawn(draw, calls, 1)]
        self.strike(trial.command, faults, draw.choices(PROBES, (1, 1, 5))[0])  # doctor is slow

    def strike(self, command: str, faults: list[Fault], probe: str) -> None:
        """Strikes a command, runs another, starts it again, compares."""
        place, (words, _, again) = self.place(f"before {command}"), COMMANDS[command]
        what = f"{command}, {', '.join(f'{fault.kind} at {fault.at}' for fault in faults)}"
        for fault in faults:
            ended = run(words.split(), HANGS, fault)
            self.tally.counts.update({"faults": ended.struck, f"faults, {fault.kind}": ended.struck})
            self.judge_struck(what, fault.kind, ended, again)
            if ended.code == 0:  # it did its work all the same; what it could not remove, the next write there does
                for path in left_over(place):
                    remove(path)
                break
        for other in dict.fromkeys((PROBES[0], probe)):
            looked = run(other.split(), HANGS)
            if looked.code not in (0, 1, 2) or "internal error" in looked.text or "Traceback" in looked.text:
                self.fault(what, f"then {other}: exit {looked.code}: {looked.text[-300:]}")
        if ended.code:
            ended = run(words.split(), HANGS)
        expected, names = self.expected[command]
        if ended.code not in again:
            self.fault(what, f"started again: exit {ended.code}: {ended.text[-300:]}")
        elif (made := state(command)) != expected:
            differing = sorted(name for name in {*made, *expected} if made.get(name) != expected.get(name))
            self.fault(what, f"other results: {', '.join(differing[:5])}")
        else:
            self.check_left(what, names_below(place) ^ names)

    def judge_struck(self, what: str, kind: str, ended: Ended, again: tuple[int, ...]) -> None:
        """Notes a command that met a fault otherwise than by its end, one line or no harm, and processes it left."""
        if ended.left:
            self.fault(what, f"{ended.left} processes outlived it")
        internal = kind != "memory" and ("internal error" in ended.text or "Traceback" in ended.text)
        ends = {"slow": again, "clock": again, "memory": (-11, -6, 1, *again)}.get(kind, (-9, 1, *again))
        if ended.code not in ends or internal:
            self.fault(what, f"exit {ended.code}: {ended.text[-300:]}")

    def requests(self, trial: Trial, draw: random.Random) -> None:
        """A wrong or strange request."""
        words, place = wrong_request(draw), self.place("all")
        self.judge(trial.part, repr(" ".join(words)[:200]), run(words, limit=HANGS))
        there = {"below/", "below/here/", *(f"below/here/{name}" for name in names_below(self.folder / "all"))}
        self.check_left(repr(" ".join(words)[:200]), names_below(place.parent.parent) ^ there)

    def files(self, trial: Trial, draw: random.Random) -> None:
        """A damaged file, met by the command that reads it."""
        place = self.place("all")
        what, reader = damage(draw, place / "results")
        self.judge(trial.part, what, run(READERS[reader].split(), limit=HANGS))
        temporary = {n for n in names_below(place) if n.endswith((".tmp", ".tmp/")) or "/claims/" in n[:-1]}
        self.check_left(what, temporary)

    def frames(self, trial: Trial, draw: random.Random) -> None:
        """Damaged messages and connections, sent to a server of each protocol, which ends in order."""
        place = self.place("all")
        for dialect in DIALECTS:
            fire = Fire(draw, dialect, seen_by(place / "results", TASK))
            ended = run([*SERVE.split(), f"protocol={dialect.name}"], HANGS, meanwhile=fire)
            self.tally.counts.update(fire.counts)
            self.tally.seat = max(self.tally.seat, fire.seat)
            for says in fire.wrong:
                self.fault(dialect.name, says)
            wrong = ended.code or ended.left or ended.memory > self.memory + MEMORY
            if wrong or "internal error" in ended.text or "Traceback" in ended.text:
                self.fault(dialect.name, f"exit {ended.code}, {ended.memory:.0f} MiB: {ended.text[-300:]}")
        self.check_left("frames", {name for name in names_below(place) if name.endswith((".tmp", ".tmp/"))})

    def judge(self, part: str, what: str, ended: Ended) -> None:
        """Notes a refusal that is not one line, a crash or a hang."""
        self.tally.slowest = max(self.tally.slowest, ended.cpu)
        self.tally.counts.update({part: 1, "refused": int(ended.code in (1, 2)), "same": int(ended.code == 0)})
        lines = [line for line in ended.text.splitlines() if line.startswith("kerv: ")]
        if ended.code not in (0, 1, 2) or ended.cpu > LONGEST or ended.left or ended.memory > self.memory + MEMORY:
            times = f"after {ended.cpu:.1f} s of CPU, {ended.wall:.1f} in all, {ended.memory:.0f} MiB"
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
                whole.add(tally := done.result())
                for fault in tally.faults:
                    print(f"FAULT {' '.join(fault.split())}", flush=True)
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
    parser.add_argument(
        "--seed", type=int, default=secrets.randbelow(10**6), help="of what is drawn; a new one each run"
    )
    parser.add_argument("--only", default="faults,requests,files,frames")
    parser.add_argument("--keep", type=Path, help="folder in which everything is prepared once for several runs")
    parser.add_argument("--commands", default="", help="faults of those commands alone whose names hold this")
    asked = parser.parse_args()
    parts = [part for part in asked.only.split(",") if part != "faults" or FAULTS]
    print(
        f"seed {asked.seed}" if FAULTS else f"seed {asked.seed}; no faults: no compiler for torture.c here", flush=True
    )
    temporary = functools.partial(tempfile.TemporaryDirectory, prefix="kerv-torture-")
    ends = began + 60 * 0.98 * asked.minutes  # what has begun must end, too
    with contextlib.nullcontext(asked.keep) if asked.keep else temporary() as folder:
        torture = Torture(Path(folder).resolve(), asked.seed, ends)
        torture.prepare()
        print(f"ready after {time.monotonic() - began:.0f} s", flush=True)
        tally = torture.tally
        trials = torture.trials(parts, 10 if asked.short else 1)
        trials = [trial for trial in trials if asked.commands in trial.command]
        tally.add(share_out(torture, trials, asked.jobs))
        os.chdir("/")
    if FAULTS:
        shutil.rmtree(Path(os.environ["LD_PRELOAD"]).parent)
    print(f"{tally} in {(time.monotonic() - began) / 60:.1f} minutes, {asked.jobs} processes")
    sys.exit(bool(tally.faults))


if __name__ == "__main__":
    main()
