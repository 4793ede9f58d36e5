"""Layout of an episode's recording in the viewer."""

from __future__ import annotations

import rerun.blueprint as rrb

from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.report.viewing.token_outcomes import Chunks, acceptance, threshold_of

STEP, TIME = "step", "time"
"""The timelines: control steps, and simulated time."""

SIGNALS = {
    "variability": "K, kinematic variability",
    "metric": "F, boundary metric",
    "similarity": "similarity of the best neighbour",
    "deviation": "deviation from AR",
    "delay_steps": "latency that the world felt, control steps",
}
"""Optional attributes of DecodeRecord -> titles of their views."""


Parts = list[rrb.View | rrb.Container]


def blueprint(record: EpisodeRecord, chunks: Chunks) -> rrb.Blueprint:
    """The layout: camera, path, summary and series per decode on the left; in the middle a lane per token, for which
    the viewer takes 40 pixels; the current decode on the right. A method without drafts has two lanes, and room below
    them for the series that stand on the right otherwise."""
    path, episode = _path(record), _document("summary", "Episode")
    series, shares = _per_decode(record)
    views: Parts = [path, episode]
    if record.frames:
        views = [rrb.Spatial2DView(origin="/camera", name="Camera"), rrb.Tabs(episode, path)]
    left = rrb.Vertical(*views, *series, row_shares=[4.0, 3.6, *shares])
    always = [
        _series("ms per decode", "decode/phases", top=1100 * max(decode.seconds for decode in record.decodes)),
        _series("Actions", "actions", "gripper"),
    ]
    if any(token.kind not in ("target", "scripted", "dropped") for chunk in chunks for token in chunk):
        lanes = "Decodes (shades alternate), mode, and what became of each token of the chunk"
        middle = rrb.Vertical(_states(lanes, "/decodes", "/mode", "/tokens/**"))
        right = _current_decode(always)
    else:
        states = _states("Decodes and mode", "/decodes", "/mode")
        middle = rrb.Vertical(states, *always, row_shares=[1.4, 2.2, 2.2])
        right = _current_decode([])
    return paused(rrb.Horizontal(left, middle, right, column_shares=[3, 5, 4]))


def paused(views: rrb.Horizontal) -> rrb.Blueprint:
    """These views alone, without the viewer's panels; playback is paused."""
    return rrb.Blueprint(
        views,
        rrb.TimePanel(state="collapsed", timeline=STEP, play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def _path(record: EpisodeRecord) -> rrb.Spatial3DView:
    """The end effector's path, seen from a distance that shows all of it."""
    low, high = record.path.min(axis=0), record.path.max(axis=0)
    x, y, z = ((low + high) / 2).tolist()
    away = max(1.2 * float((high - low).max()), 0.2)  # metres
    until_now = [
        rrb.VisibleTimeRange(
            timeline, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
        )
        for timeline in (STEP, TIME)
    ]
    return rrb.Spatial3DView(
        origin="/world",
        name="End effector: orange closed, blue open gripper",
        overrides={"/world/trail": rrb.VisibleTimeRanges(until_now)},
        eye_controls=rrb.EyeControls3D(position=(x + away, y - away, z + 0.8 * away), look_target=(x, y, z)),
        line_grid=rrb.LineGrid3D(spacing=0.1),
    )


def _per_decode(record: EpisodeRecord) -> tuple[Parts, list[float]]:
    """Series with a number per decode, and their shares of the height; those that only some methods have are tabs."""
    decodes = record.decodes
    most = max(max(d.forwards, acceptance(d.rounds)[0] if d.verifications else 0) for d in decodes)
    views: Parts = [_series("Per decode", "decode/forwards", "decode/acceptance", top=most + 0.5)]
    thresholds = [bins for d in decodes for bins in threshold_of(d)]
    tabs: Parts = []
    if thresholds:
        tabs.append(_series("Acceptance threshold r, bins", "decode/threshold", top=max(thresholds) + 1.0))
    for signal, title in SIGNALS.items():
        if any(getattr(d, signal) is not None for d in decodes):
            tabs.append(_series(title, f"signals/{signal}"))
    if tabs:
        return [*views, rrb.Tabs(*tabs)], [2.2, 2.2]
    return views, [2.2]


def _current_decode(below: Parts) -> rrb.Vertical:
    """The decode as a table, and the views below it."""
    return rrb.Vertical(_document("decode/table", "Current decode"), *below, row_shares=[5.2, *(2.2 for _ in below)])


def _states(name: str, *contents: str) -> rrb.StateTimelineView:
    axis = rrb.TimeAxis(link="LinkToGlobal")
    return rrb.StateTimelineView(origin="/", contents=list(contents), name=name, time_view=axis)


def _series(name: str, *entities: str, top: float | None = None) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=[f"/{entity}" for entity in entities],
        name=name,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        axis_y=None if top is None else rrb.ScalarAxis(range=(0.0, top)),
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=True),
    )


def _document(origin: str, name: str) -> rrb.TextDocumentView:
    return rrb.TextDocumentView(origin=f"/{origin}", name=name)
