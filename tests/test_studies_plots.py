"""Figures of studies whose axis is text, nothing or a number on some rows only."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from matplotlib.figure import Figure
from studies_synthetic import part, settings_of, study_of, swept

from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.report.measures import MICRO
from kerv_cli.report.plots import series_of, study_figures
from kerv_cli.report.tables import load_study


def setting(method: str = "heisd", **parts: dict[str, Any]) -> RolloutSettings:
    """parts: settings by kind, e.g. boundary={"kind": "fused"}."""
    found = settings_of(method, 0 if method == "ar" else 9, episodes=2)
    for kind, values in parts.items():
        setattr(found, kind, part(kind, values["kind"], **{k: v for k, v in values.items() if k != "kind"}))
    return found


def table_of(results: Path, settings: dict[str, RolloutSettings], baseline: str = "ar") -> pd.DataFrame:
    store, _ = swept(results, study_of(settings, ["reach-v3"], baseline=baseline))
    return load_study(store).table


@pytest.fixture(scope="module")
def boundaries(tmp_path_factory):
    settings = {"ar": setting("ar"), "always drafter": setting(boundary={"kind": "always_drafter"})}
    for value in (0.1, 0.3, 0.7):
        settings[f"fused f_star={value}"] = setting(boundary={"kind": "fused", "f_star": value})
    settings["radius alone"] = setting(boundary={"kind": "fused", "alpha": 1.0})
    return table_of(tmp_path_factory.mktemp("boundaries"), settings)


def legend(figure: Figure) -> set[str]:
    return {text.get_text() for drawn in figure.legends for text in drawn.get_texts()}


def test_settings_along_the_axis_are_a_line_and_others_levels(boundaries):
    rows = boundaries[boundaries["averaging"] == MICRO]
    series = series_of(rows, "boundary.f_star")
    counts = {"ar": 1, "always drafter": 1, "fused": 3, "radius alone": 1}
    assert {name: len(group) for name, group in series.items()} == counts
    figure = study_figures(boundaries, "boundary.f_star", "Title")[""]
    assert legend(figure) == set(counts)
    speed, _ = figure.axes
    (line,) = (bars.lines[0] for bars in speed.containers)
    assert list(line.get_xdata()) == [0.1, 0.3, 0.7]
    assert list(line.get_ydata()) == [row["episode_speedup"] for row in series["fused"]]
    levels = [level.get_ydata()[0] for level in speed.get_lines() if level.get_linestyle() == "--"]
    assert levels[:2] == [1.0, series["always drafter"][0]["episode_speedup"]]


def test_a_baseline_that_is_a_point_of_a_series_is_drawn_in_it(tmp_path):
    settings = {}
    for method in ("ar", "kerv"):
        for steps in (1, 4, 8):
            settings[f"{method} chunk={steps}"] = setting(method)
            settings[f"{method} chunk={steps}"].chunk = steps
    rows = table_of(tmp_path, settings, "ar chunk=4").query("averaging == @MICRO")
    series = series_of(rows, "chunk")
    assert {name: [row["chunk"] for row in line] for name, line in series.items()} == {
        "ar": [1, 4, 8],
        "kerv": [1, 4, 8],
    }
    assert series["ar"][1]["speedup"] == 1.0


@pytest.mark.parametrize("axis", ["boundary.kind", "rectifier.use_target_token", "no.such"])
def test_without_numbers_on_the_axis_every_setting_is_a_point(boundaries, axis):
    figures = study_figures(boundaries, axis, "Title")
    assert set(figures) == {"_tradeoff"}
    assert legend(figures["_tradeoff"]) == set(boundaries["label"])
