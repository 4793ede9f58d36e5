"""The report of a study of stress: what a stressed setting is compared with, the figure, the sentence."""

from dataclasses import replace

import pytest
from studies_synthetic import episode, settings_of, study_of, swept

from kerv_cli.base.config import compose
from kerv_cli.episodes.identity import stress_of
from kerv_cli.episodes.resolve import resolve
from kerv_cli.episodes.settings import RolloutSettings, SweepSettings
from kerv_cli.lab.execute import RunEpisode
from kerv_cli.lab.plan import Setting
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.decide import verdict_of
from kerv_cli.report.plots import study_figures
from kerv_cli.report.report import report
from kerv_cli.report.stressed import by_kind, is_stressed, summed_table
from kerv_cli.report.tables import load_study, rows_of
from kerv_cli.worlds.settings import StressSettings

TASKS = ["reach-v3", "push-v3"]
EPISODES = 20


def settings() -> dict[str, RolloutSettings]:
    found: dict[str, RolloutSettings] = {}
    for name, method, r in (("ar", "ar", 0), ("bold", "spec_vla", 9)):
        found[name] = settings_of(method, r, EPISODES)
        for kind in ("push", "light"):
            for level in (1, 4):
                stressed = settings_of(method, r, EPISODES)
                stressed.world.stress = StressSettings(kind, level)
                found[f"{name}, kind={kind} level={level}"] = stressed
    return found


def prepare(setting: Setting, task: str) -> RunEpisode:
    """Pushes of level 4 let half of everything fail; light of level 4 only what is bold."""
    stress = stress_of(setting.settings)
    fails = stress["level"] == 4 and (stress["kind"] == "push" or setting.settings["method"] != "ar")
    return lambda seed: replace(episode(setting, task, seed), success=not (fails and seed % 2))


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stress")
    swept(folder, study_of(settings(), TASKS, "stress", title="", axis=""), prepare)
    return folder


@pytest.fixture(scope="module")
def data(results):
    return load_study(StudyStore(results, "stress"))


@pytest.fixture(scope="module")
def table(data):
    return data.table


def test_a_stressed_setting_is_compared_with_the_baseline_under_the_same_stress(data, table):
    rows = {row["label"]: row for row in rows_of(table, "micro over tasks")}
    assert data.references["bold"] == "ar"
    assert rows["bold, kind=push level=4"]["baseline"] == "ar, kind=push level=4"
    assert rows["bold, kind=push level=4"]["difference"] == 0.0
    assert rows["bold, kind=light level=4"]["difference"] == -0.5
    assert rows["bold, kind=light level=4"]["pairs"] == len(TASKS) * EPISODES
    assert (rows["ar, kind=light level=4"]["stress"], rows["ar, kind=light level=4"]["stress_level"]) == ("light", 4)
    assert (rows["ar"]["stress"], rows["ar"]["stress_level"]) == ("none", 0)


def test_lines_begin_with_the_unstressed_setting(table):
    kinds = by_kind(table)
    assert list(kinds) == ["push", "light"]
    assert [row["label"] for row in kinds["light"]["bold"]] == [
        "bold", "bold, kind=light level=1", "bold, kind=light level=4"
    ]  # fmt: skip


def test_the_figure_has_a_panel_per_kind_and_a_line_per_method(table):
    figures = study_figures(table, "", "Success under stress")
    assert list(figures) == [""]
    panels = figures[""].axes
    assert [panel.get_title(loc="left") for panel in panels] == ["push", "light"]
    assert [list(bars.lines[0].get_ydata()) for bars in panels[1].containers] == [[100, 100, 100], [100, 100, 50]]


def test_sums_count_every_stressed_world_once(table):
    """20 seeds x 2 tasks; level 4 of a push fails half of everything, level 4 of light half of what is bold."""
    found = {row["label"]: row for row in rows_of(summed_table(table))}
    sums = ["light", "push", "level 1", "level 4", "all"]
    assert list(found) == [f"{name} {one}" for one in sums for name in ("ar", "bold")]
    counted = {one: (found[f"bold {one}"]["successes"], found[f"bold {one}"]["episodes"]) for one in sums}
    assert counted == {"light": (60, 80), "push": (60, 80), "level 1": (80, 80), "level 4": (40, 80), "all": (120, 160)}
    assert (found["ar all"]["successes"], found["ar all"]["baseline"]) == (140, "ar all")
    lost = found["bold all"]
    assert (lost["only_baseline"], lost["only_method"], lost["pairs"]) == (20, 0, 160)
    assert lost["difference"] == pytest.approx(-20 / 160)
    assert lost["difference_low"] < -20 / 160 < lost["difference_high"] < 0
    assert not lost["non_inferior"]
    assert found["bold push"]["non_inferior"] is (found["bold push"]["difference_low"] > -0.03)


def test_the_report_writes_the_sums(results):
    written = {path.name for path in report(results, "stress").files}
    assert {"stress_summed.csv", "stress.png"} <= written


def test_the_verdict_says_who_falls_behind_where(table):
    behind, is_shown = verdict_of(table, 3.0)
    assert "less successful than ar: bold, kind=light level=4. More successful: no setting" in behind
    assert not is_shown
    kept = table[(table["stress"] != "light") | (table["stress_level"] != 4)]
    assert "less successful than ar: no setting" in verdict_of(kept, 3.0)[0]
    unsolved = table.assign(both=0, only_baseline=2)
    assert "nothing is compared: ar; ar, kind=push level=1" in verdict_of(unsolved, 3.0)[0]
    assert not is_stressed(table[table["stress"] == "none"])


def test_the_shipped_study_has_every_method_under_every_kind_and_level():
    resolved = resolve(["study=stress", "task=reach", "episodes=1"])
    found = {(s.method, s.world.stress.kind, s.world.stress.level) for s in resolved.settings.values()}
    methods = {method for method, _, _ in found}
    kinds = {kind for _, kind, _ in found}
    assert methods >= {"ar", "one_pass", "one_pass_streak", "early_unverified", "retrieval_unverified"}
    assert len(kinds) == 8
    assert len(found) == len(resolved.settings) == len(methods) * 29
    study = compose("sweep", ["study=stress"], SweepSettings).study
    assert study.baseline == "ar"
