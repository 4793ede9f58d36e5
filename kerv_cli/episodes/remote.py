"""Ask a policy behind a server for actions, by openpi's protocol (docs/remote.md)."""

from __future__ import annotations

import contextlib
import math
import socket
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from kerv_cli.base.errors import EpisodeError, KervError, UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.base.wire import Message, packed, unpacked
from kerv_cli.engine.chunk import Follower
from kerv_cli.engine.record import PHASES, DecodeRecord, Served
from kerv_cli.episodes.interface import Interface
from kerv_cli.methods.settings import REMOTE, PolicySettings
from kerv_cli.worlds.spec import EnvironmentSpec

ANSWER_S = 600.0  # seconds after which an answer is no longer awaited
CONNECT_S = 10.0  # seconds for the connection and the metadata
RECONNECT_S = 120.0  # seconds for which a server that was there is sought again
WAIT_S = 5.0  # seconds without an answer after which a line says so
ATTEMPTS = 3  # how often an observation is sent if the connection ends before the answer
LARGEST_MESSAGE = 64 * 2**20
TOO_BIG = 1009  # websocket close code: a message was too large
# How often a decoder's first observation is sent. Only the last answer counts: a server's first ones are slow.
WARM_UP = 3

say: Callable[[str], None] = partial(print, file=sys.stderr, flush=True)


class Lost(KervError):
    """The connection ended, or cannot be made."""


class Server:
    """A policy's server, and this process's connection to it.

    Attributes:
        metadata: The server's first message on the first connection, possibly empty. None before.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self.metadata: Message | None = None
        self._stack = contextlib.ExitStack()
        self._connection: Any = None
        self._given_up = False
        self._counted = 0, 0

    def connect(self) -> Message:
        self.close()
        try:
            from websockets.exceptions import ConnectionClosed, InvalidURI, WebSocketException
            from websockets.sync.client import connect
        except ImportError as error:
            raise KervError("policy=remote needs more packages: pip install 'kerv[serve]'") from error
        end = time.monotonic() + CONNECT_S
        try:
            # a server that computes may answer no ping: TCP itself looks after the connection
            options = {"compression": None, "ping_interval": None, "proxy": None, "close_timeout": 1.0}
            made = connect(self.url, open_timeout=CONNECT_S, max_size=LARGEST_MESSAGE, **options)
            self._connection = self._stack.enter_context(made)
            _watch(self._connection.socket)
            first = self._connection.recv(timeout=max(0.1, end - time.monotonic()))
        except InvalidURI as error:
            raise UsageError(f"policy.url={self.url} is no address: write ws://HOST:PORT", "policy.url") from error
        except ConnectionClosed as error:
            raise Lost(f"{self.url} closed the connection{_reason(error)}") from error
        except TimeoutError as error:
            raise Lost(f"{self.url} sends nothing within {CONNECT_S:g} s: serve a policy there") from error
        except (WebSocketException, OSError) as error:
            why = getattr(error, "strerror", None) or error
            raise Lost(f"{self.url} cannot be reached ({why}): start the server there") from error
        if isinstance(first, str):
            raise Lost(f"{self.url} sent a text frame before its metadata: {_last_line(first)}")
        metadata = _decoded(self.url, first)
        self.metadata = metadata if self.metadata is None else self.metadata
        self._counted, self._given_up = (0, 0), False
        return metadata

    def close(self) -> None:
        self._stack.close()
        self._connection = None

    def find(self, since: float) -> None:
        """Connect. If the server was there before, try again until RECONNECT_S after `since` (of time.monotonic)."""
        try:
            metadata = self.reached(since, 0.0 if self.metadata is None else RECONNECT_S)
        except Lost as error:
            raise EpisodeError(str(error)) from error
        if metadata != self.metadata:
            raise KervError(f"{self.url} serves another policy now: its metadata has changed")

    def reached(self, since: float, patience: float) -> Message:
        """Connect and return the metadata. Retry until `patience` s after `since`; if an earlier call failed, never."""
        patience = 0.0 if self._given_up else patience
        is_said = False
        while True:
            try:
                return self.connect()
            except Lost as error:
                if time.monotonic() - since >= patience:
                    self._given_up = True
                    gone = f", for {patience:g} s" if patience else ""
                    raise Lost(f"{error}{gone}") from error
                if not is_said:
                    say(f"kerv: {error}; looking for it again for {patience:g} s")
                is_said = True
                time.sleep(min(1.0, RECONNECT_S / 10))

    def ask(self, message: Message) -> Message:
        if self._connection is None:
            raise Lost(f"{self.url} is not connected")
        from websockets.exceptions import ConnectionClosed

        try:
            self._connection.send(packed(message))
            answer = self._received()
        except ConnectionClosed as error:
            self.close()
            if error.sent is not None and error.sent.code == TOO_BIG and not error.rcvd_then_sent:
                raise EpisodeError(f"{self.url} sent a message above {LARGEST_MESSAGE // 2**20} MiB") from error
            raise Lost(f"{self.url} closed the connection{_reason(error)}") from error
        if isinstance(answer, str):
            raise EpisodeError(f"{self.url} answered with a text frame: {_last_line(answer)}")
        return _decoded(self.url, answer)

    def _received(self) -> bytes | str:
        for waited, seconds in ((0.0, WAIT_S), (WAIT_S, ANSWER_S - WAIT_S)):
            if waited:
                say(f"kerv: waiting for an answer of {self.url}, since {waited:g} s")
            with contextlib.suppress(TimeoutError):
                frame: bytes | str = self._connection.recv(timeout=seconds)
                return frame
        self.close()  # the answer would be taken for the next one's
        raise EpisodeError(f"{self.url} gave no answer within {ANSWER_S:g} s")

    def accounts(self, answer: Message) -> Served:
        """Return the server's own time for this answer, and its drafts and accepted tokens since the last answer."""
        seconds = math.nan
        for key in ("server_timing", "policy_timing"):
            timing = answer.get(key)
            if isinstance(timing, dict) and math.isnan(seconds):
                seconds = _number(timing.get("infer_ms"), math.nan) / 1000.0
        counts = answer.get("spec_decode")
        counts = counts if isinstance(counts, dict) else {}
        drafts, accepted = (int(_number(counts.get(f"num_{one}"), 0)) for one in ("drafts", "accepted_tokens"))
        before, self._counted = self._counted, (drafts, accepted)
        return Served(seconds, max(0, drafts - before[0]), max(0, accepted - before[1]))


def _watch(connection: socket.socket) -> None:
    """Make TCP end a connection if the other machine has been silent for 20 seconds."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 2)):
        if hasattr(socket, name):  # the names are Linux's
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def _decoded(url: str, frame: bytes | str) -> Message:
    try:
        return unpacked(frame)
    except UsageError as error:
        raise EpisodeError(f"{url}: {error}") from error


def _reason(error: Any) -> str:
    frame = error.rcvd or error.sent
    return f": {frame.reason}" if frame and frame.reason else ""


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["it is empty"])[-1][:200]


def _number(value: object, default: float) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf
    return float(value) if is_number else default  # type: ignore[arg-type]


_servers: dict[str, Server] = {}  # settings of one server take turns on one connection: kerv's server has one seat


def server_at(url: str) -> Server:
    return _servers.setdefault(url, Server(url))


def close_servers() -> None:
    while _servers:
        _servers.popitem()[1].close()


def metadata_of(url: str, is_awaited: bool = False) -> Message:
    server = server_at(url)
    try:
        metadata = server.reached(time.monotonic(), RECONNECT_S) if is_awaited else server.connect()
    finally:
        server.close()
    if metadata != server.metadata:
        _servers.pop(url)
    return metadata


class RemoteDecoder(Follower):
    """Asks a server for each chunk of actions."""

    def __init__(self, policy: PolicySettings, interface: Interface, spec: EnvironmentSpec) -> None:
        self.server, self.spec = server_at(policy.url), spec
        known = self.server.metadata
        self.interface = interface.adapted(self.server.connect() if known is None else known, policy.execute)
        super().__init__(spec.actions, self.interface.cameras)
        self._begins, self._asks = True, WARM_UP
        self._sent = self._done = 0  # actions of the last answer, and those that were executed since

    def reset(self, task: str, seed: int, end_effector: np.ndarray) -> None:
        super().reset(task, seed, end_effector)
        self._begins = True

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        super().observe(action, end_effector)
        self._done += 1

    def starts(self, planned: Sequence[np.ndarray], dropped: int) -> None:
        super().starts(planned, dropped)
        self._done = dropped

    def decode(self, observation: Observation) -> DecodeRecord:
        """Return a record with the server's actions. Its `seconds` are the time from the observation to the actions.

        If the connection broke, the server begins the episode anew, and `seconds` counts from the last request on.
        """
        for _ in range(self._asks):
            began, answer = self._answered(observation)
            try:
                actions, sent = self.interface.actions_of(self.spec, answer)
            except EpisodeError as error:
                raise EpisodeError(f"{self.server.url}: {error}") from error
            served = self.server.accounts(answer)
            seconds = time.perf_counter() - began
        self._begins, self._asks, self._sent, self._done = False, 1, sent, 0
        decode = answer.get("decode")
        forwards = int(_number(decode.get("forwards"), 0)) if isinstance(decode, dict) else 0
        phases = dict.fromkeys(PHASES, 0.0) | {"other": seconds}
        return DecodeRecord((), actions, forwards, (), REMOTE, seconds, phases, served=served)

    def _answered(self, observation: Observation) -> tuple[float, Message]:
        for attempt in range(ATTEMPTS):
            began = time.perf_counter()
            message = self.interface.message(self.spec, observation)
            if self.interface.kerv:
                executed = {} if self._begins else {"executed": min(self._done, self._sent)}
                message |= {"reset": self._begins, **executed}
            try:
                return began, self.server.ask(message)
            except Lost as error:
                if attempt == ATTEMPTS - 1:
                    raise EpisodeError(f"{error}, {ATTEMPTS} times at the same observation") from error
                self.server.find(time.monotonic())
                self._begins = True
        raise AssertionError
