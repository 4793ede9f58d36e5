"""Success at a latency that the world feels, from a made-up study: every setting beside AR at the same latency."""

import dataclasses

import pytest
from studies_synthetic import episode, settings_of, study_of, swept

from kerv_cli.engine.record import Delay
from kerv_cli.episodes.settings import RolloutSettings, TimingSettings
from kerv_cli.lab.execute import RunEpisode
from kerv_cli.lab.plan import Setting
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.decide import verdict_of
from kerv_cli.report.plots import latency_figure
from kerv_cli.report.report import report
from kerv_cli.report.summary import summary_frame
from kerv_cli.report.tables import latency_table, load_study

SHARE = {"ar": 1.0, "spec_vla": 0.4}


def setting(method: str, r: int, **timing: object) -> RolloutSettings:
    chosen = settings_of(method, r)
    chosen.rollout = TimingSettings(clock="real", latency="profile", profile="p", **timing)  # type: ignore[arg-type]
    return chosen


def prepare(setting: Setting, task: str) -> RunEpisode:
    """AR takes 30 ms, or what it is asked to; where it takes 100 ms it fails."""
    timing, method = setting.settings["rollout"], setting.settings["method"]

    def run(seed):
        record = episode(setting, task, seed)
        if timing["clock"] == "waits":
            return record
        seconds = SHARE[method] * (timing["ar_ms"] or 30.0) / 1000
        steps = int(seconds * 80) + 1
        delay = Delay(seconds, steps, 0, min(4, steps), max(0, steps - 4))
        decodes = tuple(dataclasses.replace(d, delay=delay) for d in record.decodes)
        fails = method == "ar" and timing["ar_ms"] == 100
        return dataclasses.replace(record, decodes=decodes, success=not fails)

    return run


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    settings = {"ar waits": settings_of("ar")}
    for method, r in (("ar", 0), ("spec_vla", 9)):
        for ms in (0.0, 20.0, 100.0):
            for kind in ("none", "chunk"):
                settings[f"{method} ar_ms={ms:g} {kind}"] = setting(method, r, ar_ms=ms, delay_compensation=kind)
    about = {"title": "Latency", "baseline": "ar waits", "axis": "rollout.ar_ms"}
    folder = tmp_path_factory.mktemp("latency")
    swept(folder, study_of(settings, ["reach-v3", "push-v3"], "latency", **about), prepare)
    return folder


def test_every_setting_is_compared_with_ar_at_its_latency(results):
    whole = load_study(StudyStore(results, "latency")).table
    rows = latency_table(whole).set_index("label")
    assert len(rows) == 12  # not the world that waits
    fast = rows.loc["spec_vla ar_ms=100 none"]
    assert fast["ar"] == "ar ar_ms=100 none"
    assert (fast["ar_latency_ms"], fast["felt_latency_ms"]) == pytest.approx((100.0, 40.0))
    assert (fast["difference"], fast["only_method"], fast["pairs"]) == (1.0, 8, 8)
    assert fast["difference_low"] > 0.5
    own = rows.loc["spec_vla ar_ms=0 chunk"]
    assert (own["ar_latency_ms"], own["felt_latency_ms"]) == pytest.approx((30.0, 12.0))
    assert own["difference"] == 0.0
    assert fast["held_share"] == 0.0 < rows.loc["ar ar_ms=100 none"]["held_share"]  # four steps of its chunk, and nine
    printed = summary_frame(whole).set_index("setting")
    assert printed.loc["spec_vla ar_ms=100 none"]["a decode takes, ms"] == "40.0"
    assert printed.loc["ar waits"]["a decode takes, ms"] == "–"
    answer, _ = verdict_of(whole, 3.0)
    assert "do not solve the tasks, nothing is compared: ar ar_ms=100 none" in answer
    assert latency_table(whole[whole["label"] == "ar waits"]).empty


def test_the_figure_has_a_panel_per_compensation_and_a_line_per_method(results):
    table = latency_table(load_study(StudyStore(results, "latency")).table)
    figure = latency_figure(table, "title")
    panels = figure.axes
    assert [panel.get_title(loc="left") for panel in panels] == [
        "delay compensation: none",
        "delay compensation: chunk",
    ]
    ar, _ = (bars.lines[0] for bars in panels[0].containers)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["ar", "spec_vla"]
    assert list(ar.get_xdata()) == pytest.approx([20.0, 30.0, 100.0])  # 30: its own latency
    assert list(ar.get_ydata()) == [100.0, 100.0, 0.0]


def test_a_report_has_the_table_and_the_figure(results):
    names = {path.name for path in report(results, "latency").files}
    assert {"latency.csv", "latency_latency.csv", "latency_latency.png", "report.html"} <= names
