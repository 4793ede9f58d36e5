"""A study of stress: success of every method against the level, kind by kind, and where a method falls behind
autoregressive decoding under the same stress."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kerv_cli.report import statistics as stats
from kerv_cli.report.drawing import DASHES, STYLE, entitle, new_figure, setting_colours, shared_legend
from kerv_cli.report.measures import MICRO, paired_columns
from kerv_cli.report.scatter import limit_success
from kerv_cli.report.tables import is_number, rows_of

Row = dict[str, Any]
"""A setting's row of `study_table`."""

BEHIND = 0.10
"""A method falls behind where its success is lower than the baseline's, under the same stress, by this or more."""
NONE = "none"

_COLUMNS = 4  # panels beside one another
_DODGE = 0.05  # levels between the points of two methods


def is_stressed(table: pd.DataFrame) -> bool:
    """Whether a study's table compares kinds or levels of stress."""
    return table["stress"].nunique() > 1 or table["stress_level"].nunique() > 1


def stem(label: str) -> str:
    """A setting's label without its stress: `one_pass, kind=push level=2` -> `one_pass`."""
    return re.sub(r",?\s+(kind|level)=\S+", "", label)


def by_kind(table: pd.DataFrame, averaging: str = MICRO) -> dict[str, dict[str, list[Row]]]:
    """Kind -> method -> rows of the table along the level, beginning with the method's unstressed row."""
    rows = rows_of(table, averaging)
    plain = {stem(str(row["label"])): row for row in rows if row["stress"] == NONE}
    kinds: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        if row["stress"] != NONE:
            kinds.setdefault(str(row["stress"]), {}).setdefault(stem(str(row["label"])), []).append(row)
    return {
        kind: {
            name: sorted([*([plain[name]] if name in plain else []), *group], key=lambda row: int(row["stress_level"]))
            for name, group in methods.items()
        }
        for kind, methods in kinds.items()
    }


def stress_figure(table: pd.DataFrame, title: str, about: str, averaging: str = MICRO) -> Figure:
    """One panel per kind: success over the level, one line per method, bars for the 95 % intervals."""
    kinds = by_kind(table, averaging)
    names = list(dict.fromkeys(name for methods in kinds.values() for name in methods))
    first = {name: row for methods in kinds.values() for name, group in methods.items() for row in group[:1]}
    shades = dict(zip(names, setting_colours(first[name] for name in names), strict=True))
    across = min(_COLUMNS, len(kinds))
    down = -(-len(kinds) // across)
    averaged = table[table["averaging"] == averaging]
    with mpl.rc_context(STYLE):
        figure = new_figure(max(8.0, 3.1 * across), 1.4 + 2.7 * down)
        panels = figure.subplots(down, across, squeeze=False, sharey=True).ravel()
        for index, (panel, (kind, methods)) in enumerate(zip(panels, kinds.items(), strict=False)):
            for number, name in enumerate(names):
                shift = _DODGE * (number - (len(names) - 1) / 2)
                _draw(panel, methods.get(name, []), shades[name], _dashes(number), name, shift)
            levels = sorted({int(row["stress_level"]) for group in methods.values() for row in group})
            panel.set(title=kind, xlabel="level", xticks=levels)
            limit_success(panel, averaged)
            if index % across == 0:
                panel.set_ylabel("success, % of episodes")
        for panel in panels[len(kinds) :]:
            panel.set_visible(False)
        entitle(figure, title, about)
        shared_legend(figure, panels, 6)
    return figure


def _dashes(number: int) -> Any:
    return "-" if number == 0 else DASHES[(number - 1) % len(DASHES)]


def _draw(panel: Axes, rows: list[Row], shade: str, dashes: Any, name: str, shift: float) -> None:
    rows = [row for row in rows if is_number(row["success"])]
    if not rows:
        return
    x = [int(row["stress_level"]) + shift for row in rows]
    y = [100 * row["success"] for row in rows]
    for at, row in zip(x, rows, strict=True):
        panel.plot(
            [at, at], [100 * row["success_low"], 100 * row["success_high"]], color=shade, linewidth=1.4, alpha=0.4
        )
    panel.plot(x, y, color=shade, linestyle=dashes, linewidth=1.8, marker="o", markersize=4.5, label=name)


def summed_table(table: pd.DataFrame) -> pd.DataFrame:
    """Successes of every method summed over the levels of a kind, the kinds of a level, and all stresses, and the
    difference from the baseline in the same worlds under the same stresses; the unstressed row is in no sum.

    Args:
        table: `study_table`.

    Returns:
        Columns study, label (`METHOD SUM`), method (label without stress), sum (`push`, `level 2`, `all`), baseline,
        episodes, successes, success, pairs and their counts, mcnemar_p, difference, margin, non_inferior; intervals
        with the endings _low and _high.
    """
    rows = [row for row in rows_of(table, MICRO) if row["stress"] != NONE]
    reference = stem(str(table["baseline"].iloc[0]))
    kinds = sorted({str(row["stress"]) for row in rows})
    levels = sorted({int(row["stress_level"]) for row in rows})
    groups = {kind: [row for row in rows if row["stress"] == kind] for kind in kinds}
    groups |= {f"level {level}": [row for row in rows if int(row["stress_level"]) == level] for level in levels}
    groups["all"] = rows
    return pd.DataFrame(
        _sum([row for row in group if stem(str(row["label"])) == method], method, name, reference)
        for name, group in groups.items()
        for method in _stems(group)
    )


def _sum(rows: list[Row], method: str, name: str, reference: str) -> Row:
    counts = stats.PairedCounts(*(sum(int(row[count]) for row in rows) for count in stats.PairedCounts._fields))
    episodes, successes = (sum(int(row[column]) for row in rows) for column in ("episodes", "successes"))
    bounds = stats.wilson(successes, episodes)
    return {
        "study": rows[0]["study"],
        "label": f"{method} {name}",
        "method": method,
        "sum": name,
        "baseline": f"{reference} {name}",
        "episodes": episodes,
        "successes": successes,
        "success": successes / episodes,
        "success_low": bounds.low,
        "success_high": bounds.high,
        **paired_columns(counts),
    }


def verdict(table: pd.DataFrame) -> str:
    """In which levels of which kinds each method falls behind the baseline, in one sentence."""
    behind = [row for row in rows_of(table, MICRO) if row["pairs"] and row["difference"] <= -BEHIND]
    behind = [row for row in behind if row["label"] != row["baseline"]]
    reference = stem(str(table["baseline"].iloc[0]))
    bound = f"{100 * BEHIND:.0f} points of success or more behind {reference} under the same stress"
    if not behind:
        return f"No method falls {bound}."
    methods = {name: [row for row in behind if stem(str(row["label"])) == name] for name in _stems(behind)}
    clauses = [f"{name}: {_levels_text(rows)}" for name, rows in methods.items()]
    return f"{bound} (* with 95 % confidence behind it): {'; '.join(clauses)}."


def _stems(rows: Iterable[Row]) -> list[str]:
    return list(dict.fromkeys(stem(str(row["label"])) for row in rows))


def _levels_text(rows: Iterable[Row]) -> str:
    """The levels of each kind as text, `camera 3/4*, light 4`; a star where the interval of the difference lies below
    0."""
    levels: dict[str, list[str]] = {}
    for row in rows:
        if row["stress"] == NONE:
            levels.setdefault("unstressed", [])
        else:
            sure = "*" if row["difference_high"] < 0 else ""
            levels.setdefault(str(row["stress"]), []).append(f"{row['stress_level']}{sure}")
    return ", ".join(" ".join([kind, "/".join(numbers)]).strip() for kind, numbers in levels.items())
