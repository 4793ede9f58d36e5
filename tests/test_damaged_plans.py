"""A damaged plan or status is one line: it neither hangs a report nor changes its figures."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from studies_synthetic import run_cell, settings_of, threshold_settings, threshold_study

from kerv_cli.base.errors import CheckpointError, UnknownName
from kerv_cli.base.registry import part_of
from kerv_cli.lab.store import StudyStore, is_result_of
from kerv_cli.report.tables import load_study

STATUS = {"run": "r", "workers": 1, "device_name": "test"}


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


@pytest.mark.parametrize("text", ["", "[]", "a", "a: *nothing", "cells: 1\nlabels: 2", "\0"])
def test_what_is_no_plan_is_refused(store: StudyStore, text: str) -> None:
    store.plan_path.write_text(text)
    refused(store)


def test_a_damaged_plan_is_replaced_by_the_next_sweep(store: StudyStore) -> None:
    cells = store.read_plan().cells
    store.plan_path.write_text("a: *nothing")
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
