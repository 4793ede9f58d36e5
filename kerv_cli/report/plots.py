"""Draw the charts of a study from its rows, and the curves of a training.

A point of a panel is a setting, with the fields of `_points`. When the reader clicks on a setting, the page sets the
chart's parameter `picked` to the setting's label.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import altair as alt
import numpy as np
import pandas as pd
import vl_convert

from kerv_cli.base.errors import CheckpointError, StorageError
from kerv_cli.base.files import own_folder, write_if_changed, write_text
from kerv_cli.report.measures import Result, is_number
from kerv_cli.report.summary import MAIN, summary
from kerv_cli.report.tables import NO_STRESS, StudyData, dof_names

INK, MUTED, BLUE, GREEN = "#1f2933", "#6b7785", "#0b6fb8", "#2a9d6f"
COLOURS = (BLUE, "#d1495b", GREEN, "#8d5fd3", "#e08e1b", "#3aa6b9", "#7a5c3e")  # distinct when colour-blind
SUCCESS, SPEED, DIFFERENCE = "success", "episode_speedup", "difference"
TITLES = {SUCCESS: "Success, % of episodes", SPEED: "Speed, per episode", DIFFERENCE: "Change in success, points"}
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


Point = dict[str, Any]
# A setting's label -> the line through its point, and its x value
Places = Mapping[str, tuple[str, float | None]]


class Panel(NamedTuple):
    """One chart in a row of charts."""

    title: str
    points: list[Point]  # A point without x is drawn as a line across the panel
    xlabel: str
    names: Sequence[str] = ()  # names of the places on the x axis, in order. Empty if x is a number.


def study_figures(results: Sequence[Result], axis: str, loss: float = 3.0) -> dict[str, alt.ConcatChart]:
    """Draw the chart that suits a study.

    - A study of stress (`line`): success against the level of stress.
    - A study whose settings differ along `axis` (`line`): speed and success against the value of that column.
    - Any other study that compares settings (`tradeoff`): speed and change in success of every setting.

    Args:
        axis: Key of a setting for the x axis, such as `threshold.r`. Empty if the study has no axis.
        loss: Largest acceptable loss of success, in points.
    """
    colours = colours_of(results)
    if len({(row.stress, row.stress_level) for row in results}) > 1:  # compares disturbed worlds
        panels = []
        for kind in dict.fromkeys(row.stress for row in results if row.stress != NO_STRESS):
            own = [row for row in results if row.stress in (NO_STRESS, kind)]
            levels: Places = {row.label: (row.unstressed, float(row.stress_level)) for row in own}
            panels.append(Panel(kind, _points(own, SUCCESS, levels), "level of stress"))
        return {"line": lines_figure(panels, colours, "success, %")}
    places = lines_of(results, axis)
    if any(is_number(x) for _, x in places.values()):
        both = [Panel(TITLES[name], _points(results, name, places), axis) for name in (SPEED, SUCCESS)]
        return {"line": lines_figure([one for one in both if one.points], colours)}
    return {"tradeoff": _tradeoff(results, loss, colours)} if any(row.is_compared for row in results) else {}


def colours_of(results: Sequence[Result]) -> dict[str, str]:
    """Return the colour of each setting, by label, and of each series, by name. A series has shades of one colour."""
    series: dict[str, list[str]] = {}
    for row in results:
        series.setdefault(row.series, []).append(row.label)
    dark = {row.baseline for row in results}
    colours, hues = {}, itertools.cycle(COLOURS)
    for name, labels in series.items():
        hue = INK if dark & set(labels) else next(hues)
        colours[name] = hue
        for number, label in enumerate(labels):
            colours[label] = _lighter(hue, 0.55 * (1 - (number + 1) / len(labels)))
    return colours


def _lighter(colour: str, share: float) -> str:
    parts = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return "#" + "".join(f"{round(part + (255 - part) * share):02x}" for part in parts)


def lines_of(results: Sequence[Result], axis: str) -> Places:
    """Return, for each setting's label, the line on which a plot over `axis` shows it, and its x value.

    Settings that differ only in `axis` form a line. A setting that differs otherwise is a line of its own, named by its
    label, without an x value.
    """
    places: dict[str, tuple[str, float | None]] = {}
    for row in results:
        value: Any = row.columns().get(axis)
        places[row.label] = (row.series, float(value)) if is_number(value) else (row.label, None)
    shared = Counter(line for line, x in places.values() if x is not None)
    return {label: (line, x) if shared[line] > 1 else (label, None) for label, (line, x) in places.items()}


def _points(results: Sequence[Result], column: str, places: Places) -> list[Point]:
    scale, points = 1.0 if column == SPEED else 100.0, []
    texts = {cells["setting"]: dict(itertools.islice(cells.items(), MAIN)) for cells in summary(results)}
    for row in results:
        estimate = getattr(row.measures, column)
        if row.label in places and is_number(estimate.value):
            line, x = places[row.label]
            value, low, high = (scale * number if is_number(number) else None for number in estimate)
            point = {"setting": row.label, "line": line, "x": x, "is_baseline": row.is_baseline}
            point |= {"value": value, "low": low, "high": high}
            points.append(point | {f"text {name}": text for name, text in texts[row.label].items()})
    return sorted(points, key=lambda point: (point["x"] is None, point["x"]))


def _tooltip(points: Sequence[Point]) -> list[alt.Tooltip]:
    texts = (name for name in points[0] if name.startswith("text "))
    return [alt.Tooltip(f"{name}:N", title=name.removeprefix("text ")) for name in texts]


def _faded(full: float) -> alt.OpacityValue:
    return alt.OpacityValue(0.12, condition={"test": "picked == '' || picked == datum.setting", "value": full})


def _tradeoff(results: Sequence[Result], loss: float, colours: Mapping[str, str]) -> alt.ConcatChart:
    baselines, labels = {row.baseline for row in results}, [row.label for row in results]
    than = f"than {baselines.copy().pop()}" if len(baselines) == 1 else "than the baseline"
    panels = {
        SPEED: (1.0, f"right of the dashed line: faster {than}"),
        DIFFERENCE: (-loss, f"right of the dashed line: loses less than {loss:g} points"),
    }
    charts: list[alt.LayerChart] = []
    datasets: dict[str, Any] = {}
    for column, (bound, hint) in panels.items():
        points = _points(results, column, dict.fromkeys(labels, ("", None)))
        for point in points:
            point["colour"] = colours[point["setting"]]
            if point["is_baseline"]:  # nothing is uncertain about a comparison with itself
                point["low"] = point["high"] = None
        if not points:
            continue
        ends = [point[name] for point in points for name in ("value", "low", "high") if point[name] is not None]
        kind = "log" if column == SPEED and max(ends) > _SPREAD * min(ends) else "linear"
        names = alt.Axis(title=None, grid=True, ticks=False, labelPadding=8, domain=False, labels=not charts)
        datasets[column] = points
        base = alt.Chart(alt.NamedData(column)).encode(
            y=alt.Y("setting:N", scale=alt.Scale(domain=labels), axis=names),
            color=alt.Color("colour:N", scale=None),
            tooltip=_tooltip(points),
        )
        scale = alt.Scale(type=kind, nice=False, padding=10, **({} if kind == "log" else {"zero": False}))
        at = alt.X("low:Q", scale=scale, title=None)
        line = alt.Chart().mark_rule(strokeDash=[4, 3], color=INK).encode(x=alt.datum(bound, type="quantitative"))
        bars = base.mark_rule(strokeWidth=3).encode(x=at, x2=alt.X2("high:Q"), opacity=_faded(0.4))
        dots = base.mark_point(filled=True, size=75, cursor="pointer").encode(x=alt.X("value:Q"), opacity=_faded(1.0))
        title = alt.Title(TITLES[column], subtitle=hint)
        charts.append((line + bars + dots).properties(title=title, width=_WIDTH, height=alt.Step(24)))
    return _chart(charts, 2, datasets)


def lines_figure(panels: Sequence[Panel], colours: Mapping[str, str], ylabel: str | None = None) -> alt.ConcatChart:
    lines = list(dict.fromkeys(point["line"] for panel in panels for point in panel.points))
    scale = alt.Scale(domain=list(dict.fromkeys([*lines, *colours])), range=[])
    scale.range = [colours[name] for name in scale.domain]
    legend, charts = alt.Legend(orient="bottom", columns=4, title=None, values=lines), []
    alone_scale = alt.Scale(zero=False, padding=12)
    for panel in panels:
        base = alt.Chart(alt.NamedData(panel.title)).encode(
            color=alt.Color("line:N", scale=scale, legend=legend), tooltip=_tooltip(panel.points)
        )
        y, low = (alt.Y(f"{name}:Q", scale=alone_scale, title=ylabel) for name in ("value", "low"))
        x = alt.X("x:Q", scale=alone_scale, title=panel.xlabel)
        if panel.names:
            x = alt.X("x:N", sort=list(panel.names), title=panel.xlabel, axis=alt.Axis(labelAngle=0))
        alone, drawn = base.transform_filter("!isValid(datum.x)"), base.transform_filter("isValid(datum.x)").encode(x=x)
        own = alt.Color("setting:N", scale=scale, legend=legend)
        layers = [
            alone.mark_rule(strokeDash=[5, 4], strokeWidth=1.5).encode(y=y, opacity=_faded(0.9)),
            drawn.mark_rule(strokeWidth=2).encode(y=low, y2=alt.Y2("high:Q"), color=own, opacity=_faded(0.35)),
            drawn.mark_line(strokeWidth=1.5).encode(y=y),
            drawn.mark_point(filled=True, size=60, cursor="pointer").encode(y=y, color=own, opacity=_faded(1.0)),
        ]
        charts.append(alt.layer(*layers).properties(title=panel.title, width=_WIDTH, height=_HEIGHT))
    return _chart(charts, _ACROSS, {panel.title: panel.points for panel in panels})


def acceptance_figure(data: StudyData) -> alt.ConcatChart:
    """Draw the share of accepted draft tokens by position and by DoF, and how many tokens of a draft were accepted.

    The shares count only tokens whose predecessors in the draft were all accepted.
    """
    number = max(len(tally.reached) for tally in data.tallies.values())
    dofs = dof_names(data.task_results[0].task, number)
    panels = [
        Panel("Accepted tokens, %, by position in the draft", [], "position in the draft"),
        Panel("Accepted tokens, %, by DoF", [], "degree of freedom", dofs),
        Panel("Drafts, %, by number of accepted tokens", [], "accepted tokens"),
    ]
    for label, tally in data.tallies.items():
        reached, accepted = tally.by_position
        lines = (
            (range(1, len(accepted) + 1), accepted, reached),
            (dofs, tally.accepted, tally.reached),
            (range(len(tally.lengths)), tally.lengths, np.full(len(tally.lengths), tally.drafts)),
        )
        for panel, (names, parts, wholes) in zip(panels, lines, strict=True):
            for x, part, whole in zip(names, parts.tolist(), wholes.tolist(), strict=True):
                if whole:
                    point: Point = {"setting": label, "line": label, "x": x}
                    point |= dict.fromkeys(("value", "low", "high"), 100.0 * part / whole)
                    shown = {"text setting": label, "text place": x, "text tokens": part, "text of": whole}
                    panel.points.append(point | shown)
    return lines_figure([panel for panel in panels if panel.points], colours_of(data.results))


def _best_step(log: pd.DataFrame) -> float:
    return float(log["step"].to_numpy()[int(log["score"].to_numpy().argmax())])


# Column of a training's log -> its title
CURVES = {
    "train_loss": "training loss",
    "score": "validation score (the best is kept)",
    "token_accuracy": "share of equal tokens",
    "within_9": "share of tokens within 9 bins",
    "action_l1": "error of the action",
    "acceptance_length_strict": "accepted tokens, equal only",
    "acceptance_length_r9": "accepted tokens, within 9 bins",
}


def curves_figure(log: pd.DataFrame) -> alt.ConcatChart:
    best = _best_step(log)
    charts: list[alt.LayerChart] = []
    datasets: dict[str, Any] = {}
    for name in log.columns.drop("step"):
        datasets[str(name)] = log[["step", name]].dropna().set_axis(["step", "value"], axis=1).to_dict("records")
        title = CURVES.get(str(name), str(name).replace("_", " ").replace("l1 ", "error of "))
        shown = ["step:Q", alt.Tooltip("value:Q", title=title)]
        base = alt.Chart(alt.NamedData(str(name))).encode(x=alt.X("step:Q", title="training step"), tooltip=shown)
        y = alt.Y("value:Q", scale=alt.Scale(zero=False), title=None)
        line = base.mark_line(color=BLUE, point={"size": 30, "color": BLUE}).encode(y=y)
        mark = alt.Chart().mark_rule(strokeDash=[4, 3], color=MUTED).encode(x=alt.datum(best, type="quantitative"))
        charts.append((mark + line).properties(title=title, width=_WIDTH, height=_HEIGHT))
    return _chart(charts, _ACROSS, datasets)


def _chart(panels: list[alt.LayerChart], across: int, datasets: Mapping[str, Any]) -> alt.ConcatChart:
    # altair copies the data of a chart again and again, unless only its name is there
    chart = alt.concat(*panels, columns=across, spacing=28, config=_CONFIG, datasets=datasets)
    chart.params = [alt.param("picked", value="").param]  # `add_params` would copy the panels again and again
    return chart


def png(figure: alt.ConcatChart, title: str, subtitle: str) -> bytes:
    """Return a chart with a heading as a PNG file. The same chart gives the same bytes."""
    heading = alt.Title(title, subtitle=subtitle, fontSize=17, subtitleFontSize=12, offset=16)
    spec = figure.properties(title=heading, background="white", padding=14).to_dict(validate=False)
    return vl_convert.vegalite_to_png(spec, scale=2)


@functools.cache
def library() -> str:
    """Return the page's JavaScript. Making it takes three seconds, so later processes read it from a file."""
    path = own_folder() / f"vega-{version('vl-convert-python')}.js"
    with contextlib.suppress(OSError):
        return path.read_text(encoding="utf-8")
    bundle = str(vl_convert.javascript_bundle())  # type: ignore[call-arg]  # its stub forgets that it has a default
    with contextlib.suppress(StorageError):
        write_text(path, bundle)
    return bundle


def read_log(folder: Path) -> pd.DataFrame:
    path = folder / "log.csv"
    try:
        return pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error


def save_curves(folder: Path) -> Path:
    path, log = folder / "curves.png", read_log(folder)
    note = f"{len(log)} validations of the averaged weights; dashed: the saved ones, step {_best_step(log):.0f}"
    write_if_changed(path, png(curves_figure(log), f"{folder.parent.name} {folder.name}", note))
    return path
