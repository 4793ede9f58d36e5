"""Charts of studies whose axis is text, nothing or a number on some rows only; the log of a training."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from studies_synthetic import part, points_of, settings_of, study_of, swept

from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.report.measures import MICRO
from kerv_cli.report.plots import curves_figure, png, study_figures, with_lines
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


def test_settings_along_the_axis_are_a_line_and_others_levels(boundaries):
    figure = study_figures(boundaries, "boundary.f_star")[""]
    speed, success = points_of(figure)
    assert speed["line"].value_counts().to_dict() == {"fused": 3, "ar": 1, "always drafter": 1, "radius alone": 1}
    fused = speed[speed["line"] == "fused"]
    assert list(fused["x"]) == [0.1, 0.3, 0.7]
    expected = boundaries[boundaries["averaging"] == MICRO].set_index("label")["episode_speedup"]
    assert dict(zip(speed["setting"], speed["value"], strict=True)) == expected.to_dict()
    assert speed.set_index("line").loc["ar", "value"] == 1.0
    assert speed[speed["line"] != "fused"]["x"].isna().all()
    assert (success["high"] >= success["value"]).all()


def test_a_baseline_that_is_a_point_of_a_series_is_drawn_in_it(tmp_path):
    settings = {}
    for method in ("ar", "kerv"):
        for steps in (1, 4, 8):
            settings[f"{method} chunk={steps}"] = setting(method)
            settings[f"{method} chunk={steps}"].chunk = steps
    rows = with_lines(table_of(tmp_path, settings, "ar chunk=4").query("averaging == @MICRO"), "chunk")
    assert {name: list(line["x"]) for name, line in rows.groupby("line")} == {"ar": [1, 4, 8], "kerv": [1, 4, 8]}
    assert rows.set_index("label").loc["ar chunk=4", "speedup"] == 1.0


@pytest.mark.parametrize("axis", ["boundary.kind", "rectifier.use_target_token", "no.such"])
def test_without_numbers_on_the_axis_every_setting_has_a_row_of_speed_and_of_change_in_success(boundaries, axis):
    figures = study_figures(boundaries, axis)
    assert set(figures) == {"_tradeoff"}
    speed, change = points_of(figures["_tradeoff"])
    assert list(speed["setting"]) == list(change["setting"]) == list(boundaries["label"].unique())
    own = change["is_baseline"]
    assert change.loc[own, "low"].isna().all()
    assert (change.loc[~own, "low"] <= change.loc[~own, "value"]).all()


def test_a_trainings_curves_mark_the_best_validation():
    log = pd.DataFrame({"step": [10, 20, 30], "score": [0.1, 0.9, 0.5], "loss": [3.0, 2.0, 1.0]})
    figure = curves_figure(log)
    panels = figure.to_dict()["concat"]
    assert [panel["title"] for panel in panels] == ["score", "loss"]
    assert [panel["layer"][0]["encoding"]["x"]["datum"] for panel in panels] == [20.0, 20.0]
    assert png(figure, "a", "b") == png(figure, "a", "b")
