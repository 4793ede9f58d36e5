"""`kerv serve`: the protocol spoken by a minimal client of our own, bad clients, and the same actions as in process."""

import os
import signal
import socket
import struct
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
from command import refusal
from conftest import until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from kerv_cli.base.config import compose as compose_settings
from kerv_cli.base.files import read_json, write_json
from kerv_cli.base.spaces import Observation
from kerv_cli.base.wire import packed, unpacked
from kerv_cli.engine.decoder import Decoder
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.serve.openpi import OpenPi, observation_of
from kerv_cli.serve.policy import Finite, Policy
from kerv_cli.serve.server import PolicyServer
from kerv_cli.serve.settings import ServeSettings


def encoded(value: Any) -> Any:
    """An array as the documented protocol writes it, independent of kerv's own code."""
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": list(value.shape)}
    raise TypeError


def decoded(value: dict[Any, Any]) -> Any:
    if value.get(b"__ndarray__"):
        return np.frombuffer(value[b"data"], value[b"dtype"]).reshape(value[b"shape"])
    return value


class Client:
    """Speaks the protocol and nothing else."""

    def __init__(self, port: int) -> None:
        self.connection = connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None).__enter__()
        self.metadata = msgpack.unpackb(self.connection.recv(), object_hook=decoded)

    def infer(self, observation: dict[str, Any]) -> dict[str, Any]:
        return self.send(msgpack.packb(observation, default=encoded))

    def send(self, frame: Any) -> dict[str, Any]:
        self.connection.send(frame)
        answer = self.connection.recv()
        if isinstance(answer, str):
            raise RuntimeError(answer)
        return msgpack.unpackb(answer, object_hook=decoded)  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def policy(policies):
    words = ["policy.target=nano-vision", f"results={policies}", "method=naive_sd"]
    return Policy(compose_settings("serve", words, ServeSettings))


@contextmanager
def serving(policy: Policy, **chosen: Any) -> Iterator[tuple[int, list[str]]]:
    """The port of a server that runs in a thread, and its log. chosen: settings."""
    log: list[str] = []
    with PolicyServer(policy, replace(policy.settings, **chosen), log.append).listening("127.0.0.1", 0) as port:
        yield port, log


def seen(seed: int, **changes: Any) -> dict[str, Any]:
    random = np.random.default_rng(seed)
    image = random.integers(0, 256, (96, 96, 3), dtype=np.uint8)
    state = random.normal(size=4)
    return {"observation/image": image, "observation/state": state, "prompt": "open a drawer", **changes}


@pytest.mark.bits
def test_a_client_gets_the_actions_of_the_policy(policy, policies):
    target: Any = Artifacts(str(policies), PolicySettings(target="nano-vision")).target
    with serving(policy) as (port, log):
        client = Client(port)
        assert client.metadata["cameras"] == list(target.cameras)
        assert client.metadata["actions"] == ["dx", "dy", "dz", "gripper"]
        for seed in range(3):
            message = seen(seed)
            answer = client.infer(message)
            felt = message["observation/state"]
            state = np.concatenate([felt, np.zeros(35)])
            observation = Observation(felt, state, "open a drawer", {target.cameras[0]: message["observation/image"]})
            np.testing.assert_allclose(answer["actions"], Decoder(target).decode(observation).actions)
            assert answer["server_timing"]["infer_ms"] > answer["policy_timing"]["infer_ms"] > 0
        client.connection.close()
        until(lambda: any("disconnected; 3 answers, p50" in line for line in log))


def test_an_answer_says_how_much_was_accepted_so_far_under_vllms_names(policy, policies):
    conversation = OpenPi(policy)
    answers = [conversation.act(seen(seed))["spec_decode"] for seed in range(3)]
    assert [one["num_drafts"] for one in answers] == sorted(one["num_drafts"] for one in answers)
    last = answers[-1]
    assert last["mean_acceptance_length"] == 1 + last["num_accepted_tokens"] / last["num_drafts"]
    assert sum(last["acceptance_histogram"]) == last["num_drafts"] >= 3
    assert len(last["conditional_acceptance_rate_per_dof"]) == 4
    words = ["policy.target=nano-vision", f"results={policies}", "method=ar"]
    assert "spec_decode" not in OpenPi(Policy(compose_settings("serve", words, ServeSettings))).act(seen(0))


BOMB = {b"__ndarray__": True, b"data": b"", b"dtype": "<f8", b"shape": [2**40]}


def frame_of(**changes: Any) -> bytes:
    return bytes(msgpack.packb({**seen(0), **changes}, default=encoded))


@pytest.mark.parametrize(
    ("frame", "said"),
    [
        (frame_of(**{"observation/image": np.zeros((64, 64, 3), np.uint8)}), "(64, 64, 3) uint8, (96, 96, 3) uint8"),
        (frame_of(**{"observation/image": BOMB}), "does not fit its bytes"),
        (frame_of(**{"observation/state": np.array([0, np.nan, 0, 0])}), "not finite, at [1]"),
        (frame_of(**{"observation/state": np.zeros(5)}), "has shape (5,), 4 or 39 numbers"),
        (frame_of(**{"observation/state": ["a"]}), "does not hold numbers"),
        (frame_of(prompt=3), "prompt is int"),
        (frame_of(prompt=None), "no prompt: the message must say what the robot has to do"),
        (frame_of(prompt=" "), "no prompt"),
        (frame_of(prompt="word " * 40), "has 40 words, the policy takes 10"),
        (frame_of(reset=np.zeros(3)), "reset is ndarray"),
        (frame_of(executed=99), "executed=99"),
        (frame_of(x={**BOMB, b"dtype": "|O"}), "booleans, integers and floats"),
        (b"\xc1garbage", "cannot be read as msgpack"),
        ("text", "a text message came"),
        (msgpack.packb([1, 2]), "the message is a list"),
        (msgpack.packb({}), "the message has nothing"),
    ],
)
def test_a_wrong_frame_gets_one_line_and_the_next_one_an_answer(policy, frame, said):
    with serving(policy) as (port, log):
        client = Client(port)
        client.infer(seen(0))
        with pytest.raises(RuntimeError) as refused:
            client.send(frame)
        assert str(refused.value).startswith("kerv: ")
        assert said in str(refused.value)
        assert "\n" not in str(refused.value)
        assert any(said in line for line in log)
        assert client.infer(seen(0))["actions"].shape == (4, 4)
        client.connection.close()
        until(lambda: any("disconnected; 2 answers, p50" in line for line in log))  # a refusal is none


def test_whoever_leaves_in_mid_message_leaves_the_server_running(policy):
    with serving(policy) as (port, log):
        client = Client(port)
        raw: socket.socket = client.connection.socket
        raw.sendall(b"\x82\xfe\xff\xff")  # the beginning of a frame of 65535 bytes
        raw.shutdown(socket.SHUT_RDWR)
        until(lambda: any("disconnected" in line for line in log))
        large = Client(port)
        with pytest.raises(ConnectionClosed):
            large.send(bytes(2**24 + 1))  # more than 16 MiB
        until(lambda: sum("disconnected" in line for line in log) == 2)
        assert Client(port).infer(seen(1))["actions"].shape == (4, 4)


def test_one_client_at_a_time_and_health_is_answered_without_a_seat(policy):
    with serving(policy) as (port, _):
        first = Client(port)
        with pytest.raises(ConnectionClosed, match="another client"):
            Client(port)
        for path in ("healthz", "health"):
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/{path}", timeout=5) as answer:
                assert answer.read() == b"OK\n"
        assert first.infer(seen(2))["actions"].shape == (4, 4)
        first.connection.close()
        until(lambda: _accepted(port))


def _accepted(port: int) -> bool:
    try:
        Client(port).connection.close()
    except ConnectionClosed:
        return False
    return True


class Watching(Decoder):
    """Notes what it is told between decodes."""

    told: list[tuple[np.ndarray, np.ndarray]]
    resets = 0

    def reset(self, task: str, seed: int, end_effector: np.ndarray) -> None:
        self.told = []
        self.resets += 1
        super().reset(task, seed, end_effector)

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        self.told.append((action, end_effector))
        super().observe(action, end_effector)


def test_the_decoder_is_told_what_was_executed(policy):
    target: Any = Finite(policy.artifacts.target)
    decoder = Watching(target)
    client = OpenPi(policy)
    client.decoder = decoder
    first = unpacked(client.answer(packed(seen(0))))["actions"]
    client.answer(packed(seen(1, executed=2)))
    assert len(decoder.told) == 2
    np.testing.assert_allclose([action for action, _ in decoder.told], first[:2], atol=1e-6)
    start, end = (seen(seed)["observation/state"][:3] for seed in (0, 1))
    np.testing.assert_allclose([at for _, at in decoder.told], [(start + end) / 2, end])
    client.answer(packed(seen(2)))
    assert len(decoder.told) == 6
    client.answer(packed(seen(3, reset=True)))
    assert decoder.told == []
    assert decoder.resets == 2


@pytest.mark.parametrize(
    ("gripper", "values"), [("as_is", [-0.4, 0.9]), ("signed", [1, -1]), ("signed_inverted", [-1, 1])]
)
def test_grippers(policy, gripper, values):
    """Meta-World's policy opens with -1 and closes with 1; one of no environment closes with 0 and opens with 1."""
    own = replace(policy.interface, gripper=gripper)
    made = own.converted(np.array([[0.3, 0, 0, -0.4], [0, 0, 0, 0.9]]))
    np.testing.assert_allclose(made[:, 3], values)
    np.testing.assert_allclose(made[:, 0], [0.3, 0])
    if gripper != "as_is":
        foreign = replace(own, spec=None).converted(np.array([[0, 0, 0, 0.9], [0, 0, 0, 0.1]]))
        np.testing.assert_allclose(foreign[:, 3], values)


def test_a_server_that_cannot_start_says_so(policies):
    words = ("serve", "policy.target=nano-vision", f"results={policies}")
    assert "no early drafter in" in refusal(*words, "method=one_pass", code=1)
    assert "cannot listen on 256.1.1.1:0" in refusal(*words, "host=256.1.1.1", "port=0")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        busy = refusal(*words, "host=127.0.0.1", f"port={taken.getsockname()[1]}", code=2)
    assert busy.endswith("port=0 takes a free one")


def test_the_command_answers_and_stops_when_told(policies, tmp_path):
    """At once, whatever its clients do: one is silent, one is in mid message, one has not even asked for anything."""
    words = ["serve", "policy.target=nano-state", f"results={policies}", "port=0"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen([sys.executable, "-m", "kerv_cli", *words], stderr=log, env=environment)
        try:
            until(lambda: "listens on" in (tmp_path / "log").read_text(), 60)
            port = int((tmp_path / "log").read_text().rsplit(":", 1)[1])
            client = Client(port)
            assert client.infer({"observation/state": np.zeros(39), "prompt": "open"})["actions"].shape == (4, 4)
            client.connection.close()
            until(lambda: "disconnected" in (tmp_path / "log").read_text())
            with silent(port) as seated, socket.create_connection(("127.0.0.1", port)):
                until(lambda: (tmp_path / "log").read_text().count(" connected") == 2)
                seated.sendall(b"\x82\xfe\xff\xff")  # the beginning of a frame of 65535 bytes
                process.send_signal(signal.SIGTERM)
                assert process.wait(3) == 0
        finally:
            process.kill()
    assert "stopped" in (tmp_path / "log").read_text()


def test_a_policy_that_reads_images_alone_needs_no_state(policy):
    message = {key: value for key, value in seen(0).items() if key != "observation/state"}
    given = observation_of(replace(policy.interface, images_alone=True), message)
    assert (given.proprioception.shape, given.state.shape) == ((4,), (39,))


# --- the contract: seats, silence, ranges, faults (docs/serving.md)


def silent(port: int) -> socket.socket:
    """A client that completes the handshake and never says or answers anything."""
    raw = socket.create_connection(("127.0.0.1", port))
    lines = ("GET / HTTP/1.1", f"Host: 127.0.0.1:{port}", "Upgrade: websocket", "Connection: Upgrade")
    key = ("Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13")
    raw.sendall("\r\n".join((*lines, *key, "", "")).encode())
    assert b"101 Switching" in raw.recv(4096)
    return raw


@pytest.mark.parametrize(("limit", "said"), [("ping_s", "keepalive ping timeout"), ("idle_s", "no message for 0.3 s")])
def test_a_silent_client_loses_its_seat(policy, monkeypatch, limit, said):
    monkeypatch.setattr(OpenPi, limit, 0.3)
    with serving(policy) as (port, log):
        lost = silent(port)
        until(lambda: any("disconnected" in line for line in log))
        assert _accepted(port)
        assert any(said in line for line in log)
        lost.close()


@pytest.mark.parametrize(("origins", "accepted"), [([], False), (["http://robot.local"], True)])
def test_a_web_page_may_connect_only_where_it_is_named(policy, origins, accepted):
    with serving(policy, origins=origins) as (port, _):
        url = f"ws://127.0.0.1:{port}"
        refused = pytest.raises(InvalidStatus, match="403")
        with nullcontext() if accepted else refused, connect(url, origin="http://robot.local") as page:
            assert page.recv(5)
        with pytest.raises(InvalidStatus, match="403"), connect(url, origin="http://elsewhere.net"):
            pass
        assert _accepted(port)


@pytest.mark.parametrize("height", [1e39, -2.5, 3.5])
def test_a_state_far_from_the_demonstrations_is_refused(results, height):
    """The target says that its demonstrations' numbers lay between 0 and 1."""
    state = np.array([0.5, 0.5, height, 0.5])
    path = results / "artifacts/target/nano-vision/target.json"
    write_json(path, read_json(path) | {"state_range": [[0.0] * 39, [1.0] * 39]})
    words = ["policy.target=nano-vision", f"results={results}", "margin=2"]
    with serving(Policy(compose_settings("serve", words, ServeSettings))) as (port, log):
        client = Client(port)
        with pytest.raises(RuntimeError, match=r"z is .*, the policy was trained on -2 to 3"):
            client.infer(seen(0, **{"observation/state": state}))
        assert any("out of range: z" in line for line in log)
        assert client.infer(seen(0, **{"observation/state": np.array([0.5, 0.5, 2.9, 0.5])}))["actions"].shape == (4, 4)


def fails(*arguments: object) -> None:
    raise RuntimeError("CUDA error:\n" + "word " * 1000)


@pytest.mark.parametrize(
    ("head", "said"),
    [
        (fails, "kerv: internal error, RuntimeError: CUDA error: word"),
        (lambda self, hidden: self._noted(self._target.head(hidden) * float("nan")), "not finite: no action is sent"),
    ],
)
def test_a_policy_that_fails_sends_one_line_and_no_action(policy, monkeypatch, head, said):
    with serving(policy) as (port, log):
        client = Client(port)
        client.infer(seen(0))
        with monkeypatch.context() as patch:
            patch.setattr(Finite, "head", head)
            with pytest.raises(RuntimeError) as told:
                client.infer(seen(0))
        assert said in str(told.value)
        assert len(str(told.value)) < 600
        assert "\n" not in str(told.value)
        assert any(" error: " in line for line in log)
        assert client.infer(seen(0))["actions"].shape == (4, 4)


def test_a_client_that_breaks_off_is_a_line_of_the_log(policy, capfd):
    with serving(policy) as (port, _):
        for _ in range(20):  # now and then one is gone before the server asks for its address
            lost = silent(port)
            lost.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            lost.close()
        until(lambda: _accepted(port))
    assert "Traceback" not in capfd.readouterr().err
