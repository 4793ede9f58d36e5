"""A damaged plan or status is one line: it neither hangs a report nor changes its figures."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from studies_synthetic import run_cell, settings_of, threshold_settings, threshold_study

from kerv_cli.base.config import method_of_file
from kerv_cli.base.errors import CheckpointError, KervError, UnknownName
from kerv_cli.base.files import read_json, read_mapping, read_table, read_yaml, sha256_of
from kerv_cli.base.registry import part_of
from kerv_cli.lab.catalogue import find_runs
from kerv_cli.lab.store import StudyStore, is_result_of
from kerv_cli.report.curves import read_log
from kerv_cli.report.tables import load_study
from kerv_cli.report.viewing.viewer import read_recording

STATUS = {"run": "r", "workers": 1, "device_name": "test"}
_LEVELS = zip("abcdefghij", "bcdefghijk", strict=True)
BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in _LEVELS)


@pytest.fixture
def store(tmp_path: Path) -> StudyStore:
    store = StudyStore(tmp_path, "threshold")
    cells = threshold_study(["reach-v3"], episodes=2, radii=(3,))
    store.write_plan(threshold_settings(), cells)
    for cell in cells:
        store.write_cell(cell, run_cell(cell), STATUS)
    return store


def refused(store: StudyStore) -> str:
    began = time.process_time()
    with pytest.raises(CheckpointError) as caught:
        load_study(store)
    assert time.process_time() - began < 5
    message = str(caught.value)
    assert "plan.yaml is damaged" in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("baseline: ar", "baseline: nobody"),
        ("baseline: ar", "baseline: [ar]"),
        ("task: reach-v3", "task: push-v3"),
        ("label: naive_sd", "label: ar"),
        ("label: naive_sd", "label: nobody"),
        ("seeds: 100000-100001", "seeds: 100000-99999999999"),
        ("seeds: 100000-100001", "seeds: 100000-100002"),
        ("threads: 1", "threads: 0"),
        ("threads: 1", "threads: nan"),
        ("      r: 3", "      r: 4"),
        ("repeat: 0", "repeat: 1"),
        ("title:", "titel:"),
    ],
)
def test_a_changed_plan_is_refused(store: StudyStore, old: str, new: str) -> None:
    text = store.plan_path.read_text()
    assert old in text
    store.plan_path.write_text(text.replace(old, new))
    refused(store)


@pytest.mark.parametrize("name", [[], {}, None, -1, "nothing"])
def test_a_part_whose_name_is_no_text_is_unknown(name: Any) -> None:
    with pytest.raises(UnknownName, match=r"unknown skip.kind"):
        part_of("skip", name)


def test_a_training_with_a_log_of_one_endless_word_is_listed_as_damaged(tmp_path: Path) -> None:
    folder = tmp_path / "artifacts" / "target" / "mine"
    folder.mkdir(parents=True)
    (folder / "log.csv").write_text("step,loss\n1," + "[" * 200_000)
    assert [run.state for run in find_runs(str(tmp_path))] == ["damaged"]


@pytest.mark.parametrize("text", ["", "[]", "a", BOMB, "[" * 5000, "a: *nothing", "cells: 1\nlabels: 2", "\0"])
def test_what_is_no_plan_is_refused(store: StudyStore, text: str) -> None:
    store.plan_path.write_text(text)
    refused(store)


def test_a_bomb_among_the_settings_is_refused(store: StudyStore) -> None:
    text = store.plan_path.read_text()
    harmless = "      prefill_draft:\n        kind: none"
    assert harmless in text
    store.plan_path.write_text(BOMB + text.replace(harmless, "      prefill_draft: *k", 1))
    refused(store)


def test_a_damaged_plan_is_replaced_by_the_next_sweep(store: StudyStore) -> None:
    cells = store.read_plan().cells
    store.plan_path.write_text(BOMB)
    store.write_plan(threshold_settings(), cells)
    assert store.read_plan().cells == cells


def test_a_cell_knows_which_plan_it_belongs_to(store: StudyStore) -> None:
    cell = store.read_plan().cells[-1]
    config = store.read_cell(cell.id).config
    assert is_result_of(config, cell)
    assert is_result_of({**config, "study": "another", "label": "another"}, cell)
    assert not is_result_of({**config, "seeds": [1]}, cell)
    assert not is_result_of(config, replace(cell, identity={"target": "0" * 64}))
    assert not is_result_of(config, replace(cell, settings={**cell.settings, "chunk": 2}))
    assert not is_result_of({}, cell)
    assert settings_of("ar").record != 0
    assert is_result_of(config, replace(cell, settings={**cell.settings, "record": 0}))


@pytest.mark.parametrize("key", ["device_name", "run", "workers", "wall_seconds", "files"])
def test_a_status_is_sealed(store: StudyStore, key: str) -> None:
    cell = store.read_plan().cells[0]
    path = store.cells / cell.id / "status.json"
    value = json.loads(path.read_text())
    path.write_text(json.dumps({**value, key: "other"}))
    with pytest.raises(CheckpointError, match="is damaged"):
        store.has_cell(cell.id)


def test_deep_and_endless_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for text in ("[" * 100_000 + "]" * 100_000, "[" * 200 + "]" * 200, '{"a":' * 100 + "1" + "}" * 100):
        path.write_text(text)
        with pytest.raises(CheckpointError, match="cannot be read as JSON"):
            read_json(path)
    with pytest.raises(ValueError, match="more than"):
        read_yaml(BOMB)
    assert read_yaml("a: &x [1]\nb: *x") == {"a": [1], "b": [1]}


@pytest.mark.parametrize(
    "text", ["[" * 100_000 + "]" * 100_000, "- " * 100_000 + "1", "\n".join(" " * i + "a:" for i in range(3000))]
)
def test_what_is_nested_without_end_is_refused_before_a_parser_sees_it(text: str) -> None:
    with pytest.raises(ValueError, match="nested more than 1000 deep"):
        read_yaml(text)


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


def method_of(path: Path) -> object:
    link = path.with_name("link.yaml")
    link.unlink(missing_ok=True)
    link.symlink_to(path)
    return method_of_file([f"method={link}"])


@pytest.mark.parametrize("read", [read_json, read_mapping, sha256_of, read_recording])
def test_nobody_waits_for_a_pipe_or_opens_a_folder(pipe: Path, tmp_path: Path, read: Callable[[Path], object]) -> None:
    for path in (pipe, tmp_path, tmp_path / "absent"):
        with pytest.raises(KervError) as refused:
            read(path)
        assert str(path) in str(refused.value)


@pytest.mark.parametrize("read", [read_json, read_mapping, method_of])
def test_a_file_of_holes_is_not_read_whole(tmp_path: Path, read: Callable[[Path], object]) -> None:
    with (tmp_path / "a.json").open("wb") as file:
        file.truncate(3 * 2**30)
    with pytest.raises(KervError):
        read(tmp_path / "a.json")


def test_a_table_of_holes_or_of_another_kind_is_refused(tmp_path: Path, pipe: Path) -> None:
    (tmp_path / "a.parquet").write_bytes(b"PAR1" * 3)
    for path in (tmp_path / "a.parquet", tmp_path, pipe):
        with pytest.raises((OSError, ValueError)):
            read_table(path)


@pytest.mark.parametrize("text", ["", "a\n1\n", "step,loss\n: x,1\n", "step,loss\n,1\n"])
def test_a_log_without_steps_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(CheckpointError):
        read_log(tmp_path)


def test_a_status_that_is_a_list_is_damaged(store: StudyStore) -> None:
    cell = store.read_plan().cells[0]
    (store.cells / cell.id / "status.json").write_text("[1]")
    for look in (store.has_cell, store.described):
        with pytest.raises(CheckpointError, match="is damaged"):
            look(cell.id)
    assert [run.state for run in find_runs(store.root.parent.parent)] == ["2 of 3 cells"]
