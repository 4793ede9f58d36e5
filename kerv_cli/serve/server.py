"""The policy server: answers observations with actions over websockets, one client at a time (docs/serving.md).

The protocol is openpi's: after the handshake the server sends its metadata; then every binary frame is an observation
and is answered by a binary frame, or by a text frame that says what was wrong with it. The connection stays open after
an error, and the server after any client.
"""

from __future__ import annotations

import contextlib
import http
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.engine.decoder import Decoder
from kerv_cli.serve.session import Interface, Session
from kerv_cli.serve.wire import packed, unpacked

Log = Callable[[str], None]
HEALTH = "/healthz"
BUSY, GONE = 1013, 1001  # websocket close codes: try again later, going away


@dataclass
class Latencies:
    """Milliseconds of every answer, for the log. decode: inference time; whole: from the message's arrival to the
    answer's end."""

    decode: list[float] = field(default_factory=list)
    whole: list[float] = field(default_factory=list)

    def add(self, decode: float, whole: float) -> None:
        """One answer."""
        self.decode.append(decode)
        self.whole.append(whole)

    def __str__(self) -> str:
        parts = [f"{len(self.whole)} answers"]
        for name, values in (("decode", self.decode), ("answer", self.whole)):
            if values:
                p50, p95 = np.percentile(values, [50, 95])
                parts.append(f"{name} p50 {p50:.1f} p95 {p95:.1f} worst {max(values):.1f} ms")
        return ", ".join(parts)


class PolicyServer:
    """Serves one decoder. log: called with every line. every: answers between two lines of latencies; 0: none.
    megabytes: largest message."""

    def __init__(self, interface: Interface, decoder: Decoder, log: Log, megabytes: int = 16, every: int = 100) -> None:
        self.interface, self.decoder, self.log = interface, decoder, log
        self.megabytes, self.every = megabytes, every
        self.busy = threading.Lock()
        self.connection: Any = None

    @contextlib.contextmanager
    def listening(self, host: str, port: int) -> Iterator[Any]:
        """The listening server, with the methods `serve_forever()` and `shutdown()`. port 0: a free one.

        Raises:
            UsageError: the address cannot be used. KervError: the package websockets is missing.
        """
        try:
            from websockets.sync.server import serve
        except ImportError as error:
            raise KervError("the policy server needs more packages: pip install 'kerv[serve]'") from error
        try:
            server = serve(
                self.handle,
                host,
                port,
                compression=None,
                max_size=self.megabytes * 2**20,
                process_request=_health,
                ping_interval=None,  # a slow decode is no dead connection
            )
        except OSError as error:
            raise UsageError(f"cannot listen on {host}:{port}: {error.strerror or error}") from error
        with server:
            yield server
        if self.connection is not None:
            self.connection.close(GONE, "the server stops")

    def handle(self, connection: Any) -> None:
        """One connection, from its handshake to its end."""
        from websockets.exceptions import ConnectionClosed

        who = str(connection.remote_address)
        if not self.busy.acquire(blocking=False):
            self.log(f"{who} refused: another client is being served")
            with contextlib.suppress(ConnectionClosed):
                connection.close(BUSY, "another client is being served: try again later")
            return
        latencies = Latencies()
        try:
            self.log(f"{who} connected")
            self.connection = connection
            session = Session(self.interface, self.decoder)
            connection.send(packed(self.interface.metadata(self.decoder.steps)))
            before: float | None = None
            while True:
                message = connection.recv()
                before = self.reply(connection, session, message, latencies, before)
        except ConnectionClosed as error:
            reason = error.rcvd.reason if error.rcvd and error.rcvd.reason else ""
            sent = f": {error.sent.reason}" if error.sent and error.sent.reason and not reason else ""
            self.log(f"{who} disconnected{sent}; {latencies}")
        finally:
            self.connection = None
            self.busy.release()

    def reply(
        self, connection: Any, session: Session, message: Any, latencies: Latencies, before: float | None
    ) -> float | None:
        """Answers one frame -> milliseconds that the answer took, or `before` after an error. before: milliseconds of
        the last answer, which the client gets as `prev_total_ms`."""
        began = time.perf_counter()
        try:
            if not isinstance(message, bytes):
                raise UsageError("a text frame came, observations are binary (msgpack)")
            answer = session.answer(unpacked(message))
        except KervError as error:
            self.refuse(connection, str(error))
            return before
        except Exception as error:  # noqa: BLE001 - whatever a client sends, the server goes on
            self.refuse(connection, f"internal error, {type(error).__name__}: {str(error)[:200]}")
            return before
        inference = answer["policy_timing"]["infer_ms"]
        timing = {"infer_ms": inference} | ({"prev_total_ms": before} if before is not None else {})
        connection.send(packed({**answer, "server_timing": timing}))
        whole = 1000 * (time.perf_counter() - began)
        latencies.add(inference, whole)
        if self.every and len(latencies.whole) % self.every == 0:
            self.log(str(latencies))
        return whole

    def refuse(self, connection: Any, reason: str) -> None:
        """Tells client and log what was wrong, in one line."""
        line = " ".join(reason.split())
        self.log(f"{connection.remote_address} error: {line}")
        connection.send(f"kerv: {line}")


def _health(connection: Any, request: Any) -> Any:
    """Answers GET /healthz without a handshake."""
    return connection.respond(http.HTTPStatus.OK, "OK\n") if request.path == HEALTH else None
