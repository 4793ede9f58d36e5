"""A file or folder is complete or absent; what dead processes leave is removed, what the living own stays."""

import errno
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from kerv_cli.base import files
from kerv_cli.base.errors import CheckpointError, StorageError
from kerv_cli.base.files import (
    atomic_path,
    clean,
    read_json,
    sha256_of,
    temporary_beside,
    write_bytes,
    write_folder,
    write_json,
)
from kerv_cli.targets.checkpoint import Description, read_description, save_module


def test_the_next_write_removes_what_a_killed_one_left(tmp_path, monkeypatch):
    left = temporary_beside(tmp_path / "cell")
    left.mkdir()
    (left / "file").touch()
    (tmp_path / ".theirs.tmp").mkdir()  # another program's
    write_json(tmp_path / "a.json", 1)
    assert left.is_dir()  # perhaps its process lives
    monkeypatch.setattr(files, "LEFT_OVER_SECONDS", -1)
    files._clean_once.cache_clear()
    write_json(tmp_path / "b.json", 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".theirs.tmp", "a.json", "b.json"]


def write(folder: Path, text: str) -> None:
    write_folder(folder, lambda new: (new / "file").write_text(text))


@pytest.fixture
def store(tmp_path):
    """A folder that holds "old"."""
    write(tmp_path / "store", "old")
    return tmp_path / "store"


def assert_alone(store: Path, text: str) -> None:
    """It holds this text, and nothing is beside it."""
    assert (store / "file").read_text() == text
    assert [path.name for path in store.parent.iterdir()] == ["store"]


def test_a_folder_is_exchanged_in_one_step(store, monkeypatch):
    renames: list[object] = []
    rename = os.rename
    monkeypatch.setattr(os, "rename", lambda a, b: (renames.append(a), rename(a, b)))
    write(store, "new")
    assert_alone(store, "new")
    assert renames == []  # no moment without a folder


def test_where_folders_cannot_be_exchanged_two_renames_do(store, monkeypatch):
    monkeypatch.setattr(files.ctypes, "CDLL", lambda name, use_errno: object())
    write(store, "new")
    assert_alone(store, "new")


def fail(folder: Path) -> None:
    (folder / "file").write_text("half")
    raise KeyboardInterrupt


def test_a_folder_that_fails_leaves_the_old_one(store):
    with pytest.raises(KeyboardInterrupt):
        write_folder(store, fail)
    assert_alone(store, "old")


SIGKILLED = """
import os, signal, sys
from pathlib import Path
from kerv_cli.base import files
calls = {"sync": 0}
sync = files.sync
def counted(path):
    calls["sync"] += 1
    if calls["sync"] == int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGKILL)
    sync(path)
files.sync = counted
files.write_folder(Path(sys.argv[1]), lambda new: (new / "file").write_text("new"))
"""


@pytest.mark.parametrize("moment", [1, 2, 3])
def test_a_kill_while_a_folder_is_replaced_leaves_a_whole_one(store, moment, monkeypatch):
    run = subprocess.run([sys.executable, "-c", SIGKILLED, str(store), str(moment)], check=False)
    assert run.returncode < 0
    assert (store / "file").read_text() == ("new" if moment == 3 else "old")
    assert len(list(store.parent.glob(".*.tmp"))) == 1
    write(store, "newest")
    monkeypatch.setattr(files, "LEFT_OVER_SECONDS", -1)
    clean(store.parent)
    assert_alone(store, "newest")


# --- sim files


def test_a_file_appears_complete_and_nothing_else_stays(tmp_path):
    path = tmp_path / "deep" / "folder" / "value.json"
    write_json(path, {"a": [1, 2.5, "ü"]})
    assert read_json(path) == {"a": [1, 2.5, "ü"]}
    assert [entry.name for entry in path.parent.iterdir()] == ["value.json"]
    umask = os.umask(0)
    os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask


def test_an_interrupted_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "value.txt"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_path(path) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["value.txt"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_the_disks_refusal_is_one_line(tmp_path, number):
    path = tmp_path / "value.bin"
    with pytest.raises(StorageError, match=f"{re.escape(str(path))}: {os.strerror(number)}$"), atomic_path(path):
        raise OSError(number, os.strerror(number))
    assert list(tmp_path.iterdir()) == []


def test_json_has_no_nan(tmp_path):
    with pytest.raises(ValueError):  # noqa: PT011
        write_json(tmp_path / "value.json", float("nan"))
    assert list(tmp_path.iterdir()) == []


def test_unreadable_files_are_checkpoint_errors(tmp_path):
    (tmp_path / "bad.json").write_text("{")
    for read, name in ((read_json, "none.json"), (read_json, "bad.json"), (sha256_of, "none.bin")):
        with pytest.raises(CheckpointError, match=name):
            read(tmp_path / name)


def test_an_interrupted_removal_ends_nothing(tmp_path, monkeypatch):
    def interrupted(path, missing_ok=False):
        raise InterruptedError(errno.EINTR, "Interrupted system call")

    monkeypatch.setattr(Path, "unlink", interrupted)
    write_bytes(tmp_path / "state", b"new")
    assert (tmp_path / "state").read_bytes() == b"new"
    with pytest.raises(ValueError, match="diverged"), atomic_path(tmp_path / "state"):
        raise ValueError("diverged")


def test_a_checkpoint_is_the_old_one_or_the_new_one(tmp_path, monkeypatch):
    folder = tmp_path / "drafter"
    save_module(folder, "drafter", torch.nn.Linear(2, 2), {})
    (folder / "log.csv").write_text("step")
    before = read_description(folder, "drafter", Description)
    with monkeypatch.context() as patch:
        patch.setattr("kerv_cli.targets.checkpoint.write_json", lambda *_: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            save_module(folder, "drafter", torch.nn.Linear(2, 2), {})
    assert read_description(folder, "drafter", Description) == before
    digest = save_module(folder, "drafter", torch.nn.Linear(2, 2), {})
    assert read_description(folder, "drafter", Description).sha256 == digest != before.sha256
    assert sorted(path.name for path in folder.parent.rglob("*")) == [
        "drafter", "drafter.json", "log.csv", "model.safetensors"
    ]  # fmt: skip
