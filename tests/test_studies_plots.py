"""Figures of studies whose axis is text, nothing or a number on some rows only; labels that stay apart."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from studies_synthetic import part, settings_of, study_of, swept

from kerv_cli.base.registry import Part
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.report.drawing import COLOURS, INK, STYLE, new_figure, place_labels, setting_colours
from kerv_cli.report.measures import MICRO
from kerv_cli.report.plots import has_task_map, series_of, study_figures, task_map
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


def boundary_study() -> dict[str, RolloutSettings]:
    found = {"ar": setting("ar"), "always drafter": setting(boundary={"kind": "always_drafter"})}
    for value in (0.1, 0.3, 0.7):
        found[f"fused f_star={value}"] = setting(boundary={"kind": "fused", "f_star": value})
    return found | {"radius alone": setting(boundary={"kind": "fused", "alpha": 1.0})}


@pytest.fixture(scope="module")
def boundaries(tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    unused = setting("kerv", rectifier={"kind": "compensate"}, threshold={"kind": "fixed", "r": 3})
    return table_of(tmp_path_factory.mktemp("boundaries"), boundary_study() | {"unused": unused})


def texts(figure: Figure) -> set[str]:
    shown = {text.get_text() for panel in figure.axes for text in [*panel.get_yticklabels(), *panel.texts]}
    shown |= {text.get_text() for panel in figure.axes for text in panel.get_xticklabels() if text.get_rotation()}
    return shown | {text.get_text() for legend in figure.legends for text in legend.get_texts()}


def test_what_the_axis_does_not_touch_is_a_level(boundaries: pd.DataFrame) -> None:
    table = boundaries
    rows = table[table["averaging"] == MICRO]
    series = series_of(rows, "boundary.f_star")
    assert {name: len(group) for name, group in series.items()} == {
        "always drafter": 1,
        "fused": 3,
        "radius alone": 1,
        "unused": 1,
    }
    figure = study_figures(table, "boundary.f_star", "Title")[""]
    assert {"fused", "always drafter", "radius alone", "unused", "ar"} == texts(figure) - ticks(figure)
    panel = figure.axes[0]
    lines = {line.get_label(): line for line in panel.get_lines()}
    assert list(lines["fused"].get_xdata()) == [0.1, 0.3, 0.7]
    beside = dict(zip((t.get_text() for t in panel.get_xticklabels()), panel.get_xticks(), strict=True))
    level = float(rows[rows["label"] == "always drafter"]["episode_speedup"].iloc[0])
    points = {(line.get_xdata()[0], line.get_ydata()[0]) for line in panel.get_lines() if line.get_marker() == "D"}
    assert (beside["always drafter"], level) in points
    assert min(beside["always drafter"], beside["radius alone"], beside["unused"]) > 0.7


def test_success_is_drawn_from_where_it_matters(boundaries: pd.DataFrame) -> None:
    figure = study_figures(boundaries, "boundary.f_star", "Title")[""]
    lowest = 100 * boundaries[boundaries["averaging"] == MICRO]["success_low"].min()
    assert lowest - 10 <= figure.axes[2].get_ylim()[0] <= max(0.0, lowest)


def ticks(figure: Figure) -> set[str]:
    return {text.get_text() for panel in figure.axes for text in panel.get_yticklabels()}


def test_a_row_without_a_number_on_the_axis_is_a_level_of_its_own(tmp_path: Path) -> None:
    settings = {"ar": setting("ar"), "auto": setting("kerv", threshold={"kind": "kinematic"})}
    for value in (0.1, 0.4):
        settings[f"level k_s={value}"] = setting("kerv", threshold={"kind": "kinematic", "k_s": value})
    rows = table_of(tmp_path, settings).query("averaging == @MICRO")
    series = series_of(rows, "threshold.k_s")
    assert {name: list(group["x"].fillna(-1)) for name, group in series.items()} == {"auto": [-1], "level": [0.1, 0.4]}


def test_a_baseline_that_is_a_point_of_a_series_is_drawn_in_it(tmp_path: Path) -> None:
    settings = {}
    for method in ("ar", "kerv"):
        for steps in (1, 4, 8):
            settings[f"{method} chunk={steps}"] = setting(method)
            settings[f"{method} chunk={steps}"].chunk = steps
    rows = table_of(tmp_path, settings, "ar chunk=4").query("averaging == @MICRO")
    series = series_of(rows, "chunk")
    assert {name: list(group["x"]) for name, group in series.items()} == {"ar": [1, 4, 8], "kerv": [1, 4, 8]}
    assert list(series["ar"]["speedup"])[1] == 1.0


@pytest.mark.parametrize("axis", ["boundary.kind", "rectifier.use_target_token", "no.such"])
def test_without_numbers_on_the_axis_every_setting_is_a_point(boundaries: pd.DataFrame, axis: str) -> None:
    figures = study_figures(boundaries, axis, "Title")
    assert set(figures) == {"_tradeoff"}
    for figure in figures.values():
        assert set(boundaries["label"]) <= texts(figure)


def test_a_part_gives_its_setting_a_colour_once_and_the_baseline_is_ink(monkeypatch: pytest.MonkeyPatch) -> None:
    drafter = Part("proposer", "drafter", "nowhere:build", colour=0x123456)
    none = Part("proposer", "none", "nowhere:build", colour=0x6E7B8B)
    monkeypatch.setattr(
        "kerv_cli.report.drawing.parts",
        lambda kind: {"drafter": drafter, "none": none} if kind == "proposer" else {},
    )
    kinds = {"ar": "none", "spec_vla": "drafter", "hold": "hold", "kerv": "drafter", "one_pass": "none"}
    rows = [{"label": label, "baseline": "ar", "proposer.kind": kind} for label, kind in kinds.items()]
    shades = setting_colours(rows)
    assert shades[:2] == [INK, "#123456"]
    assert shades[2:] == list(COLOURS[:3])
    before = [{"label": "one_pass", "baseline": "ar", "prefill_draft.kind": "drafter", "proposer.kind": "none"}]
    assert setting_colours(before) == ["#123456"]
    assert len(setting_colours([{"label": str(i), "baseline": "ar"} for i in range(30)])) == 30


def test_labels_keep_apart_in_a_crowd() -> None:
    rng = np.random.default_rng(0)
    labels = [(1.0 + 0.3 * rng.uniform(), 97.0 + 3 * rng.uniform(), f"some_method_{i}") for i in range(12)]
    labels += [(1.1, 98.0, "the same"), (1.1, 98.0, "place"), (3.0, 100.0, "far away")]
    with mpl.rc_context(STYLE):
        figure = new_figure(11.0, 6.4)
        panel = figure.subplots()
        panel.set(xlim=(0.5, 3.5), ylim=(60, 106))
        notes = place_labels(figure, panel, labels, ["black"] * len(labels))
        renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
        boxes = [mpl.text.Text.get_window_extent(note, renderer) for note in notes]
        frame = panel.get_window_extent(renderer)
    assert {note.get_text() for note in notes} == {text for _, _, text in labels}
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    assert all(frame.x0 <= b.x0 and b.x1 <= frame.x1 and frame.y0 <= b.y0 and b.y1 <= frame.y1 for b in boxes)


def by_task(**columns: list[Any]) -> pd.DataFrame:
    """Rows of a table by task, as far as the map reads them: two settings on two tasks."""
    rows = {
        "task": ["reach", "reach", "push", "push"],
        "label": ["ar", "bold"] * 2,
        "stress": "none",
        "stress_level": 0,
    }
    return pd.DataFrame(
        rows | {"successes": [9, 2, 5, 7], "episodes": 10, "difference": [np.nan, -0.7, np.nan, 0.2]} | columns
    )


def test_a_map_has_a_field_for_every_task_and_setting_and_its_colours_are_differences() -> None:
    panel = task_map(by_task(), "Title", "about").axes[0]
    assert [text.get_text() for text in panel.texts] == ["9/10", "2/10", "5/10", "7/10"]
    assert [text.get_text() for text in panel.get_yticklabels()] == ["reach", "push"]
    assert [text.get_text() for text in panel.get_xticklabels()] == ["ar", "bold"]
    shown = np.ma.masked_invalid(np.ma.asarray(panel.get_images()[0].get_array()))
    assert shown[:, 0].mask.all()
    assert np.allclose(shown[:, 1], [-70.0, 20.0])
    behind, ahead = panel.get_images()[0].to_rgba(np.array([-70.0, 20.0]))
    assert behind[0] > behind[2]  # red
    assert ahead[2] > ahead[0]  # blue


def test_a_map_needs_two_tasks_two_settings_that_can_be_read_and_one_stress() -> None:
    assert has_task_map(by_task())
    assert not has_task_map(by_task(task=["reach"] * 4))
    assert not has_task_map(by_task(label=["ar"] * 4))
    assert not has_task_map(by_task(stress_level=[0, 4, 0, 4]))
    many = pd.concat([by_task(label=[f"a{i}", f"b{i}"] * 2) for i in range(11)])
    assert not has_task_map(many)
