"""Layout of an episode's recording in the viewer: a pure function of the episode's properties."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import rerun.blueprint as rrb

STEP, TIME = "step", "time"
"""The timelines: control steps, and simulated time."""

CELL_WIDTH, CELL_HEIGHT = 60.0, 26.0
"""A token's cell in the picture of the current chunk, in scene units."""
KEY_ROWS = 4
"""Least number of rows of the picture's key."""
KEY_WIDTH = 1.95
"""Width of an entry of the key, in cells: `~ compensated` fits."""

SIGNALS = {
    "variability": "K, kinematic variability",
    "metric": "F, boundary metric",
    "similarity": "similarity of the best neighbour",
    "deviation": "deviation from AR",
    "delay_steps": "latency that the world felt, control steps",
}
"""Optional attributes of DecodeRecord -> titles of their views."""


LIMITS = {"metric": "F*", "similarity": "s_min"}
"""Signal -> name of the limit that a decision compares it with."""


@dataclass(frozen=True)
class EpisodeMeta:
    """Properties of an episode that decide the layout."""

    chunk_steps: int  # H
    dofs: tuple[str, ...]  # names of the D degrees of freedom
    frames: bool  # the episode has camera frames
    drafted: bool  # some token was drafted, compensated or skipped
    threshold: bool  # some acceptance rule had a threshold
    signals: tuple[str, ...]  # keys of SIGNALS that some decode has
    most: float  # the most forwards or the longest acceptance length of a decode
    slowest: float  # milliseconds of the slowest decode
    widest: int  # the largest threshold, bins
    centre: tuple[float, float, float]  # middle of the end effector's path, metres
    extent: float  # longest side of the path's bounding box, metres


def blueprint(meta: EpisodeMeta) -> rrb.Blueprint:
    """The layout: camera, path, summary and series per decode on the left; in the middle a lane per token, for which
    the viewer takes 40 pixels; the current decode on the right."""
    path, episode = _path(meta), _document("summary", "Episode")
    series, shares = _per_decode(meta)
    if meta.frames:
        views: list[Any] = [rrb.Spatial2DView(origin="/camera", name="Camera"), rrb.Tabs(episode, path)]
    else:
        views = [path, episode]
    left = rrb.Vertical(*views, *series, row_shares=[4.0, 3.6, *shares])
    return paused(rrb.Horizontal(left, _over_time(meta), _current_decode(meta), column_shares=[3, 5, 4]))


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


def _path(meta: EpisodeMeta) -> rrb.Spatial3DView:
    x, y, z = meta.centre
    away = max(1.2 * meta.extent, 0.2)
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


def _per_decode(meta: EpisodeMeta) -> tuple[list[Any], list[float]]:
    """Series with a number per decode, and their shares of the height; those of a method's own stand in one place."""
    counts = ("decode/forwards", "decode/acceptance")
    views: list[Any] = [_series("Per decode", *counts, top=meta.most + 0.5)]
    own = [_series("Acceptance threshold r, bins", "decode/threshold", top=meta.widest + 1.0)] if meta.threshold else []
    own += [_series(SIGNALS[signal], f"signals/{signal}") for signal in meta.signals]
    return [*views, *([rrb.Tabs(*own)] if own else [])], [2.2, *([2.2] if own else [])]


def _over_time(meta: EpisodeMeta) -> rrb.Vertical:
    """The lanes; a method without drafts has two, and room for its series."""
    if meta.drafted:
        name = "Decodes (shades alternate), mode, and what became of each token of the chunk"
        return rrb.Vertical(_states(name, "/decodes", "/mode", "/tokens/**"))
    return rrb.Vertical(_states("Decodes and mode", "/decodes", "/mode"), *_always(meta), row_shares=[1.4, 2.2, 2.2])


def _current_decode(meta: EpisodeMeta) -> rrb.Vertical:
    wide = (len(meta.dofs) + 1.3 + 2 * KEY_WIDTH) * CELL_WIDTH
    left, above = -0.75 * CELL_WIDTH, -0.8 * CELL_HEIGHT
    high = (max(meta.chunk_steps, KEY_ROWS) + 0.9) * CELL_HEIGHT
    chunk = rrb.Spatial2DView(
        origin="/chunk",
        name="Current chunk: draft → target token",
        background=[13, 16, 17],
        visual_bounds=rrb.VisualBounds2D(x_range=[left, left + wide], y_range=[above, above + high]),
    )
    views: list[rrb.View] = [chunk, _document("decode/table", "Current decode")]
    shares = [0.9 + 0.35 * max(meta.chunk_steps, KEY_ROWS), 5.2]
    if meta.drafted:
        views += _always(meta)
        shares += [2.2, 2.2]
    return rrb.Vertical(*views, row_shares=shares)


def _always(meta: EpisodeMeta) -> list[rrb.View]:
    """Phases and actions, the series of every method; placed in the middle or right column."""
    return [
        _series("ms per decode", "decode/phases", top=1.1 * meta.slowest),
        _series("Actions", "actions", "gripper"),
    ]


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
