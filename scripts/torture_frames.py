"""Damaged frames and connections for torture.py: what broken or hostile clients send to `kerv serve`."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import random
import socket
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import numpy as np

ANSWERS = 20.0
"""Seconds after which a server that says nothing hangs."""
PING, IDLE = 1.0, 3.0
"""Settings of the server: with openpi a client that answers no ping loses its seat after 2 PING, with vla_eval one that
says nothing after IDLE."""
SLACK = 5.0
"""Seconds more that a busy machine gets to free a seat."""
TEXT, BINARY, CLOSE, PING_CODE, PONG = 1, 2, 8, 9, 10
POLICY = "seeing"
FRAMES, CONNECTED = 40, 8
"""Messages and connections that a server gets."""
SERVE = f"serve policy=vision policy.target={POLICY} port=0 ping_s={PING} idle_s={IDLE} max_mb=1 seats=1 log_every=0"


class Lost(Exception):
    """The server ended the connection."""


class Client:
    """A websocket client that may break every rule."""

    def __init__(self, port: int, shakes: bool = True) -> None:
        """shakes: whether it begins with the handshake. Raises Lost: refused."""
        self.raw = socket.create_connection(("127.0.0.1", port), ANSWERS)
        self.buffer = b""
        if shakes:
            self.raw.sendall(handshake())
            while b"\r\n\r\n" not in self.buffer:
                self._receive()
            head, _, self.buffer = self.buffer.partition(b"\r\n\r\n")
            if b" 101 " not in head:
                raise Lost(head.decode())

    def _receive(self) -> None:
        try:
            new = self.raw.recv(65536)
        except TimeoutError:
            raise
        except OSError as error:
            raise Lost(str(error)) from error
        if not new:
            raise Lost("it closed the connection")
        self.buffer += new

    def _take(self, count: int) -> bytes:
        while len(self.buffer) < count:
            self._receive()
        taken, self.buffer = self.buffer[:count], self.buffer[count:]
        return taken

    def send(self, content: bytes, kind: int = BINARY, **changes: Any) -> None:
        """Sends a frame; see `framed`. Raises Lost: the server ended the connection."""
        try:
            self.raw.sendall(framed(content, kind, **changes))
        except TimeoutError:
            raise
        except OSError as error:
            raise Lost(str(error)) from error

    def receive(self) -> bytes | str:
        """The next message; pings are answered. Raises Lost, and TimeoutError: none came."""
        while True:
            first, size = self._take(2)
            if size == 126:
                size = int.from_bytes(self._take(2))
            elif size == 127:
                size = int.from_bytes(self._take(8))
            content = self._take(size)
            kind = first & 15
            if kind == CLOSE:
                raise Lost(content[2:].decode(errors="replace"))
            if kind == PING_CODE:
                self.send(content, PONG)
            elif kind in (TEXT, BINARY):
                return content.decode() if kind == TEXT else content

    def leave(self, at_once: bool = False) -> None:
        """Closes. at_once: with a reset, as a machine whose power fails and that comes back."""
        with contextlib.suppress(OSError):
            if at_once:
                self.raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            else:
                self.raw.sendall(framed(struct.pack(">H", 1000), CLOSE))
        self.raw.close()


def handshake(extra: bytes = b"") -> bytes:
    """The request that begins a connection."""
    key = base64.b64encode(os.urandom(16))
    return (
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: " + key + b"\r\n" + extra + b"\r\n"
    )


def framed(content: bytes, kind: int = BINARY, end: int = 0x80, masked: bool = True, size: int | None = None) -> bytes:
    """A frame. end: its highest bits. size: what it says of its size, where that is a lie."""
    size = len(content) if size is None else size
    bit = 0x80 if masked else 0
    head = bytes([end | kind])
    head += (
        bytes([bit | size])
        if size < 126
        else bytes([bit | 126]) + struct.pack(">H", size)
        if size < 65536
        else (bytes([bit | 127]) + struct.pack(">Q", size))
    )
    return head + (bytes(4) if masked else b"") + content  # a mask of zeros leaves the content as it is


# --- messages of the two protocols


class Dialect(NamedTuple):
    """A protocol. good: message -> an observation that begins an episode, as messages of which the last is answered.
    first: whether the server speaks first. answered: whether every message is."""

    name: str
    first: bool
    good: Callable[[dict[str, Any], int], list[dict[str, Any]]]
    array: Callable[[np.ndarray], Any]
    actions: Callable[[dict[Any, Any]], Any]


def openpi_good(seen: dict[str, Any], number: int) -> list[dict[str, Any]]:
    """An observation."""
    image = {f"observation/{seen['camera']}": openpi_array(seen["image"])}
    return [{**image, "observation/state": openpi_array(seen["state"]), "prompt": "press it", "reset": True}]


def openpi_array(value: np.ndarray) -> dict[bytes, Any]:
    """As openpi's client writes it."""
    return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": list(value.shape)}


def vla_good(seen: dict[str, Any], number: int) -> list[dict[str, Any]]:
    """Hello, the begin of an episode, an observation."""
    payloads = {
        "hello": {"protocol_version": 1, "harness_version": "0", "capabilities": {}},
        "episode_start": {
            "task": {"name": seen["task"], "seed": 3, "episode_idx": 0},
            "recording": {"eval_id": "tortured", "eid": str(number)},
        },
        "observation": {
            "images": {seen["camera"]: vla_array(seen["image"])},
            "state": vla_array(seen["state"]),
            "task_description": "press it",
        },
    }
    return [{"type": kind, "payload": payload, "seq": number, "timestamp": 0.0} for kind, payload in payloads.items()]


def vla_array(value: np.ndarray) -> dict[str, Any]:
    """As vla-eval writes it."""
    return {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str, "shape": list(value.shape)}


DIALECTS = (
    Dialect("openpi", True, openpi_good, openpi_array, lambda answer: answer["actions"]),
    Dialect("vla_eval", False, vla_good, vla_array, lambda answer: answer["payload"]["actions"]),
)


def seen_by(results: Path, task: str) -> dict[str, Any]:
    """What an observation holds that the policy accepts: the middle of its range, a grey image."""
    target = json.loads((results / "artifacts/target" / POLICY / "target.json").read_text())
    size = target["settings"]["image_size"]
    return {
        "camera": target["cameras"][0],
        "image": np.full((size, size, 3), 127, np.uint8),
        "state": np.mean(target["state_range"], axis=0)[: len(target["observation"]["proprioception"])],
        "task": task,
    }


# --- damaged messages

DEEP = 100_000
HEADS: dict[str, bytes] = {
    "nested lists": b"\x91" * DEEP + b"\xc0",
    "nested maps": b"\x81\xa1a" * DEEP + b"\xc0",
    "a list of 4 billion": b"\xdd\xff\xff\xff\xff",
    "a map of 4 billion": b"\xdf\xff\xff\xff\xff",
    "a text of 4 GB": b"\xdb\xff\xff\xff\xff",
    "bytes of 4 GB": b"\xc6\xff\xff\xff\xff",
    "an extension": b"\xc7\x08\x05" + bytes(8),
    "a time": b"\xd7\xff" + bytes(8),
    "a time too late": b"\xc7\x0c\xff\xff\xff\xff\xff" + b"\x7f" * 8,
    "no UTF-8": b"\x81\xa1\xff\xa1\xff",
    "keys twice": b"\x82\xa6prompt\xa1a\xa6prompt\xa1b",
    "a list as key": b"\x81\x90\xc0",
    "a number as key": b"\x81\x01\xc0",
    "two values": b"\xc0\xc0",
    "empty": b"",
    "never used": b"\xc1",
}
NUMBERS: tuple[Any, ...] = (float("nan"), float("inf"), -float("inf"), 1e39, -1e308, 5e-324, 2**64 - 1, -(2**63), -1, 0)
STRANGE: tuple[Any, ...] = (
    *NUMBERS, None, True, "", "x", "\0", "a" * 100_000, "\n\r\t", "../../x", "\ud7ff", b"", b"x" * 1000,
    [], {}, [[]], [None], ["x"] * 1000, [0.0] * 4, [[0.0] * 4], [0.0] * 20_000, {"a": {}}, {"": ""}, {"payload": {}},
)  # fmt: skip


def png(width: int, height: int, content: bytes = b"") -> bytes:
    """A PNG file that says that it is of that size."""

    def part(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", zlib.compress(content)) + part(b"IEND", b"")


IMAGES = (
    png(100_000, 100_000), png(4096, 4096), png(1, 1, bytes(4)), png(0, 0), png(2, 2)[:30], b"",
    b"\xff\xd8\xff\xe0" + bytes(50), b"GIF89a" + bytes(20), b"II*\0" + bytes(100),
)  # fmt: skip
TYPES = ("f8", "f4", "f2", "i8", "u1", "?", "c16", "S4", "U4", "M8[s]", "V8", ">f8", ">i2")
DTYPES = ("|O", "O", "<f16", "x", "", None, 3, "f8,f8", "<f8" * 1000, "(3,)f8", "V0", "m8[D]", ["f8"], "S0")
SHAPES = ([-1], [2**40], [2**62, 4], [1.5], ["a"], None, 3, [True], [2**63], [[1]])


def strange_array(draw: random.Random, dialect: Dialect) -> Any:
    """An array that is wrong, or an image, in the protocol's own form."""
    size, plain = draw.choice((1, 3, 4, 39)), draw.random() < 0.5
    with np.errstate(all="ignore"):
        numbers = np.array(draw.choices(NUMBERS, k=size), np.float64).astype(draw.choice(("f8", "f4", "f2")))
    array = numbers if plain else np.zeros(size, draw.choice(TYPES))
    shape = draw.choice(((), (0,), (1, 1, 1, 1, 1, 1, 1, 1, 0), (0, 2**40), array.shape, array.shape, array.shape))
    made = dialect.array(array)
    prefix = (lambda text: text.encode()) if b"dtype" in made else (lambda text: text)
    if draw.random() < 0.7:
        changed = {"shape": (list(shape), *SHAPES), "dtype": DTYPES, "data": (b"", b"x", None, "text", [0.0], bytes(7))}
        part = draw.choice([*changed])
        made[prefix(part)] = draw.choice(changed[part])
    if draw.random() < 0.2:
        made[prefix("__npgeneric__")] = made.pop(prefix("__ndarray__"))
        made[prefix("data")] = draw.choice(STRANGE)
    if draw.random() < 0.3:
        made = {"__image__": True, "data": draw.choice(IMAGES), "format": draw.choice(("png", "jpeg", "raw", None, 3))}
    return made


def damaged(draw: random.Random, dialect: Dialect, seen: dict[str, Any]) -> tuple[str, bytes, int]:
    """A damaged message -> what was done to it, the message, and the kind of its frame."""
    way, kind = draw.random(), BINARY
    if way < 0.15:
        name = draw.choice([*HEADS])
        return name, HEADS[name], BINARY
    good = draw.choice(dialect.good(seen, 10**6 + draw.randrange(1000)))
    if dialect.name == "vla_eval" and draw.random() < 0.3:
        metrics = {"success": True, "end_effector": [0.0, 0.0, 0.0]}
        good = {"type": "episode_end", "payload": {"metrics": metrics, "elapsed_sec": 1.0}, "seq": 1, "timestamp": 0.0}
    if way > 0.75:
        whole = msgpack.packb(good)
        what = draw.choice(("cut", "flipped", "appended", "noise", "as text"))
        at = draw.randrange(len(whole))
        content = {
            "cut": whole[:at],
            "flipped": whole[:at] + bytes([whole[at] ^ 1 << draw.randrange(8)]) + whole[at + 1 :],
            "appended": whole + draw.randbytes(9),
            "noise": draw.randbytes(draw.randrange(1, 400)),
            "as text": json.dumps({"prompt": "x"}).encode(),
        }[what]
        return what, content, TEXT if what == "as text" else kind
    done = []
    for _ in range(draw.choice((1, 1, 2))):
        holder, key = draw.choice([*places(good)])
        value = strange_array(draw, dialect) if draw.random() < 0.5 else draw.choice(STRANGE)
        if draw.random() < 0.15:
            del holder[key]
            done.append(f"without {key!r}")
        else:
            holder[key] = value
            done.append(f"{key!r} = {repr(value)[:80]}")
    return ", ".join(done), msgpack.packb(good), kind


def places(value: dict[Any, Any]) -> Iterator[tuple[dict[Any, Any], Any]]:
    """Every holder and key of nested maps."""
    for key, inner in list(value.items()):
        yield value, key
        if isinstance(inner, dict):
            yield from places(inner)


# --- damaged connections: what a client does in place of a conversation. Each returns what stays open meanwhile.


def _silent(port: int) -> list[Client]:
    return [Client(port)]


def _half_open(port: int) -> list[Client]:
    client = Client(port)
    client.raw.shutdown(socket.SHUT_WR)
    return [client]


def _reset(port: int) -> list[Client]:
    client = Client(port)
    client.raw.sendall(framed(bytes(100), size=60_000))
    client.leave(at_once=True)
    return []


def _reconnects(port: int) -> list[Client]:
    for number in range(20):
        Client(port).leave(at_once=number % 2 == 0)
    return []


def _sends(content: bytes, shakes: bool = True, stays: bool = False) -> Callable[[int], list[Client]]:
    """Sends these bytes, with or without a handshake before, and leaves, or stays."""

    def go(port: int) -> list[Client]:
        client = Client(port, shakes)
        with contextlib.suppress(OSError):  # the server may refuse in the middle of it
            client.raw.sendall(content)
        if not stays:
            client.leave(at_once=True)
        return [client] if stays else []

    return go


CONNECTIONS: dict[str, Callable[[int], list[Client]]] = {
    "silent": _silent,
    "half open": _half_open,
    "reset in mid-message": _reset,
    "20 quick reconnects": _reconnects,
    "noise for a handshake": _sends(bytes(range(256)) * 20, shakes=False),
    "no handshake": _sends(b"", shakes=False, stays=True),
    "half a handshake": _sends(handshake()[:60], shakes=False, stays=True),
    "a header of 200 KB": _sends(handshake(b"X-Long: " + b"a" * 200_000 + b"\r\n"), shakes=False),
    "10,000 headers": _sends(handshake(b"X: y\r\n" * 10_000), shakes=False),
    "a browser": _sends(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", shakes=False),
    "a form": _sends(b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999\r\n\r\n", shakes=False),
    "TLS": _sends(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(500), shakes=False),
    "no mask": _sends(framed(b"x", masked=False), stays=True),
    "reserved bits": _sends(framed(b"x", end=0xF0), stays=True),
    "an unknown kind": _sends(framed(b"x", kind=5), stays=True),
    "a ping of 200 bytes": _sends(framed(bytes(200), PING_CODE), stays=True),
    "200 pings": _sends(framed(b"x", PING_CODE) * 200, stays=True),
    "200 pongs": _sends(framed(b"x", PONG) * 200),
    "a size of 8 EB": _sends(framed(b"x", size=2**63 - 1), stays=True),
    "a size beyond all": _sends(framed(b"x", size=2**64 - 1), stays=True),
    "more than max_mb": _sends(framed(bytes(2**20 + 1)), stays=True),
    "fragments without end": _sends(framed(bytes(1000), end=0) + framed(bytes(1000), kind=0, end=0) * 1200, stays=True),
    "a fragment that ends nothing": _sends(framed(b"x", kind=0), stays=True),
    "10,000 empty fragments": _sends(framed(b"", end=0) + framed(b"", kind=0, end=0) * 10_000),
    "text that is no UTF-8": _sends(framed(b"\xff\xfe", TEXT), stays=True),
    "a close without a code": _sends(framed(b"\x03", CLOSE), stays=True),
    "a close with a code that is none": _sends(framed(struct.pack(">H", 5), CLOSE), stays=True),
    "a byte at a time": _sends(framed(b"\xc0" * 5)[:3], stays=True),
}


# --- a server under fire


class Fire:
    """Sends one server what is drawn, and says what did not hold. counts: frames, connections. seat: the longest time,
    seconds, until a newcomer had the seat."""

    def __init__(self, draw: random.Random, dialect: Dialect, seen: dict[str, Any]) -> None:
        self.draw, self.dialect, self.seen = draw, dialect, seen
        self.counts = {"frames": 0, "connections": 0}
        self.wrong = list[str]()
        self.seat, self.number = 0.0, 0
        self.expected: Any = None

    def __call__(self, said: Callable[[], str]) -> None:
        """Shoots. said: what the server has said so far."""
        until = time.monotonic() + 10 * ANSWERS  # it loads a policy
        while "listens on" not in (text := said()) and time.monotonic() < until:
            time.sleep(0.02)
        port = int(text.rsplit(":", 1)[1])
        shots = [False] * FRAMES + [True] * CONNECTED
        self.draw.shuffle(shots)
        client = self.conversation(port)
        for is_connection in shots:
            if is_connection:
                client.leave()
                client = self.connection(port)
            elif not self.frame(client):
                client = self.conversation(port)
        client.leave()

    def conversation(self, port: int) -> Client:
        """A client that is served, as soon as there is a seat."""
        allowed = ANSWERS + SLACK
        began = time.monotonic()
        while True:
            try:
                client = Client(port)
                self.probe(client, greeted=not self.dialect.first)
            except Lost:
                if time.monotonic() > began + allowed:
                    raise
                time.sleep(0.05)
            else:
                self.seat = max(self.seat, time.monotonic() - began)
                return client

    def check(self, what: str, port: int, allowed: float) -> Client:
        """A client that must be served within so many seconds."""
        began = time.monotonic()
        client = self.conversation(port)
        if (took := time.monotonic() - began) > allowed + SLACK:
            self.wrong.append(f"{what}: the seat was free after {took:.1f} s")
        return client

    def connection(self, port: int) -> Client:
        """One damaged connection, after which the next client is served in time."""
        name = self.draw.choice([*CONNECTIONS])
        self.counts["connections"] += 1
        try:
            there = CONNECTIONS[name](port)
        except Lost as error:
            self.wrong.append(f"{name}: a client was not let in: {error}")
            there = []
        client = self.check(name, port, 2 * PING if self.dialect.first else IDLE)
        for other in there:
            other.leave(at_once=True)
        return client

    def frame(self, client: Client) -> bool:
        """One damaged message, then a good one -> whether the connection is still open."""
        what, content, kind = damaged(self.draw, self.dialect, self.seen)
        self.counts["frames"] += 1
        try:
            client.send(content, kind)
            self.probe(client, answers=1)
        except Lost as error:
            self.wrong.append(f"{what}: the connection ended: {error}")
            return False
        except TimeoutError:
            self.wrong.append(f"{what}: no answer for {ANSWERS:g} s")
            return False
        except ValueError as error:
            self.wrong.append(f"{what}: {error}")
            client.leave()  # the next answers would be taken for those of other messages
            return False
        return True

    def probe(self, client: Client, answers: int = 0, greeted: bool = True) -> None:
        """A good observation gets the actions that it always gets. answers: to what was sent before.

        Raises:
            ValueError: other actions, or an answer that no client can read. Lost, TimeoutError: none.
        """
        if not greeted:
            client.receive()
        self.number += 1
        for message in self.dialect.good(self.seen, self.number):
            client.send(msgpack.packb(message))
        while True:
            answer = client.receive()
            value = answer if isinstance(answer, str) else msgpack.unpackb(answer)
            line = value if isinstance(value, str) else value.get("payload", {}).get("error", "")
            if line and ("internal error" in line or "\n" in line or len(line) > 510):
                raise ValueError(f"answered by {line[:300]}")
            if self.dialect.first and answers:
                answers -= 1
            elif self.dialect.first or (value["type"] == "action" and value["seq"] == self.number):
                break
        if line:
            raise ValueError(f"a good observation was answered by {line[:300]}")
        self.expected = self.expected or self.dialect.actions(value)
        if self.dialect.actions(value) != self.expected:
            raise ValueError("a good observation got other actions than before")
