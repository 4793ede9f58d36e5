"""End the servers that a library starts together with this process."""

from __future__ import annotations

import contextlib
import os
import secrets
import subprocess
import sys
from collections.abc import Iterator

_MARK = "KERV_GUARD"
_GUARD = """
import os, select, signal, sys
def status(process):
    try:
        with open(f"/proc/{process}/stat") as file:
            fields = file.read().rpartition(")")[2].split()
        return int(fields[1]), int(fields[19])  # parent, start
    except OSError:  # it has ended
        return None, None

def look():
    every = {process: status(process) for process in map(int, filter(str.isdigit, os.listdir("/proc")))}
    before = 0
    while before < len(below):
        before = len(below)
        here = {parent for parent, start in below.items() if every.get(parent, (0, 0))[1] == start}
        below.update({process: start for process, (parent, start) in every.items() if parent in here})

below = {int(sys.argv[1]): status(sys.argv[1])[1]}  # process -> its start; descendants, also those of ended parents
look()
old = set(below)  # of what was there before: it stays
while not select.select([sys.stdin], [], [], 1)[0]:
    look()
def marked(process):
    try:
        with open(f"/proc/{process}/environ", "rb") as file:
            return mark in file.read()
    except OSError:
        return False

mark = sys.argv[2].encode()  # in the environment of what was started since the last look
look()
every = map(int, filter(str.isdigit, os.listdir("/proc")))
below.update({process: status(process)[1] for process in every if marked(process)})
for process, start in below.items():
    if process != os.getpid() and status(process)[1] == start and (process not in old or marked(process)):
        os.kill(process, signal.SIGKILL)
"""


@contextlib.contextmanager
def guard() -> Iterator[None]:
    """End the processes that the block starts, and their children, with the block or with this process.

    Another process does so, even if this one is killed. It needs /proc.
    """
    mark = secrets.token_hex(8)
    command = [sys.executable, "-S", "-c", _GUARD, str(os.getpid()), mark]
    with subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True):  # either end closes the pipe
        os.environ[_MARK] = mark
        try:
            yield
        finally:
            os.environ.pop(_MARK, None)
