"""Encodes an EpisodeRecord as an .rrd file for the Rerun viewer.

The recording is encoded in memory and written atomically: Rerun's file sink waits forever on a full disk. Timelines:
`step` (control steps) and `time` (simulated seconds). A row of an entity belongs to a control step, or to a decode, at
the control step at which its actions begin.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from PIL import Image
from rerun.error_utils import catch_and_log_exceptions

from kerv_cli.base.registry import parts
from kerv_cli.engine.record import PHASES, DecodeRecord, EpisodeRecord
from kerv_cli.report.viewing.blueprint import (
    SIGNALS,
    STEP,
    TIME,
    blueprint,
)
from kerv_cli.report.viewing.facts import facts_of, readable, summary
from kerv_cli.report.viewing.token_outcomes import (
    OUTCOMES,
    Chunks,
    acceptance,
    chunk_size,
    decode_table,
    outcomes_of,
    threshold_of,
)

JPEG_QUALITY = 85
_MODE_COLORS = {"ar": 0x6E7B8BFF, "skip": 0xF0E442FF, "expert": 0x4E79A7FF}  # other modes are names of proposers
_OTHER_COLORS = (0x0072B2FF, 0xA0522DFF, 0x4C9F70FF, 0xB07AA1FF)
_DOF_COLORS = (0xE15759FF, 0x59A14FFF, 0x4E79A7FF, 0xB6992DFF, 0x9D7660FF, 0x86BCB6FF, 0xB07AA1FF)
_PLACE_COLORS = (0xE15759FF, 0x59A14FFF, 0xF0E442FF)
_OPEN, _CLOSED = np.array([86.0, 180.0, 233.0]), np.array([230.0, 120.0, 0.0])


@dataclass(frozen=True)
class Entity:
    """The data of one entity of the recording."""

    path: str
    static: tuple[rr.AsComponents, ...]
    steps: NDArray[np.int64] | None = None  # (rows,) control steps
    columns: Iterable[rr.ComponentColumn] = ()  # of as many rows


@catch_and_log_exceptions(strict=True)  # rerun would turn exceptions into warnings and missing views
def encode(record: EpisodeRecord, method: str) -> bytes:
    """The .rrd file's bytes of an episode; arguments as `save_recording`."""
    recording = rr.RecordingStream("kerv_" + re.sub(r"\W+", "_", method, flags=re.ASCII))
    memory = recording.memory_recording()
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    outcome = "success" if record.success else "failure"
    recording.send_recording_name(readable(f"{record.task} · {method} · seed {record.seed} · {outcome}"))
    recording.send_property("episode", rr.AnyValues(**facts_of(record, method)))
    size = chunk_size(record.decodes, record.space.dofs)
    chunks = [outcomes_of(d, size, record.space.dofs) for d in record.decodes]
    for entity in _entities(record, method, chunks):
        for archetype in entity.static:
            recording.log(entity.path, archetype, static=True)
        if entity.steps is not None and len(entity.steps):
            recording.send_columns(entity.path, _times(entity.steps, record.space.control_hz), entity.columns)
    recording.send_blueprint(blueprint(record, chunks))
    return bytes(memory.drain_as_bytes())


def _times(steps: NDArray[np.int64], control_hz: float) -> list[rr.TimeColumn]:
    nanoseconds = np.round(steps * (1e9 / control_hz)).astype("timedelta64[ns]")
    return [rr.TimeColumn(STEP, sequence=steps), rr.TimeColumn(TIME, duration=nanoseconds)]


def _entities(record: EpisodeRecord, method: str, chunks: Chunks) -> list[Entity]:
    starts = np.asarray(record.decode_steps, dtype=np.int64)
    names = record.space.names
    return [
        Entity("summary", (rr.TextDocument(summary(record, method), media_type="text/markdown"),)),
        *_camera(record),
        *_world(record),
        *_actions(record),
        _modes(record, starts),
        _boundaries(starts),
        *_token_lanes(chunks, starts, names),
        _tables(record, chunks, starts),
        *_series_per_decode(record, starts),
    ]


def _camera(record: EpisodeRecord) -> list[Entity]:
    if not record.frames:
        return []
    steps = np.array(sorted(record.frames), dtype=np.int64)
    blobs = [_jpeg(record.frames[int(s)]) for s in steps]
    return [
        Entity(
            "camera",
            (rr.EncodedImage.from_fields(media_type="image/jpeg", magnification_filter="Linear"),),
            steps,
            rr.EncodedImage.columns(blob=blobs),
        )
    ]


def _jpeg(frame: NDArray[np.uint8]) -> bytes:
    """(h, w, 3) uint8 -> a JPEG file."""
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "JPEG", quality=JPEG_QUALITY)
    return buffer.getvalue()


def _world(record: EpisodeRecord) -> list[Entity]:
    """The end effector's path: the whole path faintly, the part up to now coloured by gripper opening, and the present
    position."""
    steps = np.arange(len(record.path), dtype=np.int64)
    opening = np.clip(record.gripper, 0.0, 1.0)[:, None]
    colors = np.round(_OPEN * opening + _CLOSED * (1 - opening)).astype(np.uint8)
    end_color = OUTCOMES["accepted" if record.success else "rejected"].color
    ends = rr.Points3D(
        record.path[[0, -1]],
        radii=0.006,
        colors=np.array([0x9AA5B1FF, end_color], dtype=np.uint32),
        labels=["start", "success" if record.success else "failure"],
    )
    moving = rr.Points3D.columns(positions=record.path, colors=colors)
    return [
        Entity("world", (rr.ViewCoordinates.RIGHT_HAND_Z_UP,)),
        Entity("world/path", (rr.LineStrips3D([record.path], radii=0.0008, colors=0x9AA5B160),)),
        Entity("world/ends", (ends,)),
        Entity("world/trail", (rr.Points3D.from_fields(radii=0.0025),), steps, moving),
        Entity("world/hand", (rr.Points3D.from_fields(radii=0.009),), steps, moving),
        *_places(record),
    ]


def _places(record: EpisodeRecord) -> list[Entity]:
    """Object and goal, where the world knows them: a labelled point each, over time."""
    entities = []
    for number, (name, path) in enumerate(record.places.items()):
        style = rr.Points3D.from_fields(
            radii=0.014, colors=[_PLACE_COLORS[number % len(_PLACE_COLORS)]], labels=[readable(name)], show_labels=True
        )
        steps = np.arange(len(path), dtype=np.int64)
        entities.append(Entity(f"world/{_part(name)}", (style,), steps, rr.Points3D.columns(positions=path)))
    return entities


def _actions(record: EpisodeRecord) -> list[Entity]:
    steps = np.arange(record.steps, dtype=np.int64)
    opening = np.asarray(record.gripper, dtype=np.float64)[:, None]
    return [
        Entity("actions", (_named(record.space.names, _DOF_COLORS),), steps, _rows(record.actions)),
        Entity("gripper", (_named(["gripper opening"], [0xF0E442FF]),), np.arange(len(opening)), _rows(opening)),
    ]


def _modes(record: EpisodeRecord, starts: NDArray[np.int64]) -> Entity:
    """The decode mode over time; a row per change."""
    modes = [d.mode for d in record.decodes]
    changes = [i for i in range(len(modes)) if i == 0 or modes[i] != modes[i - 1]]
    used = sorted(set(modes))
    colors = [_mode_color(mode, i) for i, mode in enumerate(used)]
    style = rr.StateConfiguration(
        values=used, labels=[readable(m) for m in used], colors=np.array(colors, dtype=np.uint32)
    )
    columns = rr.StateChange.columns(state=[modes[i] for i in changes])
    return Entity("mode", (style,), starts[changes], columns)


def _mode_color(mode: str, number: int) -> int:
    """0xRRGGBBAA of a mode: from the table, of the proposer of that name, else the `number`-th of the other colours."""
    part = parts("proposer").get(mode)
    if mode not in _MODE_COLORS and part is not None and part.colour is not None:
        return part.colour << 8 | 0xFF
    return _MODE_COLORS.get(mode, _OTHER_COLORS[number % len(_OTHER_COLORS)])


def _boundaries(starts: NDArray[np.int64]) -> Entity:
    """Where decodes begin: a lane whose shade changes with every decode. Equal states would melt into one."""
    states = ["even", "odd"]
    style = rr.StateConfiguration(
        values=states, labels=["·", "·"], colors=np.array([0x55606BFF, 0x8C99A6FF], np.uint32)
    )
    columns = rr.StateChange.columns(state=[states[i % 2] for i in range(len(starts))])
    return Entity("decodes", (style,), starts, columns)


def _token_lanes(chunks: Chunks, starts: NDArray[np.int64], names: Sequence[str]) -> list[Entity]:
    """A lane per token of the chunk, named by its control step and DoF: a map of all tokens over time."""
    style = rr.StateConfiguration(
        values=list(OUTCOMES),
        labels=[s.symbol for s in OUTCOMES.values()],
        colors=np.array([s.color for s in OUTCOMES.values()], dtype=np.uint32),
    )
    entities = []
    for index in range(len(chunks[0]) if chunks else 0):
        columns = rr.StateChange.columns(state=[chunk[index].kind for chunk in chunks])
        step, dof = divmod(index, len(names))
        entities.append(Entity(f"tokens/step_{step}/{_part(names[dof])}", (style,), starts, columns))
    return entities


def _part(name: str) -> str:
    """A name as a part of an entity's path."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def _tables(record: EpisodeRecord, chunks: Chunks, starts: NDArray[np.int64]) -> Entity:
    decodes = zip(record.decodes, record.decode_steps, chunks, strict=True)
    names = record.space.names
    texts = [decode_table(d, i, step, chunk, names) for i, (d, step, chunk) in enumerate(decodes)]
    kinds = ["text/markdown"] * len(texts)
    return Entity("decode/table", (), starts, rr.TextDocument.columns(text=texts, media_type=kinds))


def _series_per_decode(record: EpisodeRecord, starts: NDArray[np.int64]) -> list[Entity]:
    """Series of numbers per decode. A decode without a value has no row, and a series without rows has no entity."""
    decodes = record.decodes
    limits, limit_names = _thresholds(decodes, record.space.names)
    phases = [p for p in PHASES if any(d.phases.get(p) for d in decodes)]
    entities = []

    def add(path: str, names: Sequence[str], values: Sequence[Sequence[float]], colors: Sequence[int] | None) -> None:
        """A series, each of whose values is held until the next one. values: per decode a number per name, or none."""
        rows = [i for i, value in enumerate(values) if value]
        if rows:
            style = _named(names, colors, held=True)
            entities.append(Entity(path, (style,), starts[rows], _rows(np.array([values[i] for i in rows]))))

    add("decode/forwards", ["forwards"], [(d.forwards,) for d in decodes], [0x8C99A6FF])
    lengths = [acceptance(d.rounds) if d.verifications else () for d in decodes]
    names = ["AL, tokens per verification", "drafts accepted per verification"]
    add("decode/acceptance", names, lengths, [0x56B4E9FF, 0x009E73FF])
    add("decode/threshold", limit_names, limits, [0xE69F00FF, *_DOF_COLORS])
    times = [(1000 * d.seconds, *(1000 * d.phases.get(p, 0.0) for p in phases)) for d in decodes]
    add("decode/phases", ["total", *phases], times, [0x8C99A6FF, *_DOF_COLORS, 0xB07AA1FF])
    for signal, name in SIGNALS.items():
        values = [getattr(d, signal) for d in decodes]
        add(f"signals/{signal}", [name], [() if x is None else (x,) for x in values], None)
    return entities


def _thresholds(decodes: Sequence[DecodeRecord], dofs: Sequence[str]) -> tuple[list[tuple[int, ...]], list[str]]:
    """r of every decode, one number per set of DoFs with equal r in all decodes, and the sets' names. dofs: D names."""
    limits = [threshold_of(d) for d in decodes]
    groups: dict[tuple[int, ...], list[int]] = {}  # a DoF's r over the episode -> the DoFs that have it
    for dof in range(len(dofs)):
        groups.setdefault(tuple(r[dof % len(r)] for r in limits if r), []).append(dof)
    if len(groups) == 1:
        return [r[:1] for r in limits], ["r"]
    names = ["r " + " ".join(dofs[i] for i in members) for members in groups.values()]
    return [tuple(r[members[0]] for members in groups.values()) if r else () for r in limits], names


def _named(names: Sequence[str], colors: Sequence[int] | None = None, held: bool = False) -> rr.SeriesLines:
    colored = None if colors is None else np.resize(np.array(colors, dtype=np.uint32), len(names))  # repeats
    return rr.SeriesLines(names=list(names), colors=colored, interpolation_mode="StepAfter" if held else None)


def _rows(values: np.ndarray) -> rr.ComponentColumnList:
    """(rows, k) -> a column of k scalars per row."""
    return rr.Scalars.columns(scalars=values.astype(np.float64).ravel()).partition([values.shape[1]] * len(values))
