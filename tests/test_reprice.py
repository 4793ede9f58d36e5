"""Speeds on other machines, per episode and per control step."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from command import kerv, refusal, told
from studies_synthetic import episode, still_episode, swept, threshold_study
from test_board import client_of

from kerv_cli.base.paths import shipped_dir
from kerv_cli.episodes.cost import FORWARDS, Profile, prices, read_profile, source_costs, work_of_record
from kerv_cli.lab.database import opened
from kerv_cli.lab.store import Study
from kerv_cli.report.profiles import NamedProfile, open_profiles
from kerv_cli.report.reprice import Priced, own_profiles, prices_table, repriced
from kerv_cli.report.summary import repriced_summary
from kerv_cli.report.tables import StudyData, load_study

pytestmark = pytest.mark.usefixtures("quick_report")

PROFILE = Profile(
    31,
    {
        "encode": ((1,), (0.005,)),
        "prefill": ((31, 46), (0.008, 0.0095)),
        "verify": ((1, 16), (0.002, 0.005)),
        "feed": ((4, 31), (0.0005, 0.002)),
        "draft": ((2, 14), (0.001, 0.013)),
        "tree": ((2, 5), (0.002, 0.008)),
    },
    tokens=16,
)
ABOUT = {"target": "vla-150m", "dtype": "bfloat16", "device_name": "GPU", "kerv_version": "0"}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    swept(folder, threshold_study(["reach-v3", "push-v3"], radii=(9,)))
    return folder


@pytest.fixture
def data(results):
    return load_study(Study(opened(results), "threshold"))


def profile_file(results: Path, name: str = "there", without: str = "", device: str = "GPU", **changes: Any) -> None:
    profile = PROFILE.as_dict() | changes
    profile["phases"] = {kind: costs for kind, costs in profile["phases"].items() if kind != without}
    folder = results / "bench"
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps({**ABOUT, "device_name": device, "profile": profile}))


def table_of(priced: Sequence[Priced]) -> pd.DataFrame:
    return pd.DataFrame(prices_table(priced)).set_index("label")


def priced_on(data: StudyData) -> set[str]:
    return {row.machine.name for row in repriced(data, own_profiles(data), lenient=True)}


def test_an_episode_costs_its_decodes_at_the_profiles_costs(data):
    """Ratios of means over episodes and over times per step, of the very records of the sweep."""
    table = table_of(repriced(data, [NamedProfile("there", PROFILE)]))
    seconds: dict[str, list[float]] = {}
    steps: dict[str, list[int]] = {}
    for one in data.study.episodes:
        record = episode(one.setting, one.task, one.seed)
        priced = [prices(work_of_record(decode), PROFILE)[0] for decode in record.decodes]
        seconds.setdefault(one.setting.label, []).append(sum(priced))
        steps.setdefault(one.setting.label, []).append(record.steps)
    for label in ("naive_sd", "spec_vla r=9"):
        row = table.loc[label]
        mean = {name: np.mean(values) for name, values in seconds.items()}
        per_step = {name: np.mean(np.divide(values, steps[name])) for name, values in seconds.items()}
        assert row["time_per_episode_ms"] == pytest.approx(1000 * mean[label])
        assert row["episode_speedup"] == pytest.approx(mean["ar"] / mean[label])
        assert row["speedup"] == pytest.approx(per_step["ar"] / per_step[label])
        assert row["episode_speedup_low"] < row["episode_speedup"] < row["episode_speedup_high"]
        assert row["measured_speedup"] != row["speedup"]
    first = data.episodes[data.episodes["label"] == "ar"].iloc[0]
    assert table.loc["ar", "latency_p95_ms"] == pytest.approx(1000 * (0.005 + 0.008 + 15 * 0.002 + 0.001))
    assert first["decodes"] == len(first["decode_seconds"])


def report(results: Path, *words: str) -> str:
    return told("report", "study=threshold", f"results={results}", *words)


def test_a_report_prices_the_study_on_several_machines(results):
    profile_file(results)
    profile_file(results, "elsewhere", device="CPU")
    assert "vla-150m, GPU: per episode" in report(results, "on=there,elsewhere", "loss=99")
    table = pd.read_csv(results / "report/tables/threshold_on.csv")
    assert sorted(set(table["on"])) == ["elsewhere", "there"]
    page = (results / "studies/threshold/report.html").read_text()
    assert '<p class="answer">spec_vla r=9 loses less than 99 points' in page  # a label begins with a small letter
    assert "On other machines" in page
    assert "same tokens in the same control steps" in page


def test_a_table_shows_how_a_row_depends_on_the_encoder(data):
    """At its floor, twice its floor, and 8 ms, each with the engine's system time."""
    about = {**ABOUT, "projected": True, "engine": "eager", "encoder_floor": 0.001, "encoder_system": 0.006}
    named = NamedProfile("there", dataclasses.replace(PROFILE, about=about))
    assert named.title == "vla-150m, GPU, eager, projected"
    priced = repriced(data, [named])
    rows = table_of(priced)
    for column, seconds in (("encoder_floor", 0.007), ("encoder_twice", 0.008), ("encoder_8ms", 0.014)):
        other = dataclasses.replace(PROFILE, phases={**PROFILE.phases, "encode": ((1,), (seconds,))})
        measured = repriced(data, [NamedProfile("other", other)])
        assert list(rows[column]) == pytest.approx([row.measures.episode_speedup.value for row in measured])
        assert not any(row.encoders for row in measured), "a measured encoder has one cost"
    fast, slow = rows.loc["spec_vla r=9", ["encoder_floor", "encoder_8ms"]]
    assert abs(1 - fast) > abs(1 - slow), "what every method pays hides their difference"
    shown = [text for row in repriced_summary(priced) for name, text in row.items() if "encoder" in name]
    assert shown[0] == "1 / 1 / 1×"
    assert shown[-1] == f"{fast:.2f} / {rows.loc['spec_vla r=9', 'encoder_twice']:.2f} / {slow:.2f}×"


def test_a_report_of_several_studies_prices_each(tmp_path):
    for name in ("first", "second"):
        study = threshold_study(["reach-v3"], episodes=1, radii=(9,), name=name)
        swept(tmp_path, dataclasses.replace(study, machines=("there",)))
    profile_file(tmp_path)
    priced = json.loads(kerv("report", f"results={tmp_path}", "--json").stdout)["priced"]
    assert {row["study"] for row in priced} == {"first", "second"}


def test_a_study_is_also_priced_by_the_profile_of_its_own_machine(tmp_path):
    """The report, and the board's page of the study, show the estimate beside the measurement."""
    study = dataclasses.replace(threshold_study(["reach-v3"], radii=(9,)), machines=("there", "nowhere"))
    store, _ = swept(tmp_path, study)
    data = load_study(store)
    device = data.episodes["device_name"].iloc[0]
    assert priced_on(data) == set()
    profile_file(tmp_path)
    own = "mt10-h1-float32"
    for name, machines in (("another one", {"there"}), (device, {"there", own})):
        profile_file(tmp_path, own, device=name)
        assert priced_on(data) == machines
    with client_of(tmp_path) as client:
        page = client.get("/studies/threshold/tables").text
    assert f"vla-150m, {device}: per episode" in page
    assert f"measured, {device}: per episode" in page
    assert "GPU: per episode" not in page, "the board prices no other machine, which would take time"
    profile_file(tmp_path, own, without="feed", device=device)
    assert priced_on(data) == {"there"}, "a profile that lacks a cost is left out"


def test_a_report_compares_with_another_baseline(results):
    tables = []
    for words, name in (([], "threshold"), (["baseline='spec_vla r=9'"], "threshold_against_spec_vla_r_9")):
        report(results, *words)
        table = pd.read_csv(results / f"report/tables/{name}.csv")
        tables.append(table.set_index("label"))
    usual, other = tables
    assert other["episode_speedup"]["ar"] == pytest.approx(1 / usual["episode_speedup"]["spec_vla r=9"], rel=1e-3)
    assert set(other["baseline"]) == {"spec_vla r=9"}
    # the page of another comparison lies beside the study's own and its recordings, and does not replace it
    pages = {path.relative_to(results / "studies").as_posix() for path in (results / "studies").rglob("report*.html")}
    assert {"threshold/report.html", "threshold/report_against_spec_vla_r_9.html"} <= pages
    assert not [page for page in pages if "against" in page.split("/")[0]]
    refusal("report", "study=threshold", f"results={results}", "baseline=other", code=2)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (
            {"without": "draft"},
            "no cost of 'draft', which setting 'naive_sd' needs. Measure it with 'kerv bench target=",
        ),
        ({"tokens": 7}, "chunks of 7 tokens, setting 'ar' decodes 16. Measure it with 'kerv bench target=vla-150m"),
        ({"format": 9}, "has another format than 2: measure it with 'kerv bench target=vla-150m"),
        ({"prompt": "many"}, "holds no latency profile"),
    ],
)
def test_a_profile_that_cannot_price_the_study_is_refused(results, changes, says):
    profile_file(results, "odd", **changes)
    assert says in refusal("report", "study=threshold", f"results={results}", "on=odd", code=2)


def test_what_is_not_there_is_refused(results):
    absent = refusal("report", "study=threshold", f"results={results}", "on=nowhere", code=2)
    assert "on=nowhere: no such profile. Make one with 'kerv bench target=TARGET" in absent


def test_shipped_profiles_can_price_what_ships(tmp_path):
    shipped = sorted((shipped_dir().parent / "bench").glob("*.json"))
    for path in shipped:
        profile = read_profile(path)
        assert profile.lacks([*FORWARDS, *source_costs()]) == []
        assert {"target", "dtype", "device_name"} <= set(profile.about)
    assert [machine.name for machine in open_profiles(tmp_path, [path.stem for path in shipped])] == [
        path.stem for path in shipped
    ]


def test_the_hands_way_of_an_episode():
    record = still_episode("reach-v3", 0, True, [])
    t = np.arange(6) / record.space.control_hz
    path = np.stack([t**3, 0 * t, 0 * t], 1).astype(np.float32)
    assert dataclasses.replace(record, path=path).path_length == pytest.approx(t[-1] ** 3)
