"""Serve clients over websockets, whatever their protocol (docs/serving.md).

This module limits the number of clients, drops silent ones and reports errors. After an error the connection stays
open. No client can stop the server.
"""

from __future__ import annotations

import contextlib
import errno
import http
import logging
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.registry import load
from kerv_cli.serve.policy import Conversation, Policy
from kerv_cli.serve.settings import ServeSettings

try:
    import msgpack  # noqa: F401 - the protocols need it
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request, Response
    from websockets.sync.server import ServerConnection, serve
except ImportError as error:
    raise KervError("the policy server needs more packages: pip install 'kerv[serve]'") from error

PROTOCOLS = {"openpi": "kerv_cli.serve.openpi:OpenPi", "vla_eval": "kerv_cli.serve.vla_eval:VlaEval"}
HEALTH = ("/healthz", "/health")
BUSY, GONE = 1013, 1001  # websocket close codes: 1013 means "try again later", 1001 "going away"
LARGEST_MESSAGE = 16 * 2**20  # largest size of a client's message, in bytes
LONGEST = 500  # largest length of an error message, in characters. An error message may quote long texts, so it is cut.
# Seconds for which a new client waits until another client leaves. Its own old connection may still be closing.
PATIENCE = 1.0
FAREWELL = 2.0  # seconds for which the server waits for one client to close its connection
# Seconds for which a stopping server waits for answers that are being computed, and for clients to disconnect
LAST_ANSWERS = 0.5


class PolicyServer:
    """Serve one policy to clients."""

    def __init__(self, policy: Policy, settings: ServeSettings, log: Callable[[str], None]) -> None:
        self.policy, self.settings, self.log = policy, settings, log
        self.protocol: type[Conversation] = load(PROTOCOLS[settings.protocol])
        self._seats = threading.BoundedSemaphore(self.protocol.seats)
        self._connections: set[ServerConnection] = set()

    @contextlib.contextmanager
    def listening(self, host: str, port: int) -> Iterator[int]:
        """Serve clients until the end of the `with` block. Yield the port.

        All threads are daemons. No client can delay the end by more than LAST_ANSWERS seconds, even during the client's
        handshake.
        """
        try:
            server = serve(
                self.handle,
                host,
                port,
                compression=None,
                max_size=LARGEST_MESSAGE,
                process_request=_health,
                origins=[None, *self.settings.origins],  # only web pages send an origin
                ping_interval=self.protocol.ping_s,
                ping_timeout=self.protocol.ping_s,
                close_timeout=FAREWELL,
                logger=_one_line_logger(self.log),
            )
        except OSError as error:
            remedy = ": port=0 takes a free one" if error.errno == errno.EADDRINUSE else ""
            raise UsageError(f"cannot listen on {host}:{port}: {error.strerror or error}{remedy}") from error
        port = server.socket.getsockname()[1]
        _start(server.serve_forever)
        try:
            yield port
        finally:
            for connection in list(self._connections):
                _start(connection.close, GONE, "the server stops")
            _start(server.shutdown)
            end = time.monotonic() + LAST_ANSWERS
            while self._connections and time.monotonic() < end:
                time.sleep(0.02)

    def handle(self, connection: ServerConnection) -> None:
        """Serve one client until it disconnects. Runs in the client's thread."""
        who = str(connection.remote_address)
        if not self._seats.acquire(timeout=PATIENCE):
            count = self.protocol.seats
            full = "another client is being served" if count == 1 else f"{count} clients are served"
            self.log(f"{who} refused: {full}")
            connection.close(BUSY, f"{full}: try again later")
            return
        self._connections.add(connection)
        times: list[float] = []
        why = ""
        try:
            self.log(f"{who} connected")
            self._talk(connection, who, times)
        except ConnectionClosed as error:
            frame = error.rcvd or error.sent
            why = f": {frame.reason}" if frame and frame.reason else ""
        except TimeoutError:
            why = f": no message for {self.protocol.idle_s:g} s"
            # close in a thread, because the client may never answer
            _start(connection.close, GONE, why[2:])
        finally:
            self._connections.discard(connection)
            self._seats.release()
            self.log(f"{who} disconnected{why}; {_summary(times)}")

    def _talk(self, connection: ServerConnection, who: str, times: list[float]) -> None:
        with contextlib.closing(self.protocol(self.policy)) as conversation:
            if (greeting := conversation.greeting()) is not None:
                connection.send(greeting)
            while True:
                frame, began = connection.recv(timeout=self.protocol.idle_s), time.perf_counter()
                try:
                    answer = conversation.answer(frame)
                except Exception as error:  # noqa: BLE001 - whatever a client sends, the server goes on
                    internal = f"internal error, {type(error).__name__}: {str(error)[:200]}"
                    line = " ".join((str(error) if isinstance(error, KervError) else internal).split())[:LONGEST]
                    self.log(f"{who} error: {line}")
                    connection.send(conversation.fault(line))
                    continue
                if answer is not None:
                    connection.send(answer)
                    conversation.last_ms = 1000 * (time.perf_counter() - began)
                    times.append(conversation.last_ms)


def _start(function: Callable[..., object], *arguments: object) -> None:
    threading.Thread(target=function, args=arguments, daemon=True).start()


def _summary(times: list[float]) -> str:
    if not times:
        return "0 answers"
    p50, p95 = np.percentile(times, [50, 95])
    return f"{len(times)} answers, p50 {p50:.1f} p95 {p95:.1f} worst {max(times):.1f} ms"


def _one_line_logger(log: Callable[[str], None]) -> logging.Logger:
    class Lines(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            log(f"a connection failed: {record.exc_info[1] if record.exc_info else record.getMessage()}"[:LONGEST])

    logger = logging.Logger("kerv.serve", logging.ERROR)
    logger.addHandler(Lines())
    return logger


def _health(connection: ServerConnection, request: Request) -> Response | None:
    return connection.respond(http.HTTPStatus.OK, "OK\n") if request.path in HEALTH else None
