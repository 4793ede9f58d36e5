"""Rows of everything that was begun, and which database holds them."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from command import told

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.lab.command import STORE
from kerv_cli.lab.database import Database
from kerv_cli.lab.runs import making, run_rows
from kerv_cli.training.demonstrations import open_demos

HOLD = """
import sys
from pathlib import Path
from kerv_cli.lab.command import noted
from kerv_cli.lab.runs import making
results = Path(sys.argv[1])
words = ["demos", "name=mine", "episodes=7", f"results={results}"]
with noted(words), making(results, "demos", results / "artifacts/demos/mine") as record:
    record.beat(3, 7)
    print("begun", flush=True)
    sys.stdin.read()
"""


def listed(results: Path) -> list[dict[str, Any]]:
    return json.loads(told("runs", "list", f"results={results}", "--json"))


def test_a_name_in_use_is_refused_and_a_killed_command_is_listed_with_how_to_go_on(tmp_path):
    again = "kerv demos name=mine episodes=7 results="
    place = tmp_path / "artifacts/demos/mine"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "begun\n"
        line = told("demos", "name=mine", "task=reach", f"results={tmp_path}", code=2)
        assert f"demos mine is being made by process {process.pid}" in line
        assert listed(tmp_path)[0]["state"] == "running, 3 of 7"
        assert "is running" in told("runs", "rm", "demos/mine", "--yes", f"results={tmp_path}", code=2)
        process.kill()
    with pytest.raises(UsageError), making(tmp_path, "demos", place, ["demos", "name=mine", "episodes=8"]):
        raise UsageError("these are others")
    (row,) = listed(tmp_path)
    assert (row["id"], row["state"], row["command"][:2]) == ("demos/mine", "interrupted, 3 of 7", ["kerv", "demos"])
    assert again in told("runs", "show", "demos/mine", f"results={tmp_path}")
    assert again in told("runs", "rerun", "demos/mine", f"results={tmp_path}", code=2)
    place.mkdir(parents=True)
    (place / "recording.json").write_text("{}")
    with pytest.raises(CheckpointError, match=again):
        open_demos(str(tmp_path), "mine")
    told("runs", "rm", "demos/mine", "--yes", f"results={tmp_path}")
    assert listed(tmp_path) == []


def test_a_store_is_used_by_one_command_and_no_password_is_kept(tmp_path, monkeypatch):
    monkeypatch.delenv(STORE, raising=False)
    other, where = Database(tmp_path, f"sqlite:///{tmp_path}/other.db"), f"results={tmp_path}"
    told("build", "target", f"checkpoint={tmp_path}", f"store={other.url}", where, code=1)
    assert [row.status for row in run_rows(other)] == ["failed"]
    assert run_rows(Database(tmp_path)) == []
    assert STORE not in os.environ
    store = "store=postgresql://me:secret@127.0.0.1:1/kerv"
    assert "store: postgresql://me@127.0.0.1:1/kerv" in told("build", "target", store, "--cfg")
    line = told("runs", "list", store, where, code=1)
    assert "127.0.0.1:1" in line
    assert "secret" not in line
    for url in ("nonsense", "mysql://server/kerv", "postgresql://kerv@host:port/kerv"):
        assert "postgresql://USER@HOST/DB" in told("runs", "list", f"store={url}", where, code=2)
