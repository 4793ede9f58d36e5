"""Read SQLite files that other programs wrote. Queries have limits: a small file can stand for a huge result."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

from kerv_cli.base.files import regular

MOST_STEPS = 20_000_000
"""Steps of SQLite's virtual machine that a connection may take, besides STEPS_PER_BYTE. They take about a second."""
STEPS_PER_BYTE = 20
MOST_VALUE = 2**28
"""Bytes of one value of a SQLite file."""
_EVERY = 10_000


def connect_foreign(path: Path, **options: Any) -> sqlite3.Connection:
    """Return a read-only connection to a SQLite file.

    Queries end in an error after a number of steps that depends on the size of the file.

    Args:
        path: The file.
        options: Options of `sqlite3.connect`.

    Raises:
        OSError: The file is missing or is not a regular file.
        ValueError: The file is cut short, or has views.
    """
    size = regular(path).stat().st_size
    log = path.with_name(f"{path.name}-wal")
    # a file whose writer was killed has its last rows in the log, which an immutable connection does not read
    immutable = "" if log.is_file() and log.stat().st_size else "&immutable=1"
    connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro{immutable}", uri=True, **options)
    try:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_VALUE)
        left = (MOST_STEPS + STEPS_PER_BYTE * size) // _EVERY

        def count() -> bool:
            nonlocal left
            left -= 1
            return left < 0

        connection.set_progress_handler(count, _EVERY)
        connection.execute("PRAGMA trusted_schema=OFF")
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        if immutable and size < pages * connection.execute("PRAGMA page_size").fetchone()[0]:
            raise ValueError(f"only {size} bytes are there")
        views = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'view'")]
        if views:
            raise ValueError(f"it has the view {views[0][:40]}, which could compute anything")
    except BaseException:
        connection.close()
        raise
    return connection
