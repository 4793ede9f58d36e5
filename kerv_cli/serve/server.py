"""The server: seats, silence and errors of clients over websockets, whatever their protocol (docs/serving.md).

A connection stays open after an error, and the server after any client.
"""

from __future__ import annotations

import abc
import contextlib
import http
import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.registry import load
from kerv_cli.serve.policy import Policy
from kerv_cli.serve.session import Session
from kerv_cli.serve.settings import ServeSettings

if TYPE_CHECKING:
    from websockets.http11 import Request, Response
    from websockets.sync.server import Server, ServerConnection

Log = Callable[[str], None]
PROTOCOLS = {"openpi": "kerv_cli.serve.openpi:OpenPi", "vla_eval": "kerv_cli.serve.vla_eval:VlaEval"}
HEALTH = ("/healthz", "/health")
BUSY, GONE = 1013, 1001
"""Websocket close codes: try again later; going away."""
LARGEST_MESSAGE = 16 * 2**20
"""Bytes of a message."""
LONGEST = 500
"""Letters of an error: a client's own words may be longer."""
PATIENCE = 1.0
"""Seconds that a newcomer waits for a seat: one that reconnects may be ahead of its own farewell."""
FAREWELL = 2.0
"""Seconds that a closing connection is waited for."""


@dataclass(frozen=True)
class Reply:
    """The answer to a frame. seconds: of inference, NaN where it was not timed; None: nothing was decoded for it."""

    frame: bytes
    seconds: float | None = None


class Conversation(abc.ABC):
    """One client, in the words of its protocol. seats: clients at a time. A client is gone after `ping_s` seconds
    without an answer to a ping (None: no pings are sent), or after `idle_s` without a message."""

    seats: int
    ping_s: float | None
    idle_s: float

    def __init__(self, policy: Policy, session: Session) -> None:
        self.policy, self.session = policy, session

    def greeting(self) -> bytes | None:
        """What the server says first; None: the client speaks first."""
        return None

    @abc.abstractmethod
    def answer(self, frame: bytes | str) -> Reply | None:
        """The answer to a frame; None: it needs none. Raises KervError: what is wrong with it."""

    @abc.abstractmethod
    def fault(self, line: str) -> bytes | str:
        """The frame that tells the client what was wrong with the last one."""

    def note_latency(self, milliseconds: float) -> None:  # noqa: B027 - not every protocol tells it
        """The last decode took so long, from the frame's arrival to the answer's end."""


@dataclass
class Latencies:
    """Milliseconds of every decode, for the log. decode: inference time; whole: from the message's arrival to the
    answer's end."""

    decode: list[float] = field(default_factory=list)
    whole: list[float] = field(default_factory=list)

    def add(self, decode: float, whole: float) -> None:
        """One answer. decode: NaN where it was not timed."""
        if not math.isnan(decode):
            self.decode.append(decode)
        self.whole.append(whole)

    def __str__(self) -> str:
        parts = [f"{len(self.whole)} answers"]
        for name, values in (("decode", self.decode), ("answer", self.whole)):
            if values:
                p50, p95 = np.percentile(values, [50, 95])
                parts.append(f"{name} p50 {p50:.1f} p95 {p95:.1f} worst {max(values):.1f} ms")
        return ", ".join(parts)


class Seats:
    """The connections that are served."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._changed = threading.Condition()
        self._seated: list[ServerConnection] = []

    def take(self, connection: ServerConnection) -> bool:
        """Whether the connection gets a seat."""
        with self._changed:
            if not self._changed.wait_for(lambda: len(self._seated) < self.count, PATIENCE):
                return False
            self._seated.append(connection)
            return True

    def leave(self, connection: ServerConnection) -> None:
        """Frees the connection's seat."""
        with self._changed:
            self._seated.remove(connection)
            self._changed.notify_all()

    @property
    def connections(self) -> list[ServerConnection]:
        """The connections that have a seat."""
        with self._changed:
            return list(self._seated)


class PolicyServer:
    """Serves one policy. log: called with every line."""

    def __init__(self, policy: Policy, settings: ServeSettings, log: Log) -> None:
        self.policy, self.settings, self.log = policy, settings, log
        self.protocol: type[Conversation] = load(PROTOCOLS[settings.protocol])
        self.seats = Seats(self.protocol.seats)

    @contextlib.contextmanager
    def listening(self, host: str, port: int) -> Iterator[Server]:
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
                max_size=LARGEST_MESSAGE,
                process_request=_health,
                origins=[None, *self.settings.origins],  # a web page names its own
                ping_interval=self.protocol.ping_s,
                ping_timeout=self.protocol.ping_s,
                close_timeout=FAREWELL,
                logger=_lines(self.log),
            )
        except OSError as error:
            raise UsageError(f"cannot listen on {host}:{port}: {error.strerror or error}") from error
        with server:
            yield server
        for connection in self.seats.connections:
            connection.close(GONE, "the server stops")

    def handle(self, connection: ServerConnection) -> None:
        """One connection, from its handshake to its end."""
        from websockets.exceptions import ConnectionClosed

        who = _address(connection)
        if not self.seats.take(connection):
            count = self.seats.count
            full = "another client is being served" if count == 1 else f"{count} clients are served"
            self.log(f"{who} refused: {full}")
            with contextlib.suppress(ConnectionClosed):
                connection.close(BUSY, f"{full}: try again later")
            return
        latencies, why = Latencies(), ""
        try:
            self.log(f"{who} connected")
            self._talk(connection, latencies)
        except ConnectionClosed as error:
            frame = error.rcvd or error.sent
            why = f": {frame.reason}" if frame and frame.reason else ""
        except TimeoutError:
            why = f": no message for {self.protocol.idle_s:g} s"
            # it may never answer, and nobody waits for it
            threading.Thread(target=connection.close, args=(GONE, why[2:]), daemon=True).start()
        finally:
            self.seats.leave(connection)
            self.log(f"{who} disconnected{why}; {latencies}")

    def _talk(self, connection: ServerConnection, latencies: Latencies) -> None:
        """Answers frames until the connection ends. Raises ConnectionClosed, and TimeoutError for silence."""
        with self.policy.session() as session:
            session.say = lambda line: self.log(f"{_address(connection)} {line}")
            conversation = self.protocol(self.policy, session)
            if (greeting := conversation.greeting()) is not None:
                connection.send(greeting)
            while True:
                frame = connection.recv(timeout=self.protocol.idle_s)
                self.reply(connection, conversation, frame, latencies)

    def reply(
        self, connection: ServerConnection, conversation: Conversation, frame: bytes | str, latencies: Latencies
    ) -> None:
        """Answers one frame, or says in one line to client and log what was wrong with it."""
        began = time.perf_counter()
        try:
            reply = conversation.answer(frame)
        except Exception as error:  # noqa: BLE001 - whatever a client sends, the server goes on
            internal = f"internal error, {type(error).__name__}: {str(error)[:200]}"
            line = " ".join((str(error) if isinstance(error, KervError) else internal).split())[:LONGEST]
            self.log(f"{_address(connection)} error: {line}")
            connection.send(conversation.fault(line))
            return
        if reply is None:
            return
        connection.send(reply.frame)
        if reply.seconds is None:
            return
        whole = 1000 * (time.perf_counter() - began)
        conversation.note_latency(whole)
        latencies.add(1000 * reply.seconds, whole)
        if self.settings.log_every and len(latencies.whole) % self.settings.log_every == 0:
            self.log(str(latencies))


def _address(connection: ServerConnection) -> str:
    """The client's address, for the log."""
    try:
        return str(connection.remote_address)
    except OSError:
        return "a client that has left"


def _lines(log: Log) -> logging.Logger:
    """A logger for websockets, which writes every error as one line of the log, without a traceback."""

    class Lines(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            log(f"a connection failed: {record.exc_info[1] if record.exc_info else record.getMessage()}"[:LONGEST])

    logger = logging.Logger("kerv.serve", logging.ERROR)
    logger.addHandler(Lines())
    return logger


def _health(connection: ServerConnection, request: Request) -> Response | None:
    """Answers GET /healthz without a handshake."""
    return connection.respond(http.HTTPStatus.OK, "OK\n") if request.path in HEALTH else None
