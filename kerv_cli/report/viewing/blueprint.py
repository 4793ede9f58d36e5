"""Layout of an episode's recording in the viewer."""

from __future__ import annotations

import rerun.blueprint as rrb

from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.report.viewing.token_outcomes import threshold_of

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


def blueprint(record: EpisodeRecord) -> rrb.Blueprint:
    """Return the layout: the world and series per decode, a lane per token, the current decode. Playback is paused."""
    path = rrb.Spatial3DView(
        origin="/world", name="End effector: orange closed, blue open gripper", line_grid=rrb.LineGrid3D(spacing=0.1)
    )
    episode = rrb.TextDocumentView(origin="/summary", name="Episode")
    world = [rrb.Spatial2DView(origin="/camera", name="Camera")] if record.frames else []
    series = [_series("Per decode", "decode/forwards", "decode/acceptance")]
    if any(threshold_of(d) for d in record.decodes):
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
        contents=[f"/{entity}" for entity in entities],
        name=name,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=True),
    )
