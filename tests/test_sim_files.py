"""Atomic writes: a file is complete or absent, and the disk's refusals come as one line."""

import errno
import os
import re

import pytest

from kerv_cli.base.errors import CheckpointError, StorageError
from kerv_cli.base.files import atomic_path, read_json, sha256_of, write_json


def test_a_file_appears_complete_and_nothing_else_stays(tmp_path):
    path = tmp_path / "deep" / "folder" / "value.json"
    write_json(path, {"a": [1, 2.5, "ü"]})
    assert read_json(path) == {"a": [1, 2.5, "ü"]}
    assert [entry.name for entry in path.parent.iterdir()] == ["value.json"]
    assert path.stat().st_mode & 0o777 == 0o666 & ~_umask()


def _umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def write_half(path):
    with atomic_path(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt


def test_an_interrupted_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "value.txt"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt):
        write_half(path)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["value.txt"]


@pytest.mark.parametrize(
    ("number", "reason"),
    [(errno.ENOSPC, "disk is full"), (errno.EROFS, "read-only"), (errno.EACCES, "permission denied")],
)
def test_the_disks_refusal_is_one_line(tmp_path, number, reason):
    path = tmp_path / "value.bin"
    with pytest.raises(StorageError, match=f"{re.escape(str(path))}: .*{reason}$"), atomic_path(path):
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
