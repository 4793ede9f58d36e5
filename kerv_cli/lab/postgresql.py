"""Connections to PostgreSQL that end when the server does not answer."""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from typing import Any

import psycopg

STATEMENT_SECONDS = 30
"""Longest time that a statement may take, waiting for other transactions included, seconds."""
IDLE_SECONDS = 20
"""Longest time between two statements of a transaction, seconds. A transaction may hold locks for which others wait."""
CONNECT_SECONDS = 5
"""Longest time to wait for a connection, seconds."""
_SPARE_SECONDS = 5
"""Time that the server has to report its own timeout before it counts as frozen, seconds."""


class Connection(psycopg.Connection[Any]):
    """A connection that is closed if the server is silent for too long, for example because it was stopped."""

    def wait(self, gen: Any, *arguments: Any, **options: Any) -> Any:
        """Wait for the answer to a statement.

        Raises:
            OperationalError: The server has sent nothing for a few seconds more than STATEMENT_SECONDS.
        """
        try:
            return super().wait(_limited(gen, STATEMENT_SECONDS + _SPARE_SECONDS), *arguments, **options)
        except TimeoutError as error:
            self.pgconn.finish()
            raise psycopg.OperationalError(str(error)) from None


def _limited(gen: Any, seconds: float) -> Generator[Any, Any, Any]:
    """Run a generator of psycopg with a time limit, and return its result.

    The generator yields what it waits for. The caller sends 0 while nothing has come from the server.

    Raises:
        TimeoutError: Nothing has come from the server for more than `seconds`.
    """
    try:
        wanted, heard = next(gen), time.monotonic()
        while True:
            if ready := (yield wanted):
                heard = time.monotonic()
            elif time.monotonic() - heard > seconds:
                raise TimeoutError(f"no answer for {seconds:g} s")
            wanted = gen.send(ready)
    except StopIteration as end:
        return end.value


def connect(dialect: object, record: object, arguments: Sequence[Any], options: dict[str, Any]) -> Connection:
    """Return a new connection, for SQLAlchemy's event `do_connect`."""
    limits = f"-c statement_timeout={STATEMENT_SECONDS}s -c idle_in_transaction_session_timeout={IDLE_SECONDS}s"
    ends = {"keepalives_idle": 10, "keepalives_interval": 5, "keepalives_count": 2, "tcp_user_timeout": 20_000}
    return Connection.connect(*arguments, **{**options, "connect_timeout": CONNECT_SECONDS, "options": limits, **ends})
