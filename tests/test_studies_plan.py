"""Cells: what makes them differ, in which order they run, how a plan is stored."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from studies_synthetic import IDENTITY, settings_of, threshold_settings, threshold_study

import kerv_cli
from kerv_cli.base.errors import UsageError
from kerv_cli.base.settings import RolloutSettings
from kerv_cli.lab.code import code_hash
from kerv_cli.lab.identity import ENGINE, hash_of, work_of
from kerv_cli.lab.plan import (
    StudyPlan,
    blocks_of,
    merge_plans,
    parse_seeds,
    plan,
    plan_from_text,
    plan_text,
    seeds_text,
    unique_cells,
)


def only_id(settings: RolloutSettings, task: str = "reach-v3", identity: dict[str, str] | None = None) -> str:
    (cell,) = plan({"x": settings}, [task], identity or IDENTITY)
    return cell.id


def changed(path: str, value: Any) -> RolloutSettings:
    settings = settings_of("spec_vla", 9)
    part: Any = settings
    *groups, name = path.split(".")
    for group in groups:
        part = getattr(part, group)
    assert getattr(part, name) != value
    setattr(part, name, value)
    return settings


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("proposer.kind", "hold"),
        ("proposer.depth", 3),
        ("acceptance.strict_dofs", False),
        ("threshold.r", 5),
        ("rectifier.kind", "compensate"),
        ("boundary.kind", "fused"),
        ("world.horizon", 200),
        ("world.camera.size", 64),
        ("runtime.device", "cuda"),
        ("runtime.dtype", "bfloat16"),
        ("runtime.threads", 2),
        ("deviation_every", 4),
        ("seed", 100_001),
        ("episodes", 5),
    ],
)
def test_what_determines_the_result_changes_the_id(path: str, value: Any) -> None:
    assert only_id(changed(path, value)) != only_id(settings_of("spec_vla", 9))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("runtime.workers", 2),
        ("runtime.executor", "slurm"),
        ("runtime.executor_options", {"partition": "p"}),
        ("results", "elsewhere"),
        ("record", -1),
        ("record_size", 480),
        ("method", "other_name"),
        ("policy.target", "same-weights-elsewhere"),
        ("task", ["push-v3"]),
        ("rollout.latency_ms", 5.0),
    ],
)
def test_what_does_not_determine_the_result_leaves_the_id(path: str, value: Any) -> None:
    assert only_id(changed(path, value)) == only_id(settings_of("spec_vla", 9))


def test_task_and_weights_change_the_id_and_code_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_of("ar")
    before = only_id(settings)
    assert only_id(settings, task="push-v3") != before
    assert only_id(settings, identity={**IDENTITY, "drafter": "c" * 64}) != before
    with monkeypatch.context() as other:
        other.setattr("kerv_cli.lab.code.code_hash", lambda: "f" * 64)
        assert only_id(settings) == before
    assert work_of(asdict(settings), IDENTITY, engine=ENGINE + 1) != work_of(asdict(settings), IDENTITY)


def test_id_is_the_hash_of_canonical_json() -> None:
    expected = hashlib.sha256(b'{"a":1,"b":{"c":[1,2],"d":null}}').hexdigest()[:16]
    assert hash_of({"b": {"d": None, "c": [1, 2]}, "a": 1}) == expected
    with pytest.raises(ValueError, match="JSON compliant"):
        hash_of({"a": float("nan")})


def test_a_device_that_two_machines_resolve_differently_is_refused() -> None:
    with pytest.raises(ValueError, match=r"runtime\.device"):
        only_id(changed("runtime.device", "auto"))


def test_tasks_in_turn_and_the_baseline_first() -> None:
    settings = {"a": settings_of("spec_vla", 3), "ar": settings_of("ar"), "b": settings_of("spec_vla", 9)}
    cells = plan(settings, ["reach-v3", "push-v3"], IDENTITY, baseline="ar")
    assert [(c.task, c.label) for c in cells] == [
        (task, label) for task in ("reach-v3", "push-v3") for label in ("ar", "a", "b")
    ]
    assert cells[0].seeds == (100_000, 100_001, 100_002, 100_003)
    assert cells[3].settings["task"] == ["push-v3"]


def test_seeds_come_in_blocks_and_repeats_are_cells_of_their_own() -> None:
    settings = {"ar": settings_of("ar", episodes=7), "b": settings_of("spec_vla", 9, episodes=7)}
    cells = plan(settings, ["reach-v3", "push-v3"], IDENTITY, block=3, repeats=2)
    assert len({cell.id for cell in cells}) == len(cells) == 2 * 2 * 2 * 3
    blocks = blocks_of(cells)
    assert [(b.task, len(b.seeds), b.repeat) for b in blocks[:3]] == [("reach-v3", n, 0) for n in (3, 3, 1)]
    assert [b.seeds[0] for b in blocks[:3]] == [100_000, 100_003, 100_006]
    assert [b.task for b in blocks[::3]] == ["reach-v3", "push-v3"] * 2
    assert all([cell.label for cell in block.cells] == ["ar", "b"] for block in blocks)
    assert blocks[0].name == "reach-v3 100000-100002"
    assert blocks[-1].name == "push-v3 100006 repeat 1"


def test_a_plan_is_counted_before_it_is_made() -> None:
    settings = {"ar": settings_of("ar", episodes=1_000_000)}
    with pytest.raises(UsageError, match="the study has 200000 cells: at most 100000"):
        plan(settings, ["reach-v3"], IDENTITY, block=5)


def test_what_differs_in_threads_cannot_take_turns_in_one_process() -> None:
    cells = plan({"a": settings_of("ar"), "b": changed("runtime.threads", 2)}, ["reach-v3"], IDENTITY)
    assert [len(block.cells) for block in blocks_of(cells)] == [1, 1]


def test_the_code_below_the_commands_counts_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(Path(kerv_cli.__file__).parent, tmp_path / "kerv_cli")
    monkeypatch.setattr(kerv_cli, "__file__", str(tmp_path / "kerv_cli" / "__init__.py"))

    def hash_after(file: str, more: str) -> str:
        path = tmp_path / "kerv_cli" / file
        path.write_text(f"{path.read_text()}\n{more}\n")
        return code_hash.__wrapped__()

    before = code_hash.__wrapped__()
    assert hash_after("report/tables.py", "x = 1") == hash_after("cli/sweep.py", "x = 1") == before
    assert hash_after("base/settings.py", '# a comment\n"""and a string that stands alone"""\n') == before
    computing = [hash_after(file, "x = 1") for file in ("engine/decoder.py", "base/settings.py", "lab/run.py")]
    assert len({before, *computing}) == 4


def test_settings_may_have_weights_of_their_own() -> None:
    settings = {"a": settings_of("ar"), "b": settings_of("ar")}
    settings["b"].policy.target = "other"
    cells = plan(settings, ["reach-v3"], lambda label: {"target": settings[label].policy.target})
    assert [c.identity["target"] for c in cells] == ["mt10-vision", "other"]
    assert cells[0].id != cells[1].id


def test_two_labels_of_one_result_are_one_cell() -> None:
    cells = plan({"a": settings_of("ar"), "b": settings_of("ar")}, ["reach-v3"], IDENTITY)
    assert cells[0].id == cells[1].id
    assert [c.label for c in unique_cells(cells)] == ["a"]


@pytest.mark.parametrize(("seeds", "text"), [((5, 6, 7, 9), "5-7;9"), ((3,), "3"), ((2, 1), "1-2")])
def test_seeds_as_ranges_and_back(seeds: tuple[int, ...], text: str) -> None:
    assert seeds_text(seeds) == text
    assert parse_seeds(text) == tuple(sorted(seeds))


def study_plan(tasks: list[str], **settings: Any) -> StudyPlan:
    study = threshold_settings()
    return StudyPlan(study.name, study.title, study.baseline, study.axis, tuple(threshold_study(tasks, **settings)))


def test_plan_file_holds_the_plan() -> None:
    original = study_plan(["reach-v3", "push-v3"])
    text = plan_text(original)
    assert plan_from_text(text) == original
    json.dumps(original.cells[0].settings)  # plain values only


def test_a_plan_with_fewer_episodes_keeps_those_of_the_tasks_that_it_does_not_name() -> None:
    new = study_plan(["push-v3"], episodes=2)
    merged = merge_plans(study_plan(["reach-v3"]), new)
    assert {(cell.task, cell.seeds) for cell in merged.cells} == {
        ("reach-v3", (100_000, 100_001)),
        ("push-v3", (100_000, 100_001)),
    }


def test_a_changed_setting_replaces_only_its_own_cells() -> None:
    old, new = study_plan(["reach-v3"]), study_plan(["push-v3"])
    cells = [
        c if c.label != "naive_sd" else replace(plan({"naive_sd": settings_of("ar")}, [c.task], IDENTITY)[0])
        for c in new.cells
    ]
    merged = merge_plans(old, replace(new, cells=tuple(cells)))
    kept = {c.label for c in merged.cells if c.task == "reach-v3"}
    assert kept == {"ar", "spec_vla r=3", "spec_vla r=9"}
