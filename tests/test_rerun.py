"""Recordings read back from disk: entities, timelines, values, layout, and what a failure leaves behind."""

import os
import shlex
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused
from examples.insertion import SPEC as INSERTION
from rerun.chunk import RrdReader
from rerun_synthetic import DOFS, decode_of, episode, prefill, read_recording, verify

from kerv_cli.base.errors import KervError, StorageError, UsageError
from kerv_cli.engine.record import EpisodeRecord, Round
from kerv_cli.report.viewing import save_recording, viewer
from kerv_cli.report.viewing.token_outcomes import chunk_size, outcomes_of, readable
from kerv_cli.report.viewing.viewer import MOST_OPENED, find_recordings, open_recording, read_chunks


def saved(record: EpisodeRecord, folder: Path, method: str = "spec_vla") -> Path:
    return save_recording(record, folder / "episode.rrd", method=method)


def batches(path: Path, entity: str) -> list[Any]:
    chunks = RrdReader(path).stream()
    return [c.to_record_batch() for c in chunks if c.entity_path == entity and not c.is_static]


def column(path: Path, entity: str, ending: str) -> list[Any]:
    values: list[Any] = []
    for batch in batches(path, entity):
        name = next(f.name for f in batch.schema if f.name.endswith(ending))
        values += batch[name].to_pylist()
    return values


def named(path: Path, entity: str) -> list[str]:
    """Names of an entity's series."""
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and "SeriesLines:names" in batch.schema.names:
            return list(batch["SeriesLines:names"].to_pylist()[0])
    return []


def strings(value: Any) -> Iterator[str]:
    """Every text inside nested lists and dicts."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from strings(inner)


@pytest.mark.parametrize("kind", ["ar", "drafter", "mixed"])
def test_a_recording_holds_what_the_record_says(kind, tmp_path):
    record = episode(kind, frames=16)
    record = replace(record, places={"goal": np.zeros_like(record.path)})
    path = saved(record, tmp_path)
    found = read_recording(path)
    assert found["blueprint"]
    rows = found["entities"]
    assert rows["/actions"] == record.steps
    assert rows["/camera"] == rows["/world/hand"] == rows["/world/goal"] == record.steps + 1
    decoded = ("decode/forwards", "decode/phases", "decode/table", "decodes", "tokens/step_0/dx")
    assert {rows[f"/{name}"] for name in decoded} == {len(record.decodes)}
    changes = sum(a.mode != b.mode for a, b in zip(record.decodes, record.decodes[1:], strict=False)) + 1
    assert rows["/mode"] == changes
    assert ("/decode/threshold" in rows) == (kind != "ar")
    assert found["timelines"] == {"step": (0, record.steps), "time": (0, round(record.steps * 1e9 / 80))}
    assert found["episode"]["task"] == record.task
    assert found["episode"]["forwards"] == record.forwards
    assert path.stat().st_size < 600_000


def test_seven_dofs_have_their_names_and_limits(tmp_path):
    limits = (9, 9, 9, 5, 5, 5, 0)
    tokens = tuple(range(50, 64))
    rounds = (prefill(50), verify(1, tokens[1:13], tokens[1:], 12, limits))
    actions = np.linspace([-0.01] * 7, [0.01] * 7, 2, dtype=np.float32)
    decode = replace(decode_of(tokens, rounds, 2), actions=actions)
    record = replace(
        episode("ar", horizon=2), space=INSERTION.actions, decodes=(decode,), decode_steps=(0,), actions=actions
    )
    path = saved(record, tmp_path)
    assert named(path, "/actions") == list(INSERTION.actions.names)
    assert named(path, "/decode/threshold") == [f"r {name}" for name in INSERTION.actions.names]
    first = [column(path, f"/tokens/step_0/{name}", "state")[0][0] for name in INSERTION.actions.names]
    assert first == ["target", *["accepted"] * 6]
    assert "| 7 | 1 | dx | 57 | 57 | 9 | 57 | ✓ accepted |" in column(path, "/decode/table", "text")[0][0]
    assert read_recording(path)["timelines"]["time"] == (0, 100_000_000)


def test_values_survive_to_the_last_digit(tmp_path):
    record = episode("drafter")
    path = saved(record, tmp_path)
    assert np.array_equal(np.array(column(path, "/actions", "scalars"), dtype=np.float32), record.actions)
    positions = np.array(column(path, "/world/hand", "positions"), dtype=np.float32)
    assert np.array_equal(positions[:, 0], record.path)
    forwards = [row[0] for row in column(path, "/decode/forwards", "scalars")]
    assert forwards == [d.forwards for d in record.decodes]
    starts = [step for batch in batches(path, "/decode/forwards") for step in batch["step"].to_pylist()]
    assert tuple(starts) == record.decode_steps
    total = [row[0] for row in column(path, "/decode/phases", "scalars")]
    assert total == pytest.approx([1000 * d.seconds for d in record.decodes])
    first = next(r for r in record.decodes[0].rounds if r.drafted)
    table = column(path, "/decode/table", "text")[0][0]
    assert str(first.drafted[0]) in table
    assert str(first.target_tokens[0]) in table


def test_a_failure_leaves_no_file(tmp_path, monkeypatch):
    def full(path, content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(StorageError):
        saved(episode("ar"), tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("share", [0.01, 0.99])
def test_a_damaged_recording_gets_one_line(share, tmp_path):
    path = saved(episode("drafter"), tmp_path)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    with refused("record the episode again"):
        read_chunks(path)


def test_every_place_of_a_chunk_has_its_outcome():
    target_tokens = (60, 70, 80, 90, 100, 110, 120)
    rounds = (prefill(50), verify(1, (60, 73, 99), target_tokens[:3], 2), verify(4, (90, 101), target_tokens[3:6], 2))
    decode = decode_of((50, 60, 73, 80, 90, 101, 110, 128), rounds, 2, compensated=1)
    outcomes = outcomes_of(decode, 12, DOFS)
    names = ["target", "accepted", "relaxed", "rejected", "accepted", "relaxed", "bonus", "compensated"]
    assert [f.kind for f in outcomes] == [*names, *["dropped"] * 4]
    assert outcomes[3].token == 80
    assert [f.limit for f in outcomes[1:6]] == [9, 9, 0, 9, 9]


def test_a_rejection_stays_visible_whoever_fills_the_place():
    refused = Round("verify", "drafter", 1, (60, 99), (60, 70), 1, 1, 20, (9,))
    filled = decode_of((50, 60, 128, 128), (prefill(50), refused), 1, compensated=2)
    assert [f.kind for f in outcomes_of(filled, 8, DOFS)[:4]] == ["target", "accepted", "rejected", "compensated"]
    # the papers' preset takes the target token back: the place is predicted too, and the tokens end before it
    taken_back = decode_of((50, 60), (prefill(50), refused), 1, compensated=2, size=8)
    assert [f.kind for f in outcomes_of(taken_back, 8, DOFS)] == ["target", "accepted", "rejected", "compensated"] + [
        "dropped"
    ] * 4
    assert [f.token for f in outcomes_of(taken_back, 4, DOFS)] == [50, 60, None, None]
    # two steps were verified, one was executed: the second is dropped, but the place of the rejection is kept
    cut = decode_of((50, 60, 70, 80, 90), (prefill(50), verify(1, (60, 70, 80, 90, 9), (60, 70, 80, 90, 99), 4)), 1)
    assert [f.kind for f in outcomes_of(cut, 8, DOFS)[4:]] == ["dropped", "rejected", "dropped", "dropped"]


@pytest.mark.parametrize("kind", ["ar", "drafter", "mixed"])
def test_drawn_tokens_add_up_with_the_records(kind):
    for decode in episode(kind).decodes:
        size = chunk_size([decode], DOFS)
        assert size == 16
        outcomes = [f.kind for f in outcomes_of(decode, size, DOFS)]
        rounds = [r for r in decode.rounds if r.tree_size and r.mode != "skip"]
        assert outcomes.count("accepted") + outcomes.count("relaxed") == sum(r.accepted for r in rounds)
        assert outcomes.count("rejected") == sum(r.accepted < len(r.drafted) for r in rounds)
        assert outcomes.count("compensated") == decode.compensated
        first = outcomes.index("rejected") if "rejected" in outcomes else None
        assert first is None or decode.first_rejected in (first, decode.size)


@pytest.mark.parametrize(
    ("kind", "frames", "present", "absent"),
    [
        ("ar", 0, {"Per decode"}, {"Camera", "Acceptance threshold r, bins", "deviation from AR"}),
        ("drafter", 16, {"Camera", "Acceptance threshold r, bins", "K, kinematic variability"}, set()),
    ],
)
def test_the_layout_shows_what_there_is(kind, frames, present, absent, tmp_path):
    path = saved(episode(kind, frames=frames), tmp_path)
    reader = RrdReader(path)
    (layout,) = reader.blueprints()
    assert layout.application_id == reader.recordings()[0].application_id == "kerv_spec_vla"
    views: set[str] = set()
    states: list[Any] = []
    for chunk in reader.stream(store=layout):
        batch = chunk.to_record_batch()
        for field in batch.schema:
            if field.name == "ViewBlueprint:display_name":
                views |= {row[0] for row in batch[field.name].to_pylist()}
            elif field.name.endswith("play_state"):
                states += batch[field.name].to_pylist()
    assert {"Current decode", "Episode"} | present <= views
    assert not absent & views
    assert states == [[1]]  # paused


def test_texts_hold_only_what_the_viewers_font_has(tmp_path):
    record = replace(episode("mixed", horizon=12), instruction="open the 🟩 抽屉\ndrawer")
    path = saved(record, tmp_path, method="spéc 🚀")
    reader = RrdReader(path)
    assert reader.recordings()[0].application_id == "kerv_sp_c_"
    texts = [t for c in reader.stream() for t in strings(c.to_record_batch().to_pydict())]
    assert any("open the ? ???drawer" in t for t in texts)
    assert all(line == readable(line) for t in texts for line in t.splitlines())


def test_the_newest_recordings_come_first_and_not_all_are_opened(tmp_path, monkeypatch):
    first = saved(episode("ar", horizon=4), tmp_path / "deep")
    for i in range(MOST_OPENED + 3):
        copy = tmp_path / f"copy{i:02d}.rrd"
        copy.write_bytes(first.read_bytes())
        os.utime(copy, (1_000_000 + i, 1_000_000 + i))
    found = find_recordings([tmp_path, first])
    assert (found[0], found[1].name, len(found)) == (first, f"copy{MOST_OPENED + 2:02d}.rrd", MOST_OPENED + 4)
    monkeypatch.setattr(viewer, "has_display", lambda: False)
    assert f"the newest {MOST_OPENED} of {MOST_OPENED + 4}" in open_recording(found)
    assert "rerun episode.rrd" in open_recording([first])


def test_without_a_display_recordings_of_two_runs_can_be_copied_to_one_folder(tmp_path, monkeypatch):
    path = saved(episode("ar", horizon=4), tmp_path / "one run/rollouts")
    other = tmp_path / "other/rollouts" / path.name
    other.parent.mkdir(parents=True)
    other.write_bytes(path.read_bytes())
    monkeypatch.setattr(viewer, "has_display", lambda: False)
    _, *copies, opens = (shlex.split(line) for line in open_recording([path, other]).splitlines())
    assert [Path(source.partition(":")[2]) for _, source, _ in copies] == [path, other]
    assert opens == ["rerun", *(name for *_, name in copies)]
    assert len(set(opens)) == 3


@pytest.mark.parametrize("name", ["nowhere.rrd", "notes.txt", ""])
def test_what_is_no_recording_is_refused(tmp_path, name):
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(UsageError):
        find_recordings([tmp_path / name])
    with pytest.raises(KervError):
        read_chunks(tmp_path / "gone.rrd")


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-in is a shell script")
def test_the_viewer_is_started_and_left_alone_or_says_why_not(tmp_path, monkeypatch):
    path, asked, program = saved(episode("ar", horizon=4), tmp_path), tmp_path / "asked", tmp_path / "rerun"
    monkeypatch.setattr(viewer, "has_display", lambda: True)
    monkeypatch.setattr(viewer, "_START_SECONDS", 0.3)
    monkeypatch.setattr(viewer, "viewer_command", lambda: [str(program)])
    program.write_text("#!/bin/sh\necho starting; echo 'no graphics here' >&2; exit 3\n")
    program.chmod(0o755)
    with pytest.raises(KervError, match="no graphics here"):
        open_recording([path])
    program.write_text(f'#!/bin/sh\necho "$@" > {asked}; sleep 0.6\n')
    assert open_recording([path]) == "opened episode.rrd in the Rerun viewer"
    assert asked.read_text().split() == ["--bind", "127.0.0.1", str(path)]
