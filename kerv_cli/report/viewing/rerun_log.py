"""Encode an episode as a recording (.rrd file) for the Rerun viewer.

The recording is encoded in memory and then written atomically, because Rerun's own file writer hangs on a full disk.
It has two timelines: `step` (control steps) and `time` (simulated seconds). Data about a decode is logged at the
control step at which its first action is executed.
"""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter, itemgetter
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from PIL import Image
from rerun.error_utils import catch_and_log_exceptions

from kerv_cli.base.registry import parts
from kerv_cli.engine.record import PHASES, EpisodeRecord
from kerv_cli.report.viewing import token_outcomes as outcomes

JPEG_QUALITY = 85
GREY, YELLOW = 0x8C99A6FF, 0xF0E442FF
COLORS = (0xE15759FF, 0x59A14FFF, 0x4E79A7FF, 0xB6992DFF, 0x9D7660FF, 0x86BCB6FF, 0xB07AA1FF)
_OPEN, _CLOSED = np.array([86.0, 180.0, 233.0]), np.array([230.0, 120.0, 0.0])

Colors = Sequence[int]
# (rows,) control step of each row
Steps = NDArray[np.int64]


class _Log:
    """Writes data to a Rerun recording. `hz`: control steps per simulated second."""

    def __init__(self, recording: rr.RecordingStream, hz: float) -> None:
        self.recording = recording
        self.hz = hz

    def static(self, path: str, archetype: rr.AsComponents) -> None:
        self.recording.log(path, archetype, static=True)

    def rows(self, path: str, steps: Steps, columns: Iterable[rr.ComponentColumn]) -> None:
        nanoseconds = np.round(steps * (1e9 / self.hz)).astype("timedelta64[ns]")
        times = [rr.TimeColumn(STEP, sequence=steps), rr.TimeColumn(TIME, duration=nanoseconds)]
        self.recording.send_columns(path, times, columns)

    def states(self, path: str, steps: Steps, values: Sequence[str], looks: Mapping[str, tuple[str, int]]) -> None:
        """Log a state over time, drawn as a coloured bar. A state lasts until the next one.

        Args:
            steps: (rows,) control step at which each state begins.
            looks: Label and colour (0xRRGGBBAA) of each state.
        """
        labels, colors = zip(*looks.values(), strict=True)
        style = rr.StateConfiguration(values=list(looks), labels=list(labels), colors=np.array(colors, dtype=np.uint32))
        self.static(path, style)
        self.rows(path, steps, rr.StateChange.columns(state=list(values)))

    def numbers(
        self,
        path: str,
        steps: Steps,
        names: Sequence[str],
        values: Iterable[Sequence[float] | float | None],
        colors: Colors = COLORS,
    ) -> None:
        """Log numbers over time, drawn as step lines.

        Args:
            names: Name of each line.
            values: For each row, one number per line. A row that is empty or begins with None is left out.
            colors: Colour of each line (0xRRGGBBAA). They repeat if there are more lines.
        """
        present, numbers = [], []
        for step, value in zip(steps, values, strict=True):
            row: NDArray[Any] = np.atleast_1d(np.asarray(value))
            if len(row) and row[0] is not None:
                present.append(step)
                numbers.append(row)
        if present:
            shades = np.resize(np.array(colors, dtype=np.uint32), len(names))
            self.static(path, rr.SeriesLines(names=list(names), colors=shades, interpolation_mode="StepAfter"))
            columns = rr.Scalars.columns(scalars=np.array(numbers, dtype=np.float64).ravel())
            self.rows(path, np.array(present), columns.partition([len(names)] * len(present)))


@catch_and_log_exceptions(strict=True)  # rerun would turn exceptions into warnings and missing views
def encode(record: EpisodeRecord, method: str) -> bytes:
    recording = rr.RecordingStream("kerv_" + _part(method))
    memory = recording.memory_recording()
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    outcome = "success" if record.success else "failure"
    recording.send_recording_name(outcomes.readable(f"{record.task} · {method} · seed {record.seed} · {outcome}"))
    recording.send_property(
        "episode", rr.AnyValues(**outcomes.facts_of(record, method), tokens=outcomes.tokens_hash(record.decodes))
    )
    log = _Log(recording, record.space.control_hz)
    log.static("summary", rr.TextDocument(outcomes.summary(record, method), media_type="text/markdown"))
    if record.frames:
        steps, blobs = np.array(sorted(record.frames), dtype=np.int64), []
        for step in steps:
            buffer = io.BytesIO()
            Image.fromarray(record.frames[int(step)]).save(buffer, "JPEG", quality=JPEG_QUALITY)
            blobs.append(buffer.getvalue())
        log.static("camera", rr.EncodedImage.from_fields(media_type="image/jpeg", magnification_filter="Linear"))
        log.rows("camera", steps, rr.EncodedImage.columns(blob=blobs))
    _log_world(log, record)
    _log_tokens(log, record)
    _log_numbers(log, record)
    recording.send_blueprint(blueprint(record))
    return bytes(memory.drain_as_bytes())


def _log_world(log: _Log, record: EpisodeRecord) -> None:
    steps = np.arange(len(record.path), dtype=np.int64)
    opening = np.clip(record.gripper, 0.0, 1.0)[:, None]
    colors = np.round(_OPEN * opening + _CLOSED * (1 - opening)).astype(np.uint8)
    log.static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    log.static("world/path", rr.LineStrips3D([record.path], radii=0.0008, colors=GREY))
    log.static("world/hand", rr.Points3D.from_fields(radii=0.009))
    log.rows("world/hand", steps, rr.Points3D.columns(positions=record.path, colors=colors))
    for number, (name, path) in enumerate(record.places.items()):
        color, entity = COLORS[number % len(COLORS)], f"world/{_part(name)}"
        log.static(entity, rr.Points3D.from_fields(radii=0.014, colors=[color], labels=[outcomes.readable(name)]))
        log.rows(entity, steps, rr.Points3D.columns(positions=path))


def _log_tokens(log: _Log, record: EpisodeRecord) -> None:
    starts = np.asarray(record.decode_steps, dtype=np.int64)
    names = outcomes.token_names(record.decodes, record.space.names)
    size = outcomes.chunk_size(record.decodes, len(names))
    turns, changes, texts, kinds = [], [], [], []
    modes: list[str] = []
    for number, (decode, step) in enumerate(zip(record.decodes, record.decode_steps, strict=True)):
        turns.append(str(number % 2))  # the viewer joins equal neighbours, so alternate
        if not modes or decode.mode != modes[-1]:
            changes.append(number)
            modes.append(decode.mode)
        chunk = outcomes.outcomes_of(decode, size, len(names))
        kinds.append(list(map(attrgetter("kind"), chunk)))
        texts.append(outcomes.decode_table(decode, number, step, chunk, names))
    log.states("decodes", starts, turns, {"0": ("·", 0x55606BFF), "1": ("·", GREY)})
    shades = {mode: part.colour << 8 | 0xFF for mode, part in parts("proposer").items() if part.colour is not None}
    shades |= {"ar": GREY, "skip": YELLOW}
    looks = {}
    for number, mode in enumerate(sorted(set(modes))):
        looks[mode] = outcomes.readable(mode), shades.get(mode, COLORS[number % len(COLORS)])
    log.states("mode", starts[changes], modes, looks)
    looks = {kind: (style.symbol, style.color) for kind, style in outcomes.OUTCOMES.items()}
    for index in range(size):
        step, dof = divmod(index, len(names))
        states = map(itemgetter(index), kinds)
        log.states(f"tokens/step_{step}/{_part(names[dof])}", starts, list(states), looks)
    media = ["text/markdown"] * len(texts)
    log.rows("decode/table", starts, rr.TextDocument.columns(text=texts, media_type=media))


def _part(name: str) -> str:
    return re.sub(r"\W+", "_", name, flags=re.ASCII)


def _log_numbers(log: _Log, record: EpisodeRecord) -> None:
    decodes, names = record.decodes, list(record.space.names)
    steps, starts = np.arange(record.steps + 1, dtype=np.int64), np.asarray(record.decode_steps, dtype=np.int64)
    log.numbers("actions", steps[:-1], names, record.actions)
    log.numbers("gripper", steps, ["gripper opening"], record.gripper[:, None], [YELLOW])
    log.numbers("decode/forwards", starts, ["forwards"], map(attrgetter("forwards"), decodes), [GREY])
    accepted, limits, seconds = [], [], []
    for decode in decodes:
        accepted.append(outcomes.acceptance([decode]))
        limits.append(outcomes.threshold_of(decode))
        seconds.append([decode.seconds, *map(decode.phases.get, PHASES, itertools.repeat(0.0))])
    titles = ["tokens committed per verification (AL)", "drafts accepted per verification"]
    log.numbers("decode/acceptance", starts, titles, accepted, [0x56B4E9FF, 0x009E73FF])
    if max(map(len, map(set, limits))) < 2:
        log.numbers("decode/threshold", starts, ["r"], [r[:1] for r in limits])
    else:
        log.numbers("decode/threshold", starts, list(map("r {}".format, names)), limits)
    times = 1000 * np.array(seconds)
    used: NDArray[np.bool_] = np.asarray(times.any(axis=0))
    used[0] = True
    phases = np.array(["total", *PHASES])[used].tolist()
    log.numbers("decode/phases", starts, phases, times[:, used], [GREY, *COLORS])
    for signal, title in SIGNALS.items():
        log.numbers(f"signals/{signal}", starts, [title], map(attrgetter(signal), decodes))


STEP, TIME = "step", "time"  # timelines: control steps, and simulated time

# Optional attributes of DecodeRecord that are plotted -> titles of the plots
SIGNALS = {
    "variability": "K, kinematic variability",
    "metric": "F, boundary metric",
    "similarity": "similarity of the best neighbour",
    "deviation": "deviation from AR",
    "delay_steps": "latency that the world felt, control steps",
}


def blueprint(record: EpisodeRecord) -> rrb.Blueprint:
    path = rrb.Spatial3DView(
        origin="/world", name="End effector: orange closed, blue open gripper", line_grid=rrb.LineGrid3D(spacing=0.1)
    )
    episode = rrb.TextDocumentView(origin="/summary", name="Episode")
    world = [rrb.Spatial2DView(origin="/camera", name="Camera")] if record.frames else []
    series = [_series("Per decode", "decode/forwards", "decode/acceptance")]
    if any(map(outcomes.threshold_of, record.decodes)):
        series.append(_series("Acceptance threshold r, bins", "decode/threshold"))
    for signal, title in SIGNALS.items():
        if any(getattr(d, signal) is not None for d in record.decodes):
            series.append(_series(title, f"signals/{signal}"))
    lanes = rrb.StateTimelineView(
        origin="/",
        contents=["/decodes", "/mode", "/tokens/**"],
        name="Decodes (shades alternate), mode, and what became of each token of the chunk",
        time_view=rrb.TimeAxis(link="LinkToGlobal"),
    )
    current = rrb.Vertical(
        rrb.TextDocumentView(origin="/decode/table", name="Current decode"),
        _series("ms per decode", "decode/phases"),
        _series("Actions", "actions", "gripper"),
        row_shares=[5.2, 2.2, 2.2],
    )
    left = rrb.Vertical(*world, rrb.Tabs(path, episode), rrb.Tabs(*series))
    return rrb.Blueprint(
        rrb.Horizontal(left, lanes, current, column_shares=[3, 5, 4]),
        rrb.TimePanel(state="collapsed", timeline=STEP, play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def _series(name: str, *entities: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=list(map("/{}".format, entities)),
        name=name,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=True),
    )
