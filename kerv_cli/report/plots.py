"""Draw the charts of a study from its tables: interactive ones for the page, and PNG files.

A chart has panels side by side. Each point of a panel is a setting and has these fields: `setting`, `line`, `x`,
`value`, `low` and `high` (95 % interval), `is_baseline`, and the text that hovering shows. When the reader clicks on a
setting, the page sets the chart's parameter `picked` to the setting's label.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import altair as alt
import numpy as np
import pandas as pd
import vl_convert
from PIL import Image

from kerv_cli.base.durations import count
from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import write_if_changed
from kerv_cli.report.measures import Result, averaged, frame_of, is_number
from kerv_cli.report.summary import MAIN, summary_frame
from kerv_cli.report.tables import NO_STRESS, is_stressed
from kerv_cli.report.tally import Tally

INK, MUTED, BLUE, GREEN = "#1f2933", "#6b7785", "#0b6fb8", "#2a9d6f"
COLOURS = (BLUE, "#d1495b", GREEN, "#8d5fd3", "#e08e1b", "#3aa6b9", "#7a5c3e")  # distinct when colour-blind
SUCCESS, SPEED, DIFFERENCE = "success", "episode_speedup", "difference"
TITLES = {SUCCESS: "Success, % of episodes", SPEED: "Speed, per episode", DIFFERENCE: "Change in success, points"}
"""Columns of a study's table that are drawn -> their titles."""
_WIDTH, _HEIGHT, _ACROSS = 320, 240, 3  # of a panel, in pixels; panels in a row
_SPREAD = 6.0  # a ratio of speeds above which their axis is logarithmic
_CONFIG = {
    "axis": {"labelColor": INK, "titleColor": MUTED, "titleFontWeight": "normal", "gridColor": "#e3e8ee",
             "domainColor": "#b8c1cb", "tickColor": "#b8c1cb", "labelFontSize": 12, "titleFontSize": 12,
             "labelLimit": 260, "tickCount": 5},
    "title": {"anchor": "start", "color": INK, "fontSize": 13, "subtitleColor": MUTED, "subtitleFontSize": 12},
    "legend": {"labelColor": INK, "labelFontSize": 12, "labelLimit": 260, "symbolSize": 70},
    "view": {"stroke": None},
}  # fmt: skip


def study_figures(results: Sequence[Result], axis: str, loss: float = 3.0) -> dict[str, alt.ConcatChart]:
    """Draw the chart that suits a study, from its rows pooled over tasks.

    - A study of stress: success against the level of stress.
    - A study whose settings differ along `axis`: speed and success against the value of that column.
    - Any other study that compares settings or was timed: speed and change in success of every setting.

    Args:
        results: The study's rows over all tasks.
        axis: Table column for the x axis, such as `threshold.r`. Empty if the study has no axis.
        loss: Largest acceptable loss of success, in points.

    Returns:
        The charts. Each key is the suffix of a file name: `_tradeoff` is the chart for `<study>_tradeoff.png`. Empty if
        there is nothing to draw.
    """
    rows = _drawn(results)
    if is_stressed(results):
        kinds = rows.loc[rows["stress"] != NO_STRESS, "stress"].unique()
        points = pd.concat(rows[rows["stress"].isin([NO_STRESS, kind])].assign(panel=kind) for kind in kinds)
        points = points.assign(line=points["unstressed"], x=points["stress_level"])
        return {"": lines_figure([_points(points, SUCCESS)], "level of stress", "success, %")}
    rows = with_lines(rows, axis)
    if rows["x"].notna().any():
        speed = _points(rows.assign(panel=TITLES[SPEED]), SPEED)
        success = _points(rows.assign(panel=TITLES[SUCCESS]), SUCCESS)
        return {"": lines_figure([speed, success] if len(speed) else [success], axis)}
    return {"_tradeoff": _tradeoff(rows, loss)} if rows["pairs"].any() else {}


def about(results: Sequence[Result]) -> str:
    """Return the subtitle of a chart: policies, number of settings, tasks and episodes, device, number format."""
    table = frame_of(results)
    targets = table["policy.target"].astype(str).unique()
    names = ", ".join(targets) if len(targets) <= 2 else f"{len(targets)} policies"
    settings, tasks = count(table["label"].nunique(), "setting"), count(table["tasks"].max(), "task")
    counts = f"{settings} on {tasks}, {count(table['episodes'].max(), 'episode')} each"
    return f"{names} · {counts} · {table['device_name'][0]}, {table['runtime.dtype'][0]}"


def _drawn(results: Sequence[Result]) -> pd.DataFrame:
    """Return the rows pooled over tasks, with `setting`, `is_baseline` and the text to show on hovering."""
    rows = averaged(results)
    texts = summary_frame(rows).iloc[:, :MAIN].add_prefix("text ")
    frame = frame_of(rows)
    return frame.assign(setting=frame["label"], is_baseline=frame["label"] == frame["baseline"], panel="").join(texts)


def with_lines(rows: pd.DataFrame, axis: str) -> pd.DataFrame:
    """Add two columns: `line`, the name of the line that joins points, and `x`, the setting's value on the x axis.

    Settings that differ only in the value of `axis` share a line. If a setting's value is no number, or if no other
    setting shares its line, then `line` is the setting's label, and `x` is missing.
    """
    numbers = rows[axis] if axis in rows else pd.Series(None, rows.index, dtype=object)
    x = numbers.map(lambda value: float(value) if is_number(value) else None).astype(float)
    line = rows["series"].where(x.notna(), rows["label"])
    alone = line.groupby(line).transform("size") == 1
    return rows.assign(line=line.mask(alone, rows["label"]), x=x.mask(alone)).sort_values("x", kind="stable")


def _points(rows: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return the points of a chart that shows one `column` of the table. Success is scaled to per cent."""
    scale = 1.0 if column == SPEED else 100.0
    texts = rows.filter(regex="^text ").columns
    points = rows.reindex(columns=["setting", "line", "x", "panel", "is_baseline", *texts])
    points["value"] = scale * rows[column].astype(float)
    points["low"] = scale * rows[f"{column}_low"].astype(float)
    points["high"] = scale * rows[f"{column}_high"].astype(float)
    return points.dropna(subset="value")


def _tooltip(points: pd.DataFrame) -> list[alt.Tooltip]:
    texts = points.filter(regex="^text ").columns
    return [alt.Tooltip(f"{name}:N", title=name.removeprefix("text ")) for name in texts]


def _faded(full: float) -> alt.When:
    """Return the opacity of a point, for Altair to evaluate in the browser.

    The opacity is 0.12 if the reader has clicked on another setting, and `full` otherwise.
    """
    return alt.when("picked == '' || picked == datum.setting").then(alt.value(full)).otherwise(alt.value(0.12))


def _tradeoff(rows: pd.DataFrame, loss: float) -> alt.ConcatChart:
    """Draw speed and change in success of every setting in two panels, one row per setting.

    A dashed line marks the baseline's speed in the first panel, and a loss of `loss` points in the second. A setting
    whose interval is right of the line is shown to be faster than the baseline, or to lose less than `loss`.
    """
    baselines = rows["baseline"].unique()
    than = f"than {baselines[0]}" if len(baselines) == 1 else "than the baseline"
    panels = {
        SPEED: (1.0, f"right of the dashed line: faster {than}"),
        DIFFERENCE: (-loss, f"right of the dashed line: loses less than {loss:g} points"),
    }
    charts: list[alt.LayerChart] = []
    for column, (bound, hint) in panels.items():
        points = _points(rows, column)
        same = points["is_baseline"]  # nothing is uncertain about a comparison with itself
        points = points.assign(low=points["low"].mask(same), high=points["high"].mask(same))
        if points.empty:
            continue
        ends = points[["value", "low", "high"]].stack()
        kind = "log" if column == SPEED and ends.max() > _SPREAD * ends.min() else "linear"
        names = alt.Axis(title=None, grid=True, ticks=False, labelPadding=8, domain=False, labels=not charts)
        base = alt.Chart(points).encode(
            y=alt.Y("setting:N", scale=alt.Scale(domain=list(rows["setting"])), axis=names),
            color=alt.when("datum.is_baseline").then(alt.value(INK)).otherwise(alt.value(BLUE)),
            tooltip=_tooltip(points),
        )
        scale = alt.Scale(type=kind, nice=False, padding=10, **({} if kind == "log" else {"zero": False}))
        at = alt.X("low:Q", scale=scale, title=None)
        line = alt.Chart().mark_rule(strokeDash=[4, 3], color=INK).encode(x=alt.datum(bound, type="quantitative"))
        bars = base.mark_rule(strokeWidth=3).encode(x=at, x2="high:Q", opacity=_faded(0.4))
        dots = base.mark_point(filled=True, size=75, cursor="pointer").encode(x="value:Q", opacity=_faded(1.0))
        title = alt.Title(TITLES[column], subtitle=hint)
        charts.append((line + bars + dots).properties(title=title, width=_WIDTH, height=alt.Step(24)))
    return _chart(charts, 2)


def lines_figure(measures: Iterable[pd.DataFrame], xlabel: str, ylabel: str | None = None) -> alt.ConcatChart:
    """Draw panels side by side with one legend. A line has the same colour in every panel.

    Args:
        measures: Tables of points, from `_points`. Points with the same `panel` share a panel. A point without x is
            drawn as a line across the panel.
        xlabel: Title of the x axis.
        ylabel: Title of the y axis. If None, the y axis has no title.
    """
    points = pd.concat(measures)
    names = points["line"].unique()
    dark = set(points.loc[points["is_baseline"], "line"])
    colours = []
    for number, name in enumerate(names):
        colours.append(INK if name in dark else COLOURS[number % len(COLOURS)])
    legend = alt.Legend(orient="bottom", columns=4, title=None)
    colour = alt.Color("line:N", scale=alt.Scale(domain=list(names), range=colours), legend=legend)
    scale, charts = alt.Scale(zero=False, padding=12), []
    for title, part in points.groupby("panel", sort=False):
        base = alt.Chart(part).encode(color=colour, tooltip=_tooltip(part))
        y, low = alt.Y("value:Q", scale=scale, title=ylabel), alt.Y("low:Q", scale=scale, title=ylabel)
        drawn, alone = base.transform_filter("isValid(datum.x)"), base.transform_filter("!isValid(datum.x)")
        drawn = drawn.encode(x=alt.X("x:Q", scale=scale, title=xlabel))
        layers = [
            alone.mark_rule(strokeDash=[5, 4], strokeWidth=1.5).encode(y=y, opacity=_faded(0.9)),
            drawn.mark_rule(strokeWidth=2).encode(y=low, y2="high:Q", opacity=_faded(0.35)),
            drawn.mark_line(strokeWidth=1.5).encode(y=y),
            drawn.mark_point(filled=True, size=60, cursor="pointer").encode(y=y, opacity=_faded(1.0)),
        ]
        charts.append(alt.layer(*layers).properties(title=str(title), width=_WIDTH, height=_HEIGHT))
    return _chart(charts, _ACROSS)


def latency_figure(results: Sequence[Result], latencies: pd.DataFrame) -> alt.ConcatChart:
    """Draw success against decoding latency, with one panel per kind of delay compensation.

    Only settings whose world goes on during a decode are drawn. A setting's x value is the latency of the AR baseline
    under the same clock. So all methods that ran under the same clock have the same x value.

    Args:
        results: The study's rows over all tasks.
        latencies: The same study's `latency_table`.
    """
    rows = _drawn(results)
    rows = (
        rows.assign(x=rows["label"].map(latencies.set_index("label")["ar_latency_ms"]))
        .query("x > 0")
        .sort_values("x", kind="stable")
    )
    panels = "delay compensation: " + rows["rollout.delay_compensation"]
    points = _points(rows.assign(line=rows["method"], panel=panels), SUCCESS)
    return lines_figure([points], "an autoregressive decode takes, ms", "success, %")


def acceptance_figure(tallies: Mapping[str, Tally], references: Mapping[str, str]) -> alt.ConcatChart:
    """Draw how many draft tokens were accepted, in three panels with a line per setting.

    The first two panels show the share of accepted tokens, by position in the draft and by DoF. They count only tokens
    whose predecessors in the draft were all accepted. The third panel shows the share of drafts with each number of
    accepted tokens.

    Args:
        tallies: Counts by the setting's label.
        references: For each setting's label, the label of the setting that it is compared with.
    """
    frames = []
    for label, tally in tallies.items():
        reached, accepted = tally.by_position
        panels = {
            "Accepted tokens, %, by position in the draft": (1, accepted, reached),
            "Accepted tokens, %, by DoF": (1, tally.accepted, tally.reached),
            "Drafts, %, by number of accepted tokens": (0, tally.lengths, np.full(len(tally.lengths), tally.drafts)),
        }
        for panel, (first, part, whole) in panels.items():
            points = pd.DataFrame({"x": first + np.arange(len(part)), "part": part, "whole": whole}).query("whole > 0")
            share = 100.0 * points["part"] / points["whole"]
            is_baseline = references.get(label) == label
            fields: dict[str, Any] = {"setting": label, "line": label, "panel": panel, "is_baseline": is_baseline}
            fields |= {"value": share, "low": share, "high": share, "text setting": label, "text place": points["x"]}
            fields |= {"text tokens": points["part"], "text of": points["whole"]}
            frames.append(points[["x"]].assign(**fields))
    return lines_figure(frames, "position, DoF or number")


def _best_step(log: pd.DataFrame) -> float:
    """Return the training step of the best validation."""
    return float(log["step"].to_numpy()[int(log["score"].to_numpy().argmax())])


CURVES = {
    "train_loss": "training loss",
    "score": "validation score (the best is kept)",
    "token_accuracy": "share of equal tokens",
    "within_9": "share of tokens within 9 bins",
    "action_l1": "error of the action",
    "acceptance_length_strict": "accepted tokens, equal only",
    "acceptance_length_r9": "accepted tokens, within 9 bins",
}
"""Column of a training's log -> its title in a chart."""


def curves_figure(log: pd.DataFrame) -> alt.ConcatChart:
    """Draw every measure of a training's log against the training step. Mark the best validation."""
    best = _best_step(log)
    charts = []
    for name in log.columns.drop("step"):
        data = log[["step", name]].rename(columns={name: "value"})
        title = CURVES.get(str(name), str(name).replace("_", " ").replace("l1 ", "error of "))
        shown = ["step:Q", alt.Tooltip("value:Q", title=title)]
        base = alt.Chart(data).encode(x=alt.X("step:Q", title="training step"), tooltip=shown)
        y = alt.Y("value:Q", scale=alt.Scale(zero=False), title=None)
        line = base.mark_line(color=BLUE, point={"size": 30, "color": BLUE}).encode(y=y)
        mark = alt.Chart().mark_rule(strokeDash=[4, 3], color=MUTED).encode(x=alt.datum(best, type="quantitative"))
        charts.append((mark + line).properties(title=title, width=_WIDTH, height=_HEIGHT))
    return _chart(charts, _ACROSS)


def _chart(panels: list[alt.LayerChart], across: int) -> alt.ConcatChart:
    """Put panels side by side, `across` in a row. Add the style that all charts share, and the parameter `picked`."""
    chart = alt.concat(*panels, columns=across, spacing=28, config=_CONFIG)
    chart.params = [alt.param("picked", value="").param]  # `add_params` would copy the panels again and again
    return chart


def png(figure: alt.ConcatChart, title: str, subtitle: str) -> bytes:
    """Return a chart with a heading as a PNG file. The same chart gives the same bytes."""
    heading = alt.Title(title, subtitle=subtitle, fontSize=17, subtitleFontSize=12, offset=16)
    spec = figure.properties(title=heading, background="white", padding=14).to_dict(validate=False)
    buffer = io.BytesIO()  # written again: the renderer hardly compresses
    Image.open(io.BytesIO(vl_convert.vegalite_to_png(spec, scale=2))).convert("RGB").save(buffer, "png", optimize=True)
    return buffer.getvalue()


@functools.cache
def library() -> str:
    """Return the JavaScript that draws charts in a page (Vega-Embed with Vega and Vega-Lite). It needs no network."""
    return str(vl_convert.javascript_bundle())  # type: ignore[call-arg]  # its stub forgets that it has a default


def read_log(folder: Path) -> pd.DataFrame:
    """Return the log of a training, one row per validation.

    Args:
        folder: Folder of the trained artifact.

    Raises:
        CheckpointError: The folder has no readable log of a training.
    """
    path = folder / "log.csv"
    try:
        return pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error


def save_curves(folder: Path) -> Path:
    """Write `curves.png` into the folder of a trained artifact and return its path.

    Raises:
        CheckpointError: The folder has no readable log of a training.
        StorageError: The disk is full or read-only.
    """
    path, log = folder / "curves.png", read_log(folder)
    note = f"{len(log)} validations of the averaged weights; dashed: the saved ones, step {_best_step(log):.0f}"
    write_if_changed(path, png(curves_figure(log), f"{folder.parent.name} {folder.name}", note))
    return path
