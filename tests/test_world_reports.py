"""Reports of stressed worlds and of worlds that go on: what a setting is compared with, figures, sentences."""

import dataclasses
from dataclasses import replace
from types import SimpleNamespace

import pandas as pd
import pyarrow as pa
import pytest
from studies_synthetic import episode, points_of, settings_of, study_of, swept

from kerv_cli.engine.record import Delay
from kerv_cli.episodes.identity import Setting, stress_of
from kerv_cli.episodes.rows import DECODE_SCHEMA
from kerv_cli.episodes.settings import RolloutSettings, TimingSettings
from kerv_cli.lab.work import RunEpisode
from kerv_cli.report import tables as report_tables
from kerv_cli.report.plots import study_figures
from kerv_cli.report.statistics import PairedCounts
from kerv_cli.report.summary import summary
from kerv_cli.report.tables import StudyData, load_study
from kerv_cli.report.verdict import verdict_of
from kerv_cli.worlds.settings import StressSettings

TASKS = ["reach-v3", "push-v3"]
EPISODES = 8


def stressed_settings() -> dict[str, RolloutSettings]:
    found: dict[str, RolloutSettings] = {}
    for name, method, r in (("ar", "ar", 0), ("bold", "spec_vla", 9)):
        found[name] = settings_of(method, r, EPISODES)
        for kind in ("push", "light"):
            for level in (1, 4):
                stressed = settings_of(method, r, EPISODES)
                stressed.world.stress = StressSettings(kind, level)
                found[f"{name}, kind={kind} level={level}"] = stressed
    return found


def run_stressed(setting: Setting, task: str) -> RunEpisode:
    """Pushes of level 4 let half of everything fail; light of level 4 only what is bold."""
    stress = stress_of(setting.settings)
    fails = stress["level"] == 4 and (stress["kind"] == "push" or setting.settings["method"] != "ar")
    return lambda seed: replace(episode(setting, task, seed), success=not (fails and seed % 2))


@pytest.fixture(scope="module")
def stressed(tmp_path_factory):
    """The data of a study of stressed worlds."""
    study = study_of(stressed_settings(), TASKS, "stress", title="", axis="")
    return load_study(swept(tmp_path_factory.mktemp("stress"), study, run_stressed)[0])


def test_a_served_policy_whose_rounds_nobody_sent_has_no_acceptance_by_place(monkeypatch):
    """Its server counts verifications, so `verifications` is above 0."""
    rounds = pa.array([[], []], DECODE_SCHEMA.field("rounds").type)
    monkeypatch.setattr(report_tables, "decodes_of", lambda *_: pa.table({"rounds": rounds}))
    episodes = pd.DataFrame({"label": ["far"], "verifications": [7], "seed": [1], "episode": [1]})
    data = SimpleNamespace(labels=["far"], episodes=episodes, study=None)
    assert StudyData.tallies.func(data) == {}


def test_a_line_of_a_chart_joins_the_stress_levels_of_one_clock():
    settings = {}
    for level in (0, 2):
        for clock in ("waits", "real"):
            settings[f"{clock} {level}"] = settings_of("ar")
            settings[f"{clock} {level}"].rollout.clock = clock
            settings[f"{clock} {level}"].world.stress = StressSettings("push" if level else "none", level)
    data = SimpleNamespace(study=study_of(settings, TASKS, "clocks"))
    found = StudyData.unstressed.func(data)
    assert found == {label: f"{label.split()[0]} 0" for label in settings}


def test_a_stressed_setting_is_compared_with_the_baseline_under_the_same_stress(stressed):
    rows = {row.label: row.columns() for row in stressed.results}
    assert stressed.references["bold"] == "ar"
    assert rows["bold, kind=push level=4"]["baseline"] == "ar, kind=push level=4"
    assert rows["bold, kind=push level=4"]["difference"] == 0.0
    assert rows["bold, kind=light level=4"]["difference"] == -0.5
    assert rows["bold, kind=light level=4"]["pairs"] == len(TASKS) * EPISODES
    assert (rows["ar, kind=light level=4"]["stress"], rows["ar, kind=light level=4"]["stress_level"]) == ("light", 4)
    assert (rows["ar"]["stress"], rows["ar"]["stress_level"]) == ("none", 0)


def test_the_figure_has_a_panel_per_kind_and_a_line_per_method(stressed):
    figures = study_figures(stressed.results, "")
    assert list(figures) == ["line"]
    assert [panel.title for panel in figures["line"].concat] == ["push", "light"]
    light = points_of(figures["line"])[1]
    assert {name: list(line["value"]) for name, line in light.groupby("line")} == {
        "ar": [100, 100, 100],
        "bold": [100, 100, 50],
    }


def test_the_verdict_says_who_falls_behind_where(stressed):
    said, is_shown, _ = verdict_of(stressed.results, 3.0)
    assert "less successful than the baseline: bold, kind=light level=4 (than ar, kind=light level=4). More" in said
    assert not is_shown
    kept = [row for row in stressed.results if (row.stress, row.stress_level) != ("light", 4)]
    assert "less successful than the baseline: no setting. More successful: no setting" in verdict_of(kept, 3.0)[0]
    counts = PairedCounts(0, 2, 0, 38)
    unsolved = [replace(row, measures=replace(row.measures, counts=counts)) for row in stressed.results]
    assert "nothing is compared: ar; ar, kind=push level=1" in verdict_of(unsolved, 3.0)[0]


def test_with_two_clocks_the_verdict_names_the_label_of_each_baseline(tmp_path):
    settings: dict[str, RolloutSettings] = {}
    for label in ("mine, waits", "mine, real", "bold, waits", "bold, real"):
        settings[label] = settings_of("ar", 9 * label.startswith("bold"), EPISODES)
        settings[label].rollout.clock = label.split()[1]

    def run(setting: Setting, task: str) -> RunEpisode:
        return lambda seed: replace(episode(setting, task, seed), success=setting.label != "bold, real")

    study = study_of(settings, ["reach-v3"], "clocks", title="", axis="", baseline="mine, waits")
    results = load_study(swept(tmp_path, study, run)[0]).results
    said = verdict_of(results, 3.0).sentence
    assert "less successful than the baseline: bold, real (than mine, real). More successful: no setting" in said


# --- latency report

SHARE = {"ar": 1.0, "spec_vla": 0.4}


def delayed_setting(method: str, r: int, **timing: object) -> RolloutSettings:
    chosen = settings_of(method, r)
    chosen.rollout = TimingSettings(clock="real", latency="constant", **timing)  # type: ignore[arg-type]
    return chosen


def run_delayed(delayed_setting: Setting, task: str) -> RunEpisode:
    """AR takes 30 ms, or what it is asked to; where it takes 100 ms it fails."""
    timing, method = delayed_setting.settings["rollout"], delayed_setting.settings["method"]

    def run(seed):
        record = episode(delayed_setting, task, seed)
        if timing["clock"] == "waits":
            return record
        seconds = SHARE[method] * (timing["latency_ms"] or 30.0) / 1000
        steps = int(seconds * 80) + 1
        delay = Delay(seconds, steps, 0, min(4, steps), max(0, steps - 4))
        decodes = tuple(dataclasses.replace(d, delay=delay) for d in record.decodes)
        fails = method == "ar" and timing["latency_ms"] == 100
        return dataclasses.replace(record, decodes=decodes, success=not fails)

    return run


def test_every_setting_is_compared_with_ar_at_its_latency(tmp_path):
    settings = {"ar waits": settings_of("ar")}
    for method, r in (("ar", 0), ("spec_vla", 9)):
        for ms in (0.0, 100.0):
            for kind in ("none", "chunk"):
                settings[f"{method} ms={ms:g} {kind}"] = delayed_setting(
                    method, r, latency_ms=ms, delay_compensation=kind
                )
    about = {"title": "Latency", "baseline": "ar waits", "axis": "rollout.latency_ms"}
    store, _ = swept(tmp_path, study_of(settings, TASKS, "latency", **about), run_delayed)
    delayed = load_study(store).results
    rows = {row.label: row for row in delayed}
    fast, own, ar = (rows[name] for name in ("spec_vla ms=100 none", "spec_vla ms=0 chunk", "ar ms=100 none"))
    assert fast.baseline == ar.label
    assert (ar.measures.felt_latency_ms, fast.measures.felt_latency_ms) == pytest.approx((100.0, 40.0))
    assert rows[own.baseline].measures.felt_latency_ms == pytest.approx(30.0)
    assert (fast.measures.counts.only_method, fast.measures.pairs) == (8, 8)
    assert fast.measures.difference.low > 0.5
    assert own.measures.difference.value == 0.0
    assert fast.measures.held_share == 0.0 < ar.measures.held_share  # four steps of its chunk, and nine
    printed = {row["setting"]: row["a decode takes, ms"] for row in summary(delayed)}
    assert (printed[fast.label], printed["ar waits"]) == ("40.0", "–")
    answer = verdict_of(delayed, 3.0).sentence
    assert "do not solve the tasks, nothing is compared: ar ms=100 none" in answer
