"""Commands that are killed, cannot write or read damaged files: `make torture`; pytest alone does not find this file.

Each test draws rounds at random until its share of MINUTES (default 1) is over. SEED repeats the rounds of a run. The
tests know the command line alone: what lies in the results folder is not their business.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import json
import os
import random
import re
import resource
import secrets
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

SECONDS = 60 * float(os.environ.get("MINUTES") or 1)  # of all three tests together
SEED = int(os.environ.get("SEED") or secrets.randbelow(10**6))
HANGS = 300.0  # seconds after which a command counts as one that hangs
PATIENCE = 5.0  # seconds in which the processes of a command that ended have to end
SAME = ("label", "task", "seed", "success", "steps", "decodes", "forwards")  # columns that no run changes
STUDY = """
name: tiny
common: task=[drawer-open,reach] world.horizon=8 episodes=2 record=0
block: 1
settings:
  ar: method=ar
  spec_vla: method=spec_vla
"""
DEMOS = "demos task=handle-press frame_stride=16"
TRAIN = "target=nano target.chunk=2 target.observation=state train.steps=4 train.batch=4 train.validate_every=2"


class Command(NamedTuple):
    """A command that writes, and the run that it makes."""

    words: str
    run: str


COMMANDS = (
    Command("sweep study=tiny.yaml episodes=3", "tiny"),
    Command("sweep study=tiny.yaml episodes=4 runtime.workers=2", "tiny"),
    Command("rollout method=one_pass task=reach world.horizon=8 episodes=2 record=1", "last"),
    Command(f"train target task=handle-press name=mine demos=few {TRAIN}", "target/mine"),
    Command(f"{DEMOS} episodes=4 name=two runtime.workers=2", "demos/two"),
    Command("report study=tiny", "tiny"),
)
LOOKS = ("runs list", "runs list --json", "report study=tiny")
READERS = (*LOOKS, "runs show tiny", "runs export tiny", "sweep study=tiny.yaml", *(words for words, _ in COMMANDS))


class Ended(NamedTuple):
    """How a command ended. code: its exit code, negative for a signal. left: processes that outlived it."""

    code: int
    out: str
    err: str
    left: int
    seconds: float

    @property
    def lines(self) -> list[str]:
        """What the command says about its own end."""
        lines = [line for line in self.err.splitlines() if line.startswith("kerv: ")]
        return [line for line in lines if not line.startswith(("kerv: warning:", "kerv: note:"))]

    @property
    def broken(self) -> bool:
        """Whether the command ended otherwise than it may: without a plain line, or with processes that go on."""
        crashed = "Traceback" in self.err or "internal error" in self.err
        return crashed or bool(self.left) or self.code not in (0, 1, 2) or (self.code > 0 and len(self.lines) != 1)

    def __str__(self) -> str:
        return f"exit {self.code}, {self.left} processes left: {self.err[-1500:]}"


def kerv(words: str, folder: Path, kill: tuple[float, int] | None = None, most: int | None = None) -> Ended:
    """Runs a command.

    Args:
        words: What follows `kerv`.
        folder: Working folder.
        kill: Seconds until a signal is sent, and the signal.
        most: Size in bytes that no file may exceed.
    """
    limit = None if most is None else functools.partial(resource.setrlimit, resource.RLIMIT_FSIZE, (most, most))
    began, environment = time.monotonic(), {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "kerv_cli", *words.split()],
        cwd=folder, env=environment, start_new_session=True, preexec_fn=limit, text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    if kill is not None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(kill[0])
        with contextlib.suppress(ProcessLookupError):  # Ctrl-C reaches the workers, too
            (os.killpg if kill[1] == signal.SIGINT else os.kill)(process.pid, kill[1])
    try:
        out, err = process.communicate(timeout=HANGS)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, err = process.communicate()
    seconds = time.monotonic() - began
    return Ended(process.returncode, out, err, outlived(process.pid), seconds)


def outlived(session: int) -> int:
    """Number of processes of a session that do not end in time; they are killed."""
    until = time.monotonic() + PATIENCE
    while (there := members(session)) and time.monotonic() < until:
        time.sleep(0.05)
    for process in there:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    return len(there)


def members(session: int) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, _, its_session = path.read_text().rpartition(")")[2].split()[:4]
            found += [int(path.parent.name)] if int(its_session) == session and state != "Z" else []
    return found


def well(words: str, folder: Path) -> str:
    """Standard output of a command that must succeed."""
    ended = kerv(words, folder)
    assert ended.code == 0, f"kerv {words}: {ended}"
    return ended.out


def result(run: str, folder: Path) -> object:
    """What a command made, without what the clock decides: of episodes every row, of artifacts their hash."""
    runs = json.loads(well("runs list --json", folder))
    entry = runs[0] if run == "last" else next(entry for entry in runs if entry["id"] == run)
    assert entry["state"] == "complete", entry
    if entry["sha256"]:
        return entry["sha256"]
    tables = {}
    for name in json.loads(well(f"runs export {entry['id']} --json", folder))["written"]:
        with (folder / name).open(newline="") as file:
            rows = [{key: row[key] for key in SAME} for row in csv.DictReader(file)]
        tables[re.sub(r"\d{8}-\d{6}", "DATE", Path(name).name)] = rows
    return tables


class Place(NamedTuple):
    """A folder with a study and demonstrations, and what each command makes of it when nothing disturbs it."""

    start: Path
    made: dict[Command, object]
    seconds: dict[Command, float]

    def copy(self, folder: Path) -> Path:
        shutil.rmtree(folder, ignore_errors=True)
        return shutil.copytree(self.start, folder)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    place = Place(tmp_path_factory.mktemp("start"), {}, {})
    (place.start / "tiny.yaml").write_text(STUDY)
    well("sweep study=tiny.yaml", place.start)
    well(f"{DEMOS} episodes=4 name=few", place.start)
    for command in COMMANDS:
        folder = place.copy(tmp_path_factory.mktemp("undisturbed"))
        ended = kerv(command.words, folder)
        assert ended.code == 0, f"kerv {command.words}: {ended}"
        assert not ended.left, command.words
        place.made[command], place.seconds[command] = result(command.run, folder), ended.seconds
    return place


def rounds(test: str) -> Iterator[random.Random]:
    """A source of random numbers for each round, until the test's share of the time is over; at least one round."""
    began, number = time.monotonic(), 0
    while number == 0 or time.monotonic() < began + SECONDS / 3:
        yield random.Random(f"{SEED} {test} {number}")
        number += 1
    print(f"{test}: {number} rounds, seed {SEED}")


def check_rounds(test: str, wrong_in: Callable[[random.Random], str | None]) -> None:
    wrong = [found for draw in rounds(test) if (found := wrong_in(draw))]
    assert not wrong, f"SEED={SEED}\n" + "\n\n".join(wrong)


def wrong_after(what: str, command: Command, folder: Path, place: Place) -> str | None:
    """Says what does not hold in a folder where a command was disturbed: other commands, or the same one again."""
    for look in LOOKS:
        if (ended := kerv(look, folder)).code or ended.broken:
            return f"{what}, then kerv {look}: {ended}"
    ended = kerv(command.words, folder)
    if ended.code or ended.broken:
        return f"{what}, then again: {ended}"
    same = result(command.run, folder) == place.made[command]
    return None if same else f"{what}, then again: other results"


def test_a_killed_command_is_finished_by_the_same_command(place: Place, tmp_path: Path) -> None:
    def wrong_in(draw: random.Random) -> str | None:
        command, folder = draw.choice(COMMANDS), place.copy(tmp_path / "here")
        number = draw.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGINT))
        after = place.seconds[command] * draw.random() ** 0.5  # rather late: first it imports
        ended, what = (
            kerv(command.words, folder, (after, number)),
            f"kerv {command.words}, {number.name} at {after:.1f} s",
        )
        if ended.left or "Traceback" in ended.err or ended.code not in (0, 130, -number):
            return f"{what}: {ended}"
        return wrong_after(what, command, folder, place)

    check_rounds("kill", wrong_in)


def test_a_disk_that_refuses_writes_gets_one_line(place: Place, tmp_path: Path) -> None:
    def wrong_in(draw: random.Random) -> str | None:
        command, folder, most = draw.choice(COMMANDS), place.copy(tmp_path / "here"), int(10 ** draw.uniform(0, 5.5))
        ended, what = kerv(command.words, folder, most=most), f"kerv {command.words}, files of {most} bytes"
        return f"{what}: {ended}" if ended.broken else wrong_after(what, command, folder, place)

    check_rounds("disk", wrong_in)


def test_a_damaged_file_gets_one_line(place: Place, tmp_path: Path) -> None:
    def wrong_in(draw: random.Random) -> str | None:
        folder, reader = place.copy(tmp_path / "here"), draw.choice(READERS)
        path = draw.choice(sorted(path for path in (folder / "results").rglob("*") if path.is_file()))
        content, noise = path.read_bytes(), draw.randbytes(draw.choice((1, 8, 1000)))
        at = draw.randrange(len(content) + 1)
        path.write_bytes(content[:at] + noise + draw.choice((content[at + len(noise) :], b"")))
        ended = kerv(reader, folder)
        return f"{path.name} with noise from byte {at}, kerv {reader}: {ended}" if ended.broken else None

    check_rounds("damage", wrong_in)
