"""Two recordings in one: two methods on one seed, side by side on the same time axis."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb
from rerun.error_utils import catch_and_log_exceptions

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import write_bytes
from kerv_cli.report.viewing.blueprint import paused
from kerv_cli.report.viewing.viewer import chunks_of, read_recording

SIDES = ("left", "right")


def save_together(paths: Sequence[Path], folder: Path) -> Path:
    """Writes one recording that shows two side by side -> its path below `folder`.

    Raises:
        UsageError: not two recordings, or of different tasks or seeds: their worlds would not be the same.
        KervError: one is damaged. StorageError: the disk refused.
    """
    if len(paths) != len(SIDES):
        raise UsageError(f"--together shows two recordings, not {len(paths)}: name two .rrd files")
    contents = [read_recording(path) for path in paths]
    for key in ("task", "seed"):
        first, second = (content["episode"].get(key) for content in contents)
        if first != second:
            raise UsageError(f"--together needs the same {key} on both sides, here {first} and {second}")
    out = folder / f"{paths[0].stem}+{paths[1].stem}.rrd"
    with catch_and_log_exceptions(strict=True):
        data = _encode(paths, contents)
    write_bytes(out, data)
    return out


def _encode(paths: Sequence[Path], contents: Sequence[dict[str, Any]]) -> bytes:
    recording = rr.RecordingStream("kerv_together")
    memory = recording.memory_recording()
    episode = contents[0]["episode"]
    methods = [str(content["episode"].get("method", side)) for side, content in zip(SIDES, contents, strict=True)]
    recording.send_recording_name(f"{episode.get('task')} · seed {episode.get('seed')} · {' and '.join(methods)}")
    for side, path in zip(SIDES, paths, strict=True):
        moved = [
            chunk.with_entity_path(f"/{side}{chunk.entity_path}")
            for chunk in chunks_of(path)
            if not chunk.entity_path.startswith("/__properties")
        ]
        recording.send_chunks(moved)
    columns = [_column(side, name, content) for side, name, content in zip(SIDES, methods, contents, strict=True)]
    recording.send_blueprint(paused(rrb.Horizontal(*columns)))
    return bytes(memory.drain_as_bytes())


def _column(side: str, method: str, content: dict[str, Any]) -> rrb.Vertical:
    """One method's views: camera and path, outcomes of the tokens, forwards, time, the current decode. content: of its
    recording, see `read_recording`."""
    entities, facts = content["entities"], content["episode"]
    outcome = "success" if facts.get("success") else "failure"
    top: list[rrb.View] = [rrb.Spatial3DView(origin=f"/{side}/world", name="End effector")]
    if "/camera" in entities:
        title = f"{method}: {outcome}, {facts.get('steps')} steps"
        top.insert(0, rrb.Spatial2DView(origin=f"/{side}/camera", name=title))
    axis = rrb.TimeAxis(link="LinkToGlobal")
    lanes = [f"/{side}/{name}" for name in ("decodes", "mode", "tokens/**")]
    return rrb.Vertical(
        rrb.Horizontal(*top),
        rrb.StateTimelineView(origin="/", contents=lanes, name=f"{method}: decodes, mode, tokens", time_view=axis),
        *(
            rrb.TimeSeriesView(origin="/", contents=[f"/{side}/decode/{entity}"], name=f"{method}: {name}", axis_x=axis)
            for entity, name in (("forwards", "forwards per decode"), ("phases", "ms per decode"))
        ),
        rrb.Spatial2DView(origin=f"/{side}/chunk", name=f"{method}: current chunk", background=[13, 16, 17]),
        row_shares=[3, 4, 1.4, 1.8, 2.2],
    )
