"""Runs kerv's commands in forks of one interpreter that has loaded what they import, with faults of the disk."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import mmap
import os
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

PATIENCE = 5.0  # seconds in which the processes of a command that ended have to end
KINDS = ("count", "kill", "torn", "no space", "broken", "full", "kill first", "slow", "clock", "memory")
"""What becomes of a call: nothing; its process is killed before it; half of it is written and its process killed;
ENOSPC; EIO; ENOSPC from there on; the command's first process is killed, whichever made the call; calls take 50 ms
from there on; the clock jumps by 25 hours, forth or back. As in torture.c. Memory: not a call's, the command gets that
many MiB more than it has when it begins."""
ENDING, HINDERING = KINDS[1:7], KINDS[7:]
_CONTROL = struct.Struct("iiii1000s")


class Fault(NamedTuple):
    """A fault of the disk. at: number of the call, from 1; 0: none."""

    kind: str = "count"
    at: int = 0


NONE = Fault()


class Ended(NamedTuple):
    """How a command ended. code: its exit code, negative for a signal. cpu, wall: seconds. memory: MiB at most. calls:
    changes of files, tried ones among them. struck: whether the fault came. left: processes that outlived it."""

    code: int
    cpu: float
    wall: float
    memory: float
    text: str
    calls: int
    struck: bool
    left: int


def preload() -> bool:
    """Compiles torture.c and starts this program again with it -> whether it runs with it; False: no compiler here."""
    if "torture" in os.environ.get("LD_PRELOAD", ""):
        return True
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None or sys.platform != "linux":
        return False
    library = Path(tempfile.mkdtemp(prefix="kerv-torture-")) / "torture.so"
    source = Path(__file__).with_name("torture.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", library, source, "-ldl"], check=True)
    os.environ["LD_PRELOAD"] = str(library)
    os.execv(sys.executable, [sys.executable, *sys.argv])


def run(
    words: list[str],
    limit: float,
    fault: Fault = NONE,
    log: Path | None = None,
    meanwhile: Callable[[Callable[[], str]], None] | None = None,
) -> Ended:
    """Runs a command in a fork of this process, in its own session, in the present folder.

    limit: seconds after which it is killed as one that hangs. log: gets the names of the modules that it loaded.
    meanwhile: is called with what reads the command's output so far; then the command gets a SIGTERM.
    """
    began, status = time.monotonic(), None
    with tempfile.TemporaryFile() as output, tempfile.NamedTemporaryFile() as file:
        file.truncate(mmap.PAGESIZE)
        control = mmap.mmap(file.fileno(), mmap.PAGESIZE)
        child = os.fork()
        if child == 0:
            root = os.path.realpath(os.getcwd()).encode()
            control[: _CONTROL.size] = _CONTROL.pack(0, fault.at, KINDS.index(fault.kind), os.getpid(), root)
            _be_command(words, fault, output.fileno(), file.name, log)
        try:
            if meanwhile is not None:
                meanwhile(lambda: os.pread(output.fileno(), 2**20, 0).decode(errors="replace"))
        finally:
            if meanwhile is not None:
                os.kill(child, signal.SIGTERM)
        until = time.monotonic() + limit
        while status is None:
            ended, code, used = os.wait4(child, os.WNOHANG)
            status = code if ended else None
            if not ended and time.monotonic() > until:
                os.kill(child, signal.SIGKILL)
            time.sleep(0.02)
        wall, left = time.monotonic() - began, _left(child)
        calls = struct.unpack_from("i", control)[0]
        output.seek(0)
        text = output.read().decode(errors="replace")
    cpu, memory = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
    struck = 0 < fault.at <= calls or fault.kind == "memory"
    return Ended(os.waitstatus_to_exitcode(status), cpu, wall, memory, text, calls, struck, left)


def _left(session: int) -> int:
    """Waits for the processes of a session -> how many did not end; they are killed."""
    until = time.monotonic() + PATIENCE
    while (there := _members(session)) and time.monotonic() < until:
        time.sleep(0.05)
    for process in there:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    return len(there)


def _members(session: int) -> list[int]:
    """The live processes of a session."""
    members = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, _, its_session = path.read_text().rpartition(")")[2].split()[:4]
            members += [int(path.parent.name)] if int(its_session) == session and state != "Z" else []
    return members


def _be_command(words: list[str], fault: Fault, output: int, control: str, log: Path | None) -> None:
    """The child: it is the command from here on, and ends."""
    os.setsid()
    if fault.kind == "memory":
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, 2 * [pages * mmap.PAGESIZE + fault.at * 2**20])
    os.dup2(output, 1)
    os.dup2(output, 2)
    code = 0
    os.environ["KERV_TORTURE"] = control  # for the processes that it starts
    if "LD_PRELOAD" in os.environ:
        ctypes.CDLL(None).torture_map(control.encode())
    try:
        from kerv_cli.cli.app import app

        app(words)
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 98 if error.code else 0
    except BaseException:  # noqa: BLE001 - told apart by the exit code
        traceback.print_exc()
        code = 99
    if log is not None:
        log.write_text("\n".join(sys.modules))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def learn(log: Path) -> None:
    """Imports what a command loaded, by its log, so that forks need not."""
    for name in log.read_text().splitlines():
        with contextlib.suppress(Exception):  # a name that stands for something else, as `six.moves` does
            importlib.import_module(name)
    gc.collect()
    gc.freeze()  # forks share these objects as long as nobody touches them
