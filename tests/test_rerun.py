"""Recordings read back from disk: entities, timelines, values, layout, and what a failure leaves behind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader
from rerun_synthetic import DOFS, episode

from kerv_cli.decoding.record import EpisodeRecord
from kerv_cli.errors import KervError, StorageError, UsageError
from kerv_cli.rollouts import rerun_log, viewer
from kerv_cli.rollouts.rerun_log import save_episode
from kerv_cli.rollouts.viewer import find_recordings, open_recording, read_back, read_summary


def saved(record: EpisodeRecord, folder: Path, method: str = "spec_vla") -> Path:
    return save_episode(record, folder / "episode.rrd", method=method, tokens_per_step=DOFS)


def batches(path: Path, entity: str) -> list[Any]:
    chunks = RrdReader(path).stream()
    return [c.to_record_batch() for c in chunks if c.entity_path == entity and not c.is_static]


def column(path: Path, entity: str, ending: str) -> list[Any]:
    values: list[Any] = []
    for batch in batches(path, entity):
        name = next(f.name for f in batch.schema if f.name.endswith(ending))
        values += batch[name].to_pylist()
    return values


@pytest.mark.parametrize("kind", ["ar", "drafter", "mixed"])
def test_a_recording_holds_what_the_record_says(kind: str, tmp_path: Path) -> None:
    record = episode(kind, frames=16)
    path = saved(record, tmp_path)
    found = read_back(path)
    assert found["blueprint"]
    rows = found["entities"]
    assert rows["/actions"] == record.steps
    assert rows["/camera"] == rows["/world/hand"] == record.steps + 1
    decoded = ("decode/forwards", "decode/phases", "decode/table", "chunk/cells", "tokens/step_0", "tokens/step_3")
    assert {rows[f"/{name}"] for name in decoded} == {len(record.decodes)}
    changes = sum(a.mode != b.mode for a, b in zip(record.decodes, record.decodes[1:], strict=False)) + 1
    assert rows["/mode"] == changes
    assert ("/decode/threshold" in rows) == (kind != "ar")
    assert found["timelines"] == {"step": (0, record.steps), "time": (0, round(record.steps * 1e9 / 80))}
    assert found["episode"]["task"] == record.task
    assert found["episode"]["forwards"] == record.forwards
    assert found["bytes"] < 600_000


def test_values_survive_to_the_last_digit(tmp_path: Path) -> None:
    record = episode("drafter")
    path = saved(record, tmp_path)
    assert np.array_equal(np.array(column(path, "/actions", "scalars"), dtype=np.float32), record.actions)
    positions = np.array(column(path, "/world/hand", "positions"), dtype=np.float32)
    assert np.array_equal(positions[:, 0], record.path)
    forwards = [row[0] for row in column(path, "/decode/forwards", "scalars")]
    assert forwards == [d.forwards for d in record.decodes]
    steps = [step for batch in batches(path, "/decode/forwards") for step in batch["step"].to_pylist()]
    assert tuple(steps) == record.decode_steps
    total = [row[0] for row in column(path, "/decode/phases", "scalars")]
    assert total == pytest.approx([1000 * d.seconds for d in record.decodes])
    first = next(r for r in record.decodes[0].rounds if r.drafted)
    table = column(path, "/decode/table", "text")[0][0]
    assert str(first.drafted[0]) in table
    assert str(first.verdicts[0]) in table


def test_series_have_names(tmp_path: Path) -> None:
    path = saved(episode("ar"), tmp_path)
    names: list[str] = []
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == "/actions" and chunk.is_static:
            batch = chunk.to_record_batch()
            names += batch[next(f.name for f in batch.schema if f.name.endswith("names"))].to_pylist()[0]
    assert names == ["dx", "dy", "dz", "gripper"]


def test_without_frames_there_is_no_camera_and_one_step_is_enough(tmp_path: Path) -> None:
    found = read_back(saved(episode("ar", horizon=1), tmp_path))
    assert "/camera" not in found["entities"]
    assert found["timelines"]["step"] == (0, 1)


def test_a_failure_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, content: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(StorageError, match="the disk is full"):
        saved(episode("ar"), tmp_path)
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []

    def broken(record: EpisodeRecord, method: str, fps: float) -> str:
        raise RuntimeError("mistake")

    monkeypatch.setattr(rerun_log, "summary", broken)
    with pytest.raises(RuntimeError, match="mistake"):
        saved(episode("ar"), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_recording_gets_one_line(tmp_path: Path) -> None:
    path = saved(episode("drafter"), tmp_path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(KervError) as caught:
        read_back(path)
    assert "\n" not in str(caught.value)
    assert "record the episode again" in str(caught.value)


def test_finding_and_opening(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="kerv rollout"):
        find_recordings([tmp_path])
    path = saved(episode("ar"), tmp_path / "deep" / "er")
    assert find_recordings([tmp_path]) == [path]
    monkeypatch.setattr(viewer, "has_display", lambda: False)
    told = open_recording([path])
    assert "--serve-web --bind 127.0.0.1" in told
    assert path.name in told
    assert "drawer-open-v3" in read_summary(path)
