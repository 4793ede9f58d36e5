"""Policies behind a server: the same as in this process, the official client's encoding, two settings, every fault."""

import csv
import os
import re
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import refusal, told
from conftest import refused, until
from examples.point_mass import SPEC as POINT
from examples.point_mass import PointWorld
from test_board import client_of
from websockets.sync.server import serve

import kerv_cli as library
from kerv_cli.base.errors import EpisodeError, KervError
from kerv_cli.base.spaces import Observation
from kerv_cli.base.wire import packed, unpacked
from kerv_cli.episodes import policy, remote
from kerv_cli.episodes.interface import Interface, Picture, read_interface
from kerv_cli.episodes.remote import RemoteDecoder, close_servers
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.worlds import EnvironmentPart
from kerv_cli.worlds.libero.spec import SPEC as LIBERO

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.usefixtures("quick_report")
METADATA = {"server": "kerv", "cameras": [], "image_size": 0, "state": [], "actions": ["dx", "dy"], "gripper": "as_is"}


@pytest.fixture(autouse=True)
def nothing_connected():
    EnvironmentPart(POINT.name)(lambda: POINT)
    yield
    close_servers()


def straight(message: dict[str, Any]) -> bytes:
    """One step to the goal."""
    state = message["observation/state"]
    timing = {"infer_ms": 1.5}
    return packed({"actions": np.clip(state[3:5] - state[:2], -0.05, 0.05)[None], "server_timing": timing})


MORTAL = """
import ast, os, sys
import numpy as np
from kerv_cli.base.wire import packed
from websockets.sync.server import serve

def talk(connection):
    connection.send(packed(ast.literal_eval(sys.argv[1])))
    for number, _ in enumerate(connection):
        if number == 4:
            os._exit(0)
        connection.send(packed({"actions": np.zeros((1, 2))}))

server = serve(talk, "127.0.0.1", 0)
print(server.socket.getsockname()[1], flush=True)
server.serve_forever()
"""
"""A server whose process ends at the fifth question of a connection."""


@contextmanager
def serving(answer=straight, metadata: Any = METADATA, port: int = 0):
    """The address of a server; answer: None ends the connection."""

    def talk(connection):
        connection.send(metadata if isinstance(metadata, str) else packed(metadata))
        for frame in connection:
            reply = answer(unpacked(frame))
            if reply is None:
                return
            connection.send(reply)

    server = serve(talk, "127.0.0.1", port, max_size=None, compression=None)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
    finally:
        server.shutdown()
        thread.join()


def words(url: str, results: Path, *more: str) -> list[str]:
    return ["policy=remote", f"policy.url={url}", "task=POINT", "record=0", f"results={results}", *more]


def sweep(results: Path, *urls: str, code: int = 0) -> str:
    """What a sweep of two episodes of each server prints, in one line."""
    settings = [f"  s{number}: policy.url={url}" for number, url in enumerate(urls)]
    common = "common: policy=remote task=POINT record=0 episodes=2"
    (results / "study.yaml").write_text("\n".join([common, "baseline: s0", "settings:", *settings]))
    return " ".join(told("sweep", f"study={results}/study.yaml", f"results={results}", code=code).split())


@contextmanager
def kerv_server(log: Path, *chosen: str):
    """The address of `kerv serve` in a process of its own."""
    command = [sys.executable, "-m", "kerv_cli", "serve", "port=0", *chosen]
    with log.open("w") as file:
        process = subprocess.Popen(command, stderr=file, env={**os.environ, "PYTHONUNBUFFERED": "1"})
    try:
        until(lambda: "listens on" in log.read_text(), 120)
        yield re.findall(r"ws://\S+", log.read_text())[0]
    finally:
        process.kill()
        process.wait()


def test_a_server_of_kerv_gives_the_same_episodes_as_the_policy_in_this_process(tmp_path):
    common = {"task": ["drawer-close", "reach"], "episodes": 1, "record": 0, "results": tmp_path}
    common["world"] = {"horizon": 40}
    here = library.rollout(policy="vision", method="one_pass", **common).episodes()
    with kerv_server(tmp_path / "log", "policy=vision", "method=one_pass") as url:
        there = library.rollout("policy=remote", policy={"url": url}, **common).episodes()
    same = ("task", "seed", "success", "steps", "forwards", "verifications", "accepted", "path_length", "jerk")
    assert [[row[name] for name in same] for row in there] == [[row[name] for name in same] for row in here]
    assert {row["server_decodes"] == row["decodes"] > 0 for row in there} == {True}
    assert all(0 < row["server_seconds"] < row["seconds"] for row in there)


def test_the_client_adds_at_most_two_milliseconds_to_an_answer():
    policy = PolicySettings(kind="remote", url="", interface="kerv")
    metadata = {**METADATA, "cameras": ["corner2"], "image_size": 96, "state": ["x", "y", "z", "gripper"]}
    metadata |= {"actions": ["dx", "dy", "dz", "gripper"]}
    from kerv_cli.worlds.metaworld.spec import SPEC

    def answer(message):
        began = time.perf_counter()
        while time.perf_counter() < began + 0.005:  # what a policy would take
            pass
        seconds = time.perf_counter() - began
        return packed({"actions": np.zeros((4, 4)), "server_timing": {"infer_ms": 1000 * seconds}})

    image = np.random.default_rng(0).integers(0, 256, (96, 96, 3), np.uint8)
    with serving(answer, metadata) as policy.url:
        decoder = RemoteDecoder(policy, read_interface("kerv"), SPEC)
        decoder.reset("reach-v3", 0, np.zeros(3))
        seen = Observation(np.zeros(4), np.zeros(39), "reach", {"corner2": image})
        records = [decoder.decode(seen) for _ in range(50)]
    added = np.reshape([one.seconds - one.served.seconds for one in records], (5, 10))
    assert np.median(added, 1).min() < 0.002  # in the quietest tenth of a second, because others use this machine, too
    assert [one.actions.shape for one in records] == [(4, 4)] * 50


def test_two_servers_are_two_settings_that_take_turns_and_both_times_are_in_the_table(tmp_path):
    def slow(message):
        time.sleep(0.08)
        return straight(message)

    (tmp_path / "two.yaml").write_text(
        "common: policy=remote task=POINT episodes=3 record=0\nbaseline: slow\nsettings:\n"
        "  slow: policy.url={0} policy.name=slow\n  fast: policy.url={1} policy.name=fast\n"
        "  real: policy.url={1} policy.name=fast rollout.clock=real\n"
    )
    with serving(slow) as first, serving() as second:
        text = (tmp_path / "two.yaml").read_text().format(first, second)
        (tmp_path / "two.yaml").write_text(text)
        command = ["sweep", f"study={tmp_path}/two.yaml", f"results={tmp_path}"]
        assert "9/9" in told(*command)
        with serving() as moved:  # another address, the same name and metadata
            (tmp_path / "two.yaml").write_text(text.replace(second, moved))
            assert "9 reused" in told(*command, "--plan")
            (tmp_path / "two.yaml").write_text(text.replace("policy.name=slow", "policy.name=slower"))
            assert "3 episodes to run, 6 reused" in told(*command, "--plan")
        line = f"remote url={first}"  # without a name, the address is the label
        assert line in told("rollout", "-m", *words(f"{first},{second}", tmp_path))
    table = library.load_study("two", tmp_path).to_pandas().set_index("label")
    assert table.loc["fast", "speedup_low"] > 1
    assert table.loc[["slow", "fast"], "success"].tolist() == [1, 1]
    np.testing.assert_allclose(table["server_ms"], 1.5)
    assert table["unverified_share"].isna().all()
    assert table.loc["real", "felt_latency_ms"] > 0
    assert "of it the" in " ".join(told("report", "study=two", f"results={tmp_path}", "--all").split())
    rows = csv.DictReader((tmp_path / "report/tables/two.csv").read_text().splitlines())
    assert all(float(row["server_ms"]) == 1.5 and float(row["answer_ms"]) > 0 for row in rows)
    board = client_of(tmp_path)
    first = re.findall(r"/episodes/\d+", board.get("/studies/two/episodes").text)[0]
    assert "policy&#39;s server" in board.get(first).text


SEEN = Observation(np.zeros(3), np.zeros(6), "")


def asking(url: str) -> RemoteDecoder:
    decoder = RemoteDecoder(PolicySettings(kind="remote", url=url), read_interface("kerv"), POINT)
    decoder.reset("push-point", 0, np.zeros(3))
    return decoder


def once(wrong: Any):
    """Answers straight, but to the fourth question with something wrong: three are to warm up."""
    asked = []

    def answer(message):
        asked.append(message)
        return wrong if len(asked) == 4 else straight(message)

    return answer


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (packed({"actions": np.zeros((4, 3))}), "actions has shape (4, 3), (steps, 2) is wanted"),
        (packed({"actions": np.zeros((0, 2))}), "actions has shape (0, 2)"),
        (packed({"actions": np.array([[0, np.nan]])}), "actions holds numbers that are not finite"),
        (packed({"actions": "left"}), "actions is str, numbers are wanted"),
        (packed({"action": np.zeros((4, 2))}), "actions is not there (action)"),
        (b"\xc1", "cannot be read as msgpack"),
        (packed({"actions": np.zeros((65 * 2**17, 1))}), "sent a message above 64 MiB"),
    ],
)
def test_a_wrong_answer_is_one_line(wrong, says):
    with serving(lambda message: wrong) as url, refused(says, error=EpisodeError):
        asking(url).decode(SEEN)


def test_a_wrong_answer_fails_its_episode_alone_and_nothing_of_it_is_executed(tmp_path, monkeypatch):
    moves = []
    advance = PointWorld._advance
    monkeypatch.setattr(PointWorld, "_advance", lambda self, action: moves.append(action) or advance(self, action))
    with serving(once("Traceback\n  File\nValueError: no such key")) as url:
        output = sweep(tmp_path, url, code=1)
    assert output.count("failed:") == 1
    assert "answered with a text frame: ValueError: no such key" in output
    (row,) = library.load_study("study", tmp_path).episodes()
    assert row["success"]
    assert len(moves) == 1 + row["steps"]  # the failed episode's first answer was right


def test_a_server_that_comes_back_is_found_again_and_one_that_does_not_ends_its_episode(tmp_path, monkeypatch):
    monkeypatch.setattr(remote, "RECONNECT_S", 1.0)
    with serving(once(None)) as url:
        assert sweep(tmp_path, url).count("success,") == 2
    command = [sys.executable, "-c", MORTAL, repr(METADATA)]
    with serving() as other, subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        output = sweep(tmp_path, f"ws://127.0.0.1:{process.stdout.readline().strip()}", other, code=1)
    assert output.count("failed:") == 2
    assert output.count("success,") == 2
    assert "cannot be reached (Connection refused)" in output


OPENVLA = """
import numpy as np
from kerv_cli.base.wire import packed, unpacked
from websockets.sync.server import serve

def talk(connection):
    connection.send(packed({}))
    for frame in connection:
        seen = unpacked(frame)
        image = seen.pop("observation/image")
        assert (image.shape, image.dtype, seen) == ((224, 224, 3), np.uint8, {"prompt": "pick up the bowl"})
        connection.send(packed({"actions": [[0.1] * 6 + [float(image[:, :112].mean() > image[:, 112:].mean())]] * 2}))

server = serve(talk, "127.0.0.1", 0)
print(server.socket.getsockname()[1], flush=True)
server.serve_forever()
"""
"""OpenVLA behind a server, as `openvla_libero` asks it: it opens the gripper if the image's left half is brighter."""


def test_openvlas_interface_asks_a_server_in_a_process_of_its_own(monkeypatch):
    monkeypatch.setattr(remote, "RECONNECT_S", 1.0)
    dark, bright = np.zeros((2, 256, 256, 3), np.uint8) + np.array([0, 200], np.uint8)[:, None, None, None]
    with subprocess.Popen([sys.executable, "-c", OPENVLA], stdout=subprocess.PIPE, text=True) as process:
        policy = PolicySettings(kind="remote", url=f"ws://127.0.0.1:{process.stdout.readline().strip()}")
        decoder = RemoteDecoder(policy, read_interface("openvla_libero"), LIBERO)
        decoder.reset("bowl-on-stove", 0, np.zeros(3))
        for halves, gripper in (((bright, dark), 1.0), ((dark, bright), -1.0)):  # the server's image is mirrored
            image = np.concatenate([one[:, :128] for one in halves], 1)
            seen = Observation(np.zeros(len(LIBERO.observation.proprioception)), np.zeros(0), "pick up the bowl")
            record = decoder.decode(replace(seen, images={"agentview": image}))
            np.testing.assert_allclose(record.actions, [[0.1] * 6 + [gripper]], rtol=1e-6)
        process.kill()
        with refused("cannot be reached (Connection refused): start the server there, for 1 s", error=EpisodeError):
            decoder.decode(replace(seen, images={"agentview": image}))


@pytest.mark.parametrize(("away", "failed"), [(3, 0), (1000, 2)])
def test_a_server_that_is_away_when_a_block_begins_is_awaited(away, failed, tmp_path, monkeypatch):
    tries, connect = [], remote.Server.connect

    def late(server):
        if len(tries) < away and begun:
            tries.append(server)
            raise remote.Lost(f"{server.url} is away")
        return connect(server)

    begun: list[Any] = []
    monkeypatch.setattr(remote, "RECONNECT_S", 1.0)
    monkeypatch.setattr(remote.Server, "connect", late)
    monkeypatch.setattr("kerv_cli.lab.work.check", lambda *given: begun.append(given) or policy.check(*given))
    with serving() as url:
        output = sweep(tmp_path, url, code=int(failed > 0))
    assert f"{2 - failed} run, 0 reused, {failed} failed" in output
    assert ("is away, for 1 s" in output) == bool(failed)
    assert len(tries) >= 3


def test_without_a_server_one_line_says_so_within_ten_seconds(tmp_path, monkeypatch):
    assert remote.CONNECT_S == 10
    monkeypatch.setattr(remote, "CONNECT_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        line = refusal("rollout", *words(f"ws://127.0.0.1:{port}", tmp_path), code=1)
        assert "sends nothing within 0.5 s" in line
    assert "Connection refused" in refusal("rollout", *words(f"ws://127.0.0.1:{port}", tmp_path), code=1)
    with serving(metadata="busy") as url:
        assert "sent a text frame before its metadata: busy" in refusal("rollout", *words(url, tmp_path), code=1)


def test_a_slow_server_is_waited_for_in_sight(tmp_path, monkeypatch):
    monkeypatch.setattr(remote, "WAIT_S", 0.2)
    lines: list[str] = []
    monkeypatch.setattr(remote, "say", lines.append)
    slow = iter([0.5])

    def answer(message):
        time.sleep(next(slow, 0))
        return straight(message)

    with serving(answer) as url:
        told("rollout", *words(url, tmp_path, "episodes=1"))
    assert lines
    assert "waiting for an answer of ws://" in lines[0]
    monkeypatch.setattr(remote, "ANSWER_S", 0.3)
    slow = iter([2.0])
    with serving(answer) as url:
        assert "gave no answer within 0.3 s" in told("rollout", *words(url, tmp_path, "episodes=1"), code=1)


@pytest.mark.parametrize(
    ("typed", "says"),
    [
        (["method=kerv"], "method=kerv with policy=remote: the server decides it"),
        (["chunk=2"], "policy=remote with chunk=2: the server decides it"),
        (["policy.url=http://x"], "write policy.url=ws://HOST:PORT"),
        (["policy.interface=openpi"], "did you mean openpi_libero"),
        (["policy.interface=openpi_libero"], "the server's policy is for libero, these tasks are of point-mass"),
        (["task=reach"], "the server moves dx, dy, metaworld dx, dy, dz, gripper"),
    ],
)
def test_what_cannot_be_asked_is_refused_before(typed, says, tmp_path):
    with serving() as url:
        typed_keys = {word.partition("=")[0] for word in typed}
        given = [word for word in words(url, tmp_path) if word.partition("=")[0] not in typed_keys]
        assert says in refusal("rollout", *given, *typed, code=2)


def test_an_interface_of_ones_own_runs_as_the_docs_show(tmp_path):
    page = (ROOT / "docs/remote.md").read_text()
    (tmp_path / "point.yaml").write_text(re.search(r"```yaml\n# point.yaml\n(.*?)```", page, re.DOTALL)[1])
    code = re.search(r"```python\n# point_server.py\n(.*?)```", page, re.DOTALL)[1]
    scope: dict[str, Any] = {}
    exec(code.rpartition("serve(")[0], scope)
    server = serve(scope["talk"], "127.0.0.1", 0)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
    interface = f"policy.interface={tmp_path}/point.yaml"
    told("rollout", *words(url, tmp_path, interface, "episodes=2"))
    assert all(row["success"] for row in library.load_study("last", tmp_path).episodes())
    (tmp_path / "point.yaml").write_text("images: {rgb: {camera: above, sise: 3}}\n")
    assert "sise" in refusal("rollout", *words(url, tmp_path, interface), code=2)
    server.shutdown()


OFFICIAL = (
    "83b16f62736572766174696f6e2f696d61676584c40b5f5f6e6461727261795f5fc3c40464617461c406000102030405c405"
    "6474797065a37c7531c405736861706593010203b16f62736572766174696f6e2f737461746584c40b5f5f6e646172726179"
    "5f5fc3c40464617461c410000000000000e03f000000000000f0bfc4056474797065a33c6638c40573686170659102a67072"
    "6f6d7074a2676f"
)
"""What openpi-client 0.1.2 makes of the message below."""


def test_messages_equal_those_of_the_official_client_byte_for_byte():
    image, state = np.arange(6, dtype=np.uint8).reshape(1, 2, 3), np.array([0.5, -1.0])
    message = {"observation/image": image, "observation/state": state, "prompt": "go"}
    assert packed(message).hex() == OFFICIAL
    assert unpacked(bytes.fromhex(OFFICIAL))["observation/image"].tolist() == image.tolist()


def test_a_policy_that_reads_no_state_is_sent_none():
    interface = Interface(images={}, state={"observation/state": []}, execute=0)
    sent = interface.message(POINT, Observation(np.zeros(len(POINT.observation.proprioception)), np.zeros(0), "go"))
    assert sent["observation/state"].shape == (0,)


def test_conventions_of_grippers_and_the_order_of_an_action():
    names = ["gripper", *LIBERO.actions.names[:6]]
    answer = {"actions": np.array([[0.9, *range(6)], [0.1, *range(6)]])}
    for gripper, opened in {"unit": (True, False), "signed": (True, True), "signed_inverted": (False, False)}.items():
        actions, count = Interface(names=names, gripper=gripper, execute=0).actions_of(LIBERO, answer)
        assert count == 2
        assert actions[0, :6].tolist() == [0, 1, 2, 3, 4, 5]
        assert actions[:, 6].tolist() == [-1.0 if is_open else 1.0 for is_open in opened]
    assert len(Interface(names=names, execute=1).actions_of(LIBERO, answer)[0]) == 1
    with refused("(steps, 7)", error=EpisodeError):
        Interface().actions_of(LIBERO, {"actions": np.zeros(3)})


def test_a_picture_is_mirrored_and_fitted_with_black_borders():
    image = np.zeros((64, 128, 3), np.uint8)
    image[:, :64] = 255
    seen = Picture("a+b", 32, mirror=True).of(image)
    assert seen.shape == (32, 32, 3)
    assert seen[:8].max() == seen[24:].max() == 0
    assert seen[16, 4].tolist() == [0, 0, 0]
    assert seen[16, 28].tolist() == [255, 255, 255]


def test_another_policy_at_the_same_address_is_noticed(tmp_path):
    with serving(once(None)) as url:
        port = int(url.rpartition(":")[2])
        decoder, seen = asking(url), SEEN
        decoder.decode(seen)
    other = {**METADATA, "work": "other"}
    with serving(metadata=other, port=port), refused("serves another policy now", error=KervError):
        decoder.decode(seen)
