"""A PostgreSQL server of this machine, for tests."""

import contextlib
import os
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def running() -> Iterator[str]:
    """Start a server for a `with` block. Yield its URL, without the name of a database."""
    programs = sorted(Path("/usr/lib/postgresql").glob("*/bin"))
    if not programs:
        raise FileNotFoundError("no PostgreSQL here: apt-get install postgresql")
    user: dict[str, Any] = {"user": 65534, "group": 65534, "extra_groups": []} if os.geteuid() == 0 else {}  # nobody
    with tempfile.TemporaryDirectory(prefix="kerv-postgresql-") as folder, socket.socket() as free:
        if user:
            os.chown(folder, user["user"], user["group"])
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()

        def run(program: str, *words: str) -> None:
            command = [programs[-1] / program, "-D", f"{folder}/data", *words]
            subprocess.run(command, check=True, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, **user)

        run("initdb", "-U", "kerv", "-A", "trust", "-E", "UTF8", "--locale=C", "--no-sync")
        listening = f"-p {port} -c listen_addresses=127.0.0.1 -c unix_socket_directories= -c fsync=off"
        run("pg_ctl", "start", "-w", "-l", f"{folder}/log", "-o", listening)
        try:
            yield f"postgresql://kerv@127.0.0.1:{port}"
        finally:
            run("pg_ctl", "stop", "-w", "-m", "immediate")
