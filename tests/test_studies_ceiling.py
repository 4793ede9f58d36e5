"""The ceiling column against numbers worked out by hand (docs/methods.md §5)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from studies_synthetic import IDENTITY, part, settings_of, still_episode

from kerv_cli.base.settings import RolloutSettings, StudySettings
from kerv_cli.engine.record import DecodeRecord, EpisodeRecord, Round
from kerv_cli.lab.plan import Cell, plan
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.measures import MACRO, MICRO
from kerv_cli.report.summary import summary_frame
from kerv_cli.report.tables import flatten, load_study

STATUS: dict[str, Any] = {"run": "r1", "workers": 1, "device_name": "chip"}
PREFILL = Round("prefill", "none", 0, (), (1,), 0, 1, 0, ())
PLAIN = Round("decode", "none", 3, (), (1,), 0, 1, 0, ())
VERIFY = Round("verify", "drafter", 1, (5, 6), (5, 6), 2, 2, 2, (9, 9, 9, 0))
OPENED = Round("verify", "merged", 0, (4, 5, 6), (4, 5, 6, 7), 3, 4, 9, (9, 9, 9, 0))
SKIPPED = Round("skip", "retrieval", 0, (1, 2, 3, 4), (), 4, 4, 4, ())


def decode(rounds: Sequence[Round], **phases: float) -> DecodeRecord:
    """One control step of four tokens."""
    return DecodeRecord(
        tokens=(1, 2, 3, 4),
        actions=np.zeros((1, 4), np.float32),
        forwards=sum(r.mode != "skip" for r in rounds),
        rounds=tuple(rounds),
        mode="x",
        seconds=sum(phases.values()),
        phases=phases,
        skipped=rounds == [SKIPPED],
    )


# per decode: overhead 0.3, prefill 0.4, three forwards of 0.2, and 0.1 that no ceiling counts
AR = decode([PREFILL, PLAIN, PLAIN, PLAIN], vision=0.3, prefill=0.4, verify=0.6, other=0.1)
BASELINE = 0.3 + 0.4 + 3 * 0.2
DECODES = {
    "ar": [AR, AR],
    # one verification of 0.3 and one forward over the token that was left, 0.2; a decode with neither
    "kerv": [
        decode([PREFILL, VERIFY, PLAIN], vision=0.9, prefill=0.9, propose=0.3, verify=0.5),
        decode([SKIPPED], vision=0.9, propose=0.1),
    ],
    "one_pass": [decode([OPENED], vision=0.1, propose=0.3, prefill=0.45), decode([OPENED], vision=0.1, prefill=0.55)],
    "expert": [decode([], other=1e-6)],
}
EXPECTED = {
    "kerv": BASELINE / (0.3 + 0.4 + 0.3),
    "one_pass": BASELINE / (0.3 + 0.5),
}


def settings() -> dict[str, RolloutSettings]:
    found = {label: settings_of(label, 0 if label == "ar" else 9, episodes=2) for label in DECODES}
    found["one_pass"].proposer = part("proposer", "none")
    found["one_pass"].prefill_draft = part("proposer", "merged", sources=["early", "hold"])
    found["expert"].proposer = part("proposer", "none")
    found["expert"].policy.kind = "expert"
    return found


def record(cell: Cell, seed: int, slower: float = 1.0) -> EpisodeRecord:
    decodes = [
        replace(d, seconds=slower * d.seconds, phases={name: slower * s for name, s in d.phases.items()})
        for d in DECODES[cell.label.split()[0]]
    ]
    return still_episode(cell.task, seed, True, decodes)


def write(
    results: Path,
    cells: Sequence[Cell],
    slower: Mapping[str, float] | None = None,
    status: Mapping[str, Mapping[str, Any]] | None = None,
) -> pd.DataFrame:
    """The study's table; slower: factor per task, status: what differs from STATUS per label."""
    store = StudyStore(results, "best")
    for cell in cells:
        factor = (slower or {}).get(cell.task, 1.0)
        records = [record(cell, seed, factor) for seed in cell.seeds]
        store.write_cell(cell, records, {**STATUS, **(status or {}).get(cell.label, {})})
    store.write_plan(StudySettings("best", "", cells[0].label), cells)
    return load_study(store).table


def ceilings(table: pd.DataFrame, averaging: str = MICRO) -> dict[str, float]:
    rows = table[table["averaging"] == averaging]
    return dict(zip(rows["label"], rows["ceiling"], strict=True))


def test_by_hand(tmp_path: Path) -> None:
    table = write(tmp_path, plan(settings(), ["reach-v3"], IDENTITY, baseline="ar"))
    found = ceilings(table)
    assert {label: found[label] for label in EXPECTED} == pytest.approx(EXPECTED)
    assert math.isnan(found["ar"])
    assert math.isnan(found["expert"])


def test_summaries_show_it_beside_the_speedup(tmp_path: Path) -> None:
    table = write(tmp_path, plan(settings(), ["reach-v3"], IDENTITY, baseline="ar"))
    frame = summary_frame(table)
    columns = list(frame.columns)
    assert columns[columns.index("per step") + 1] == "ceiling"
    assert dict(zip(frame["setting"], frame["ceiling"], strict=True)) == {
        "ar": "–",
        "kerv": "1.30",
        "one_pass": "1.62",
        "expert": "–",
    }
    only_ar = table[table["label"] == "ar"]
    assert "ceiling" not in summary_frame(only_ar).columns


def test_the_expert_has_no_speedup(tmp_path: Path) -> None:
    table = write(tmp_path, plan(settings(), ["reach-v3"], IDENTITY, baseline="ar"))
    rows = table[table["label"] == "expert"]
    assert rows["speedup"].isna().all()
    assert (rows["success"] == 1.0).all()
    assert set(rows["policy.kind"]) == {"expert"}
    assert (rows["pairs"] == 2).all()


def test_an_expert_that_is_called_ar_is_no_reference(tmp_path: Path) -> None:
    chosen = settings()
    chosen["expert"].method = "ar"
    cells = plan({"expert": chosen["expert"], "kerv": chosen["kerv"]}, ["reach-v3"], IDENTITY)
    assert all(math.isnan(value) for value in ceilings(write(tmp_path, cells)).values())


def test_macro_takes_the_ratio_of_the_groups_means(tmp_path: Path) -> None:
    cells = plan(settings(), ["reach-v3", "push-v3"], IDENTITY, baseline="ar")  # easy and hard
    slow = [c for c in cells if c.task == "push-v3" and c.label == "one_pass"]
    table = write(tmp_path, [c for c in cells if c not in slow], {"push-v3": 3.0})
    # kerv: a factor in common cancels; one_pass has one group only
    assert ceilings(table, MACRO)["kerv"] == pytest.approx(EXPECTED["kerv"])
    assert ceilings(table, MACRO)["one_pass"] == pytest.approx(EXPECTED["one_pass"])
    assert ceilings(table, MICRO)["one_pass"] == pytest.approx(EXPECTED["one_pass"])


def test_longer_chunks_count_per_control_step(tmp_path: Path) -> None:
    chosen = {}
    for steps in (4, 8):
        for label in ("ar", "kerv"):
            chosen[f"{label} chunk={steps}"] = replace(settings()[label], chunk=steps)
    found = ceilings(write(tmp_path, plan(chosen, ["reach-v3"], IDENTITY, baseline="ar chunk=4")))
    assert found["kerv chunk=4"] == pytest.approx(EXPECTED["kerv"])
    assert found["kerv chunk=8"] == pytest.approx(2 * EXPECTED["kerv"])
    assert math.isnan(found["ar chunk=8"])


def test_another_target_or_device_gives_none(tmp_path: Path) -> None:
    first = settings()
    cells = plan({"ar": first["ar"]}, ["reach-v3"], IDENTITY)
    cells += plan({"kerv": first["kerv"]}, ["reach-v3"], {**IDENTITY, "target": "c" * 64})
    cells += plan({"one_pass": first["one_pass"]}, ["reach-v3"], IDENTITY)
    found = ceilings(write(tmp_path, cells, status={"one_pass": {"device_name": "another chip"}}))
    assert all(math.isnan(value) for value in found.values())


def test_flatten() -> None:
    assert flatten({"prefill_draft": {"sources": ["early", "hold"]}, "skip": {"s_min": None}, "chunk": 4}) == {
        "prefill_draft.sources": "early;hold",
        "skip.s_min": None,
        "chunk": 4,
    }
    assert flatten({"prefill_draft": {"sources": []}}) == {"prefill_draft.sources": ""}
