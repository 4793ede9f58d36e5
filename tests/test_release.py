"""`kerv build policy`: the archive of a policy, checked and put where policies are looked for."""

import gc
import http.server
import json
import shutil
import tarfile
import threading
from functools import partial
from pathlib import Path

import pytest
from command import told

from kerv_cli.base.files import sha256_of
from kerv_cli.targets import folders

ROOT = Path(__file__).resolve().parents[1]


def test_the_hashes_are_those_of_the_shipped_policies():
    shipped = (ROOT / "results/pretrained").glob("*/target/target.json")
    assert {path.parts[-3]: json.loads(path.read_text())["sha256"] for path in shipped} == folders.RELEASED


@pytest.fixture
def archive(policies, tmp_path, monkeypatch):
    """An archive of a policy that this kerv does not have beside it, called as one of the released ones."""
    monkeypatch.setattr(folders, "shipped_dir", lambda: tmp_path / "nothing")
    policy = tmp_path / "release/mt50-vision"
    for kind in ("target", "drafter"):
        shutil.copytree(policies / "artifacts" / kind / "nano-vision", policy / kind)
    digest = json.loads((policy / "target/target.json").read_text())["sha256"]
    monkeypatch.setitem(folders.RELEASED, "mt50-vision", digest)
    path = tmp_path / "mt50-vision.tar.gz"
    with tarfile.open(path, "w:gz") as file:
        file.add(policy, "mt50-vision")
    return path


def test_a_policy_that_the_wheel_leaves_out_is_fetched(archive, tmp_path):
    results = f"results={tmp_path}/results"
    words = ("rollout", "policy=mt50", "task=reach", results, "--plan")
    assert "kerv build policy source=mt50-vision.tar.gz" in told(*words, code=2)
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_address[1]}"
        assert "pretrained/mt50-vision" in told("build", "policy", f"source={address}/{archive.name}", results)
        assert "cannot be fetched" in told("build", "policy", f"source={address}/absent", results, code=1)
        server.shutdown()
    assert "is there already" in told("build", "policy", f"source={archive}", results, code=2)
    assert "1 task, 3 episodes" in told(*words)
    gc.collect()  # a connection that was left open is an error now, in this test


def test_another_file_than_the_one_asked_for_is_refused(archive, tmp_path, monkeypatch):
    def refused(*words, code=1):
        return told("build", "policy", f"source={archive}", f"results={tmp_path}/results", *words, code=code)

    assert "not sha256=00" in refused("sha256=00")
    monkeypatch.setitem(folders.RELEASED, "mt50-vision", "0" * 64)
    assert "another target than kerv's mt50-vision" in refused()
    monkeypatch.delitem(folders.RELEASED, "mt50-vision")
    assert f"set sha256={sha256_of(archive)}" in refused(code=2)
    archive.write_bytes(archive.read_bytes()[:-500])
    assert "no intact archive" in refused()
    assert not (tmp_path / "results/pretrained").exists()
