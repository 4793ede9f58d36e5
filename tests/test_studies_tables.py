"""Tables against numbers worked out by hand; files that come out the same every time."""

import io
import json
import math
import operator
import re
import resource
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import sqlalchemy as sa
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from studies_synthetic import (
    episode,
    part,
    planned,
    points_of,
    settings_of,
    still_episode,
    study_of,
    swept,
    threshold_study,
)

from kerv_cli.engine.record import PHASES, DecodeRecord, Round
from kerv_cli.episodes.identity import Setting
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab import database as tables
from kerv_cli.lab.database import opened
from kerv_cli.lab.plan import Episode
from kerv_cli.lab.store import Study
from kerv_cli.lab.study import save
from kerv_cli.lab.work import RunEpisode
from kerv_cli.report import plots
from kerv_cli.report.measures import Result
from kerv_cli.report.plots import acceptance_figure, colours_of, curves_figure, lines_of, png, study_figures
from kerv_cli.report.report import Report, further_of, render, report
from kerv_cli.report.statistics import PairedCounts, paired_difference, speedup
from kerv_cli.report.summary import SummaryTable, not_in_turn, note_of, summary
from kerv_cli.report.tables import StudyData, load_study
from kerv_cli.report.tally import Tally

PREFILL = Round("prefill", "none", 0, (), (1,), 0, 1, 0, ())


def verify(start: int, drafted: Sequence[int], accepted: int, committed: int) -> Round:
    return Round("verify", "drafter", start, tuple(drafted), (0,) * len(drafted), accepted, committed, 4, (9, 9, 9, 0))


def decode(seconds: float, rounds: Sequence[Round], **more: Any) -> DecodeRecord:
    """One control step of four tokens: N = 4."""
    forwards = sum(r.mode != "skip" for r in rounds)
    phases = {"prefill": seconds / 4, "other": 3 * seconds / 4}
    action = np.zeros((1, 4), np.float32)
    return DecodeRecord((1, 2, 3, 4), action, forwards, tuple(rounds), "x", seconds, phases, **more)


def ar(seconds: float) -> DecodeRecord:
    return decode(seconds, [PREFILL, *(Round("decode", "none", i, (), (1,), 0, 1, 0, ()) for i in (1, 2, 3))])


ALL_ACCEPTED = decode(0.2, [PREFILL, verify(1, (5, 6, 7), accepted=3, committed=3)])
SECOND_REJECTED = decode(
    0.3,
    [PREFILL, verify(1, (5, 9), accepted=1, committed=2), verify(3, (8,), accepted=1, committed=1)],
    compensated=2,
    deviation=0.1,
)
SKIPPED = decode(0.05, [Round("skip", "retrieval", 0, (1, 2, 3, 4), (), 4, 4, 4, ())], skipped=True, deviation=0.3)

# reach is easy, push is hard; (task, label) -> episodes from seed 100000 on
EPISODES: dict[tuple[str, str], list[tuple[bool, list[DecodeRecord]]]] = {
    ("reach-v3", "ar"): [(True, [ar(0.4), ar(0.6)]), (True, [ar(0.3)])],
    ("reach-v3", "kerv"): [(True, [ALL_ACCEPTED, SECOND_REJECTED]), (True, [SKIPPED])],
    ("push-v3", "ar"): [(True, [ar(1.0)]), (True, [ar(1.0)]), (False, [ar(1.0)])],
    ("push-v3", "kerv"): [(True, [ALL_ACCEPTED] * 2), (False, [ALL_ACCEPTED]), (False, [ALL_ACCEPTED])],
}


DISTANCES = (0.01, 0.015, 0.03)  # metres between hand and object at the closest, by episode


def by_hand(setting: Setting, task: str) -> RunEpisode:
    def run(seed):
        record = still_episode(task, seed, *EPISODES[task, setting.label][seed - 100_000])
        return replace(record, closest_approach=DISTANCES[seed - 100_000])

    return run


def two_settings(episodes: int = 4, **about: Any) -> Study:
    settings = {"ar": settings_of("ar", episodes=episodes), "kerv": settings_of("kerv", 9, episodes=episodes)}
    return study_of(settings, ["reach-v3"], "hand", **about)


def hand_study() -> Study:
    """Two episodes of reach and three of push; in every turn both settings."""
    study = two_settings(3)
    wanted = [Episode(one.setting, task, one.seed) for task in ("reach-v3", "push-v3") for one in study.episodes]
    return replace(study, episodes=tuple(one for one in wanted if one.task == "push-v3" or one.seed < 100_002))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return load_study(swept(tmp_path_factory.mktemp("hand"), hand_study(), by_hand)[0])


def row_of(results: Sequence[Result], **wanted: str) -> dict[str, Any]:
    (row,) = (one for one in results if all(getattr(one, name) == value for name, value in wanted.items()))
    return row.columns()


def test_acceptance_by_place_by_hand(data):
    """Five drafts of which all three tokens were accepted; one rejected at its second token; one of a single token."""
    found = further_of(data)["labels"]
    assert "acceptance" not in found["ar"]
    expected = {
        "num_drafts": 7,  # the skipped draft was not verified
        "num_draft_tokens": 7 * 4,
        "num_accepted_tokens": 17,
        "num_accepted_tokens_per_pos": [7, 5, 5],
        "mean_acceptance_length": 1 + 17 / 7,
        "draft_acceptance_rate": 17 / 28,
        "per_position_acceptance_rate": [1, 5 / 7, 5 / 7],
        "acceptance_histogram": [0, 2, 0, 5],
        "num_reached_tokens_per_pos": [7, 6, 5],
        "conditional_acceptance_rate_per_pos": [1, 5 / 6, 1],
        "num_reached_tokens_per_dof": [0, 6, 6, 6],
        "conditional_acceptance_rate_per_dof": [None, 1, 5 / 6, 1],
        "mean_accepted_difference_per_dof": [None, 5, 6, (5 * 7 + 8) / 6],  # the target's tokens are 0
    }
    acceptance = found["kerv"]["acceptance"]
    assert acceptance.keys() == expected.keys()
    for name, value in expected.items():
        assert acceptance[name] == pytest.approx(value), name
    position, dof, number = acceptance_figure(data).to_dict()["concat"]
    shown = [{p["x"]: p["value"] for p in points.to_dict("records")} for points in points_of(acceptance_figure(data))]
    assert shown[0][2] == pytest.approx(100 * 5 / 6)
    assert shown[1] == pytest.approx({"dy": 100, "dz": 100 * 5 / 6, "gripper": 100})
    assert shown[2][3] == pytest.approx(100 * 5 / 7)
    titles = [panel["layer"][1]["encoding"]["x"]["title"] for panel in (position, dof, number)]
    assert titles == ["position in the draft", "degree of freedom", "accepted tokens"]


@given(
    st.lists(st.tuples(st.integers(0, 15), st.integers(0, 6), st.booleans()), min_size=0, max_size=12),
    st.integers(0, 12),
)
def test_tallies_of_parts_add_up_to_the_tally_of_the_whole(rounds, cut):
    records = [
        decode(0.1, [verify(start, range(accepted + rejected), accepted, accepted + 1)])
        for start, accepted, rejected in rounds
    ]
    whole, dofs = Tally.of_records(records, 4).as_dict(), 4
    parts = (Tally.of_records(part, dofs) for part in (records[:cut], records[cut:]))
    assert operator.add(*parts).as_dict() == whole
    assert sum(whole["acceptance_histogram"]) == whole["num_drafts"] == len(records)
    assert sum(whole["num_accepted_tokens_per_pos"]) == whole["num_accepted_tokens"]
    assert sum(whole["num_reached_tokens_per_pos"]) == sum(whole["num_reached_tokens_per_dof"])


def test_one_task_by_hand(data):
    row = row_of(data.task_results, task="reach-v3", label="kerv")
    expected = {
        "episodes": 2,
        "successes": 2,
        "success": 1.0,
        "time_per_step_ms": 1000 * ((0.2 + 0.3) / 2 + 0.05) / 2,  # 150
        "time_per_episode_ms": 1000 * ((0.2 + 0.3) + 0.05) / 2,
        "episode_speedup": (0.4 + 0.6 + 0.3) / (0.2 + 0.3 + 0.05),
        "latency_p50_ms": 200.0,
        "latency_p95_ms": 290.0,  # between the 200 and the 300 of three decodes
        "latency_worst_ms": 300.0,
        "speedup": ((0.4 + 0.6) / 2 + 0.3) / ((0.2 + 0.3) / 2 + 0.05),  # 0.4 s over 0.15 s
        "AL": (3 + 2 + 1) / 3,
        "accepted_per_round": (3 + 1 + 1) / 3,
        "AFEP": (4 + 2) / 2,  # N where nothing was rejected; the skipped chunk had no verification
        "forwards_per_step": (2 + 3 + 0) / 3,
        "skip_rate": 1 / 3,
        "unverified_share": (0 + 2 + 4) / 12,  # compensated tokens and a skipped decode's, of three steps of four
        "compensation_rate": 1 / 3,
        "retrieval_share": 1 / 3,
        "deviation": 0.2,
        "deviation_samples": 2,
        "steps": 3,
        "decodes": 3,
        "pairs": 2,
        "both": 2,
        "only_baseline": 0,
        "mcnemar_p": 1.0,
        "ms.prefill": 150 / 4,
        "ms.other": 150 * 3 / 4,
        "ms.verify": 0.0,
    }
    assert {name: row[name] for name in expected} == pytest.approx(expected)
    found = speedup(np.array([0.5, 0.3]), np.array([0.25, 0.05]), ["reach", "reach"])
    assert (row["speedup_low"], row["speedup_high"]) == pytest.approx((found.low, found.high))


def test_failures_near_the_object_are_a_share_of_the_failures(data):
    shares = {(row.task, row.label): row.measures.near_contact_failure for row in data.task_results}
    assert shares["push-v3", "kerv"] == 0.5  # it failed at 0.015 m and at 0.03 m
    assert shares["push-v3", "ar"] == 0.0
    assert math.isnan(shares["reach-v3", "kerv"])  # nothing failed


@pytest.mark.parametrize("untimed", [["ar"], ["naive_sd", "spec_vla r=3", "spec_vla r=9"]])
def test_no_speedup_is_made_of_what_was_not_timed(tmp_path, untimed):
    """Databases of earlier versions hold episodes that were decoded in batches, without times."""

    def prepare(setting: Setting, task: str) -> RunEpisode:
        def run(seed: int) -> Any:
            record = episode(setting, task, seed)
            if setting.label not in untimed:
                return record
            none = [replace(one, seconds=math.nan, phases=dict.fromkeys(PHASES, math.nan)) for one in record.decodes]
            return replace(record, decodes=tuple(none))

        return run

    store, _ = swept(tmp_path, threshold_study(["reach-v3"], 2), prepare)
    data = load_study(store)
    table = pd.DataFrame([row.columns() for row in data.results]).set_index("label")
    assert table.drop(index="ar")[["speedup", "speedup_low", "episode_speedup"]].isna().all(axis=None)
    assert table["time_per_step_ms"].isna().to_dict() == {label: label in untimed for label in table.index}
    assert table["success"].notna().all()
    printed = {row["setting"]: row["speed, per episode"] for row in summary(data.results)}
    assert printed == {label: "1×" if label == "ar" else "–" for label in table.index}
    assert study_figures(data.results, "threshold.r")


def test_the_baseline_has_no_verifications_and_a_speedup_of_one(data):
    row = row_of(data.task_results, task="reach-v3", label="ar")
    assert row["speedup"] == row["speedup_low"] == row["speedup_high"] == 1.0
    assert row["forwards_per_step"] == 4.0
    assert all(math.isnan(row[name]) for name in ("AL", "accepted_per_round", "AFEP", "deviation"))
    assert row["skip_rate"] == row["unverified_share"] == 0.0


def test_a_row_over_all_tasks_pools_episodes(data):
    row = row_of(data.results, label="kerv")
    own, reference = [0.25, 0.05, 0.2, 0.2, 0.2], [0.5, 0.3, 1.0, 1.0, 1.0]
    assert row["success"] == pytest.approx(3 / 5)
    assert row["time_per_step_ms"] == pytest.approx(1000 * sum(own) / 5)
    assert row["speedup"] == pytest.approx(sum(reference) / sum(own))
    assert row["AL"] == pytest.approx((6 + 4 * 3) / (3 + 4))
    assert row["forwards_per_step"] == pytest.approx((5 + 8) / (3 + 4))
    assert (row["both"], row["only_baseline"], row["only_method"], row["neither"]) == (3, 1, 0, 1)
    assert row["mcnemar_p"] == 1.0
    assert (row["margin"], row["non_inferior"]) == (0.03, False)
    assert row["pairs_to_settle"] == math.inf  # the difference itself lies below the margin
    assert (row["task"], row["tasks"], row["episodes"], row["pairs"]) == ("push-v3;reach-v3", 2, 5, 5)
    found = paired_difference(PairedCounts(3, 1, 0, 1))
    assert (row["difference"], row["difference_low"], row["difference_high"]) == pytest.approx(found)


def harmed(data: StudyData, **harm: Any) -> dict[str, Any]:
    """Kerv's row of reach with other values of its first episode; strings: of all its episodes."""
    episodes = data.episodes.copy()
    mine = episodes.index[(episodes["label"] == "kerv") & (episodes["task"] == "reach-v3")]
    for name, value in harm.items():
        for index in mine if isinstance(value, str) else mine[:1]:
            episodes.at[index, name] = value
    return row_of(replace(data, episodes=episodes).task_results, label="kerv", task="reach-v3")


def test_other_devices_and_initial_states_are_no_pair(data):
    row = harmed(data, device_name="another chip")
    assert (row["pairs"], row["same_run"], row["success"]) == (0, False, 1.0)
    assert math.isnan(row["speedup"])
    row = harmed(data, initial_state=(0.5,))
    assert (row["pairs"], row["speedup"]) == (1, pytest.approx(0.3 / 0.05))
    alone = replace(data, episodes=data.episodes[data.episodes["label"] == "kerv"])
    assert alone.absent == [one for one in data.study.episodes if one.setting.label == "ar"]
    assert all(math.isnan(row.measures.speedup.value) for row in alone.results)


def test_pairs_of_one_block_are_told_from_others(tmp_path):
    """Two blocks of two pairs; of the second, the setting ran alone, later."""
    study = two_settings(block=2)
    early = [one for one in study.episodes if one.seed < 100_002 or one.setting.label == "ar"]
    swept(tmp_path, replace(study, episodes=tuple(early)))
    store, _ = swept(tmp_path, study)
    data = load_study(store)
    row = row_of(data.results, label="kerv")
    assert (row["pairs"], row["same_run"], row["same_block"]) == (4, False, 0.5)
    assert row["speedup"] > 1
    alone = replace(data, episodes=data.episodes.query("seed >= 100002"))
    # success is compared, times are not
    assert [row["speed, per episode"] for row in summary(alone.results)] == ["1×", "–"]
    assert not_in_turn(alone.results) == ["kerv"]
    assert row_of(alone.results, label="kerv")["pairs"] == 2


def test_neighbours_in_the_order_of_speed_are_compared_with_each_other(data):
    (first, speed), (second, _), *_ = data.by_speed
    against = next(row for row in data.compared_with(second).results if row.label == first)
    assert (speed.low, speed.high) == (against.measures.episode_speedup.low, against.measures.episode_speedup.high)
    assert [label for label, _ in data.by_speed][-1] != first
    assert math.isnan(data.by_speed[-1][1].value)


def printed(results: Sequence[Result], width: int = 80, everything: bool = False) -> list[str]:
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(SummaryTable(results, everything, "--all"))
    return console.export_text().splitlines()


def test_a_terminal_shows_the_columns_that_people_need_first_and_all_in_parts_that_fit(data):
    few, wide, narrow = printed(data.results), printed(data.results, 200, True), printed(data.results, 60, True)
    assert ["--all" in " ".join(lines) for lines in (few, wide, narrow)] == [True, False, False]
    assert all(len(line) <= 80 for line in few)
    (line,) = [line for line in few if line.startswith("kerv")]
    assert line.split("  ")[0] == "kerv"
    speed = row_of(data.results, label="kerv")["episode_speedup"]
    assert {"60", "(23–88)", f"{speed:.2f}×"} <= set(line.split())
    assert "verification" not in " ".join(few)
    assert {"unverified", "verification"} <= set(" ".join(wide).split())
    assert {"unverified", "verification"} <= set(" ".join(narrow).split())
    assert all(len(line) <= 60 and "…" not in line for line in narrow)
    assert len([line for line in narrow if line.startswith("kerv")]) > 2


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A threshold study over three tasks, three episodes missing."""
    folder = tmp_path_factory.mktemp("results")
    study = threshold_study(["reach-v3", "push-v3", "door-open-v3"], episodes=3)
    swept(folder, replace(study, episodes=study.episodes[:-3]))
    save(planned(opened(folder), study))
    return folder


@pytest.fixture(scope="module")
def written(results):
    """The files of its report."""
    (written,) = report(opened(results))
    return written.files


def test_report_writes_the_same_bytes_again(results, written):
    names = [path.relative_to(results).as_posix() for path in written]
    assert names == [
        "report/tables/threshold.csv",
        "report/tables/threshold_per_task.csv",
        "report/tables/threshold.json",
        "studies/threshold/report.html",
    ]
    labels = json.loads((results / "report/tables/threshold.json").read_text())["labels"]
    assert labels["spec_vla r=3"]["settings"]["threshold"]["r"] == 3
    assert {"micro over tasks", "reach-v3"} <= set(labels["ar"]["measures"])
    table = pd.read_csv(results / "report/tables/threshold.csv")
    assert table["label"].is_unique
    assert table.groupby("label")["threshold.r"].first().to_dict() == {
        "ar": 0,
        "naive_sd": 0,
        "spec_vla r=3": 3,
        "spec_vla r=9": 9,
    }
    assert len(table.columns) <= 46
    before = {path: path.read_bytes() for path in written}
    for path in written:
        path.unlink()
    (again,) = report(opened(results), "threshold")
    assert again.files == written
    assert {path: path.read_bytes() for path in written} == before
    assert all(len(content) > 2000 for path, content in before.items() if path.suffix != ".csv")


@pytest.mark.usefixtures("written")
def test_the_page_stands_alone(results):
    page = (results / "studies" / "threshold" / "report.html").read_text(encoding="utf-8")
    assert "3 of 36 episodes are missing: spec_vla r=9 on door-open-v3" in page
    assert f"<code>kerv sweep study=threshold results={results}</code>" in page
    assert {"All tasks", "By task", "Settings", "Tables"} <= set(re.findall(r"<h2>(.*?)</h2>", page))
    assert 'href="../../report/tables/threshold_per_task.csv"' in page


def test_a_page_shows_hostile_names_as_text(tmp_path, monkeypatch):
    name = "<img src=x onerror=alert(1)></script>"
    settings = {"ar": settings_of("ar"), name: settings_of("spec_vla", 9)}
    store, _ = swept(tmp_path, study_of(settings, ["reach-v3"], title=name))
    monkeypatch.setattr("kerv_cli.report.report.library", lambda: "")
    page = render(Report(load_study(store)))
    assert "<img" not in page
    assert page.count("</script>") == page.count("<script") == 4


def test_the_interval_of_a_ratio_takes_the_run_as_a_cluster_from_three_runs_on(tmp_path):
    """Two further runs, in which the method takes 1.2 and 1.5 times as long, widen it by Student's t over the runs."""
    study, said, before = threshold_study(["reach-v3", "push-v3"], 2, ()), [], math.nan
    for slower in (1.0, 1.2, 1.5):
        store, _ = swept(tmp_path, study, rerun="all")
        with store.database.writing() as connection:
            mine = tables.SETTINGS.c.label == "naive_sd"
            newest = sa.select(tables.WANTED.c.episode_id).join(tables.SETTINGS).where(mine)
            seconds = {"seconds": tables.EPISODES.c.seconds * slower}
            connection.execute(sa.update(tables.EPISODES).where(tables.EPISODES.c.id.in_(newest)).values(seconds))
        data = load_study(store)
        row = row_of(data.results, label="naive_sd")
        said.append((row["runs"], note_of(data.results)))
        before = row["episode_speedup"] if slower == 1 else before
    assert [runs for runs, _ in said] == [1, 1, 3]
    assert ["alone" in text for _, text in said] == [True, True, False]
    logs = np.log([1, 1 / 1.2, 1 / 1.5])
    assert row["episode_speedup"] == pytest.approx(before * np.exp(logs.mean()))
    reach = np.log(row["episode_speedup_high"] / row["episode_speedup"])
    assert reach > 4.3027 * logs.std(ddof=1) / np.sqrt(3) > 0  # 4.3027: Student's t with two degrees of freedom, 97.5 %


def test_runs_with_seeds_of_their_own_are_the_only_cluster_of_a_ratio(tmp_path):
    """Each run adds a seed per task. The interval is Student's t over the three ratios, pairs are not added again."""
    said, alone = [], []
    for episodes in (1, 2, 3):
        store, _ = swept(tmp_path, threshold_study(["reach-v3", "push-v3"], episodes, ()))
        data = load_study(store)
        row = row_of(data.results, label="naive_sd")
        said.append((row["runs"], row["episodes"]))
        seeds = data.episodes[data.episodes["seed"] == data.episodes["seed"].max()]
        sums = seeds.groupby("label")["seconds"].sum()
        alone.append(sums["ar"] / sums["naive_sd"])
    assert said == [(1, 2), (1, 4), (3, 6)]
    logs = np.log(alone)
    assert row["episode_speedup"] == pytest.approx(np.exp(logs.mean()))
    reach = np.log(row["episode_speedup_high"] / row["episode_speedup"])
    assert reach == pytest.approx(4.3027 * logs.std(ddof=1) / np.sqrt(3), rel=1e-4)


def test_a_run_that_was_resumed_counts_once_and_a_later_setting_joins_all_runs(tmp_path):
    tasks, runs = ["reach-v3", "push-v3"], []
    for episodes, used, radii in ((1, tasks, ()), (2, tasks, ()), (3, tasks[:1], ()), (3, tasks, ()), (3, tasks, (3,))):
        store, _ = swept(tmp_path, threshold_study(used, episodes, radii))
        runs.append({row.runs for row in load_study(store).results})
    assert runs == [{1}, {1}, {1}, {3}, {1}]


def test_a_failed_episode_does_not_decide_the_speed_over_pairs_that_both_solved(tmp_path):
    store, _ = swept(tmp_path, threshold_study(["reach-v3", "push-v3"]))
    with store.database.writing() as connection:
        mine = sa.select(tables.WANTED.c.episode_id).join(tables.SETTINGS).where(tables.SETTINGS.c.label == "naive_sd")
        numbers = connection.scalars(mine).all()
        failed = {"success": False, "seconds": tables.EPISODES.c.seconds * 50}
        solved = {"success": True}
        connection.execute(sa.update(tables.EPISODES).values(solved))
        connection.execute(sa.update(tables.EPISODES).where(tables.EPISODES.c.id == numbers[0]).values(failed))
    data = load_study(store)
    row = row_of(data.results, label="naive_sd")
    both = data.pairs[(data.pairs["label"] == "naive_sd") & (data.pairs["both"] == 1)]
    assert len(both) == row["episodes"] - 1
    expected = both["seconds_baseline"].sum() / both["seconds_method"].sum()
    assert row["solved_speedup"] == pytest.approx(expected)
    assert row["episode_speedup"] < row["solved_speedup"]


# --- charts


def drawn(method: str = "heisd", **parts: dict[str, Any]) -> RolloutSettings:
    """parts: settings by kind, e.g. boundary={"kind": "fused"}."""
    found = settings_of(method, 0 if method == "ar" else 9, episodes=2)
    for kind, values in parts.items():
        setattr(found, kind, part(kind, values["kind"], **{k: v for k, v in values.items() if k != "kind"}))
    return found


def charted(folder: Path, settings: dict[str, RolloutSettings], baseline: str = "ar") -> list[Result]:
    store, _ = swept(folder, study_of(settings, ["reach-v3"], baseline=baseline))
    return load_study(store).results


@pytest.fixture(scope="module")
def boundaries(tmp_path_factory):
    settings = {"ar": drawn("ar"), "always drafter": drawn(boundary={"kind": "always_drafter"})}
    for value in (0.1, 0.3, 0.7):
        settings[f"fused f_star={value}"] = drawn(boundary={"kind": "fused", "f_star": value})
    settings["radius alone"] = drawn(boundary={"kind": "fused", "alpha": 1.0})
    return charted(tmp_path_factory.mktemp("boundaries"), settings)


def test_settings_along_the_axis_are_a_line_and_others_levels(boundaries):
    figure = study_figures(boundaries, "boundary.f_star")["line"]
    speed, success = points_of(figure)
    assert speed["line"].value_counts().to_dict() == {"fused": 3, "ar": 1, "always drafter": 1, "radius alone": 1}
    fused = speed[speed["line"] == "fused"]
    assert list(fused["x"]) == [0.1, 0.3, 0.7]
    expected = {row.label: row.measures.episode_speedup.value for row in boundaries}
    assert dict(zip(speed["setting"], speed["value"], strict=True)) == expected
    assert speed.set_index("line").loc["ar", "value"] == 1.0
    assert speed[speed["line"] != "fused"]["x"].isna().all()
    assert (success["high"] >= success["value"]).all()


def test_a_baseline_that_is_a_point_of_a_series_is_drawn_in_it(tmp_path):
    settings = {}
    for method in ("ar", "kerv"):
        for steps in (1, 4, 8):
            settings[f"{method} chunk={steps}"] = drawn(method)
            settings[f"{method} chunk={steps}"].chunk = steps
    places = lines_of(charted(tmp_path, settings, "ar chunk=4"), "chunk")
    expected = {f"{line} chunk={x}": (line, x) for line in ("ar", "kerv") for x in (1, 4, 8)}
    assert places == expected


def test_a_setting_has_one_colour_in_all_charts(boundaries):
    colours = colours_of(boundaries)
    series = [colours[f"fused f_star={value}"] for value in (0.1, 0.3, 0.7)]
    assert len(set(series)) == 3
    assert series[-1] == colours["fused"]
    (tradeoff,) = study_figures(boundaries, "").values()
    assert all(colours[row["setting"]] == row["colour"] for row in points_of(tradeoff)[0].to_dict("records"))


@pytest.mark.parametrize("axis", ["boundary.kind", "rectifier.use_target_token", "no.such"])
def test_without_numbers_on_the_axis_every_setting_has_a_row_of_speed_and_of_change_in_success(boundaries, axis):
    figures = study_figures(boundaries, axis)
    assert set(figures) == {"tradeoff"}
    speed, change = points_of(figures["tradeoff"])
    assert list(speed["setting"]) == list(change["setting"]) == [row.label for row in boundaries]
    own = change["is_baseline"]
    assert change.loc[own, "low"].isna().all()
    assert (change.loc[~own, "low"] <= change.loc[~own, "value"]).all()


def test_a_trainings_curves_mark_the_best_validation():
    log = pd.DataFrame({"step": [10, 20, 30], "score": [0.1, 0.9, 0.5], "loss": [3.0, 2.0, 1.0]})
    figure = curves_figure(log)
    panels = figure.to_dict()["concat"]
    assert [panel["title"] for panel in panels] == ["validation score (the best is kept)", "loss"]
    assert [panel["layer"][0]["encoding"]["x"]["datum"] for panel in panels] == [20.0, 20.0]
    assert png(figure, "a", "b") == png(figure, "a", "b")


def test_the_javascript_of_a_page_is_made_once_on_a_machine(tmp_path, monkeypatch):
    made = iter(["first", "second", "third"])
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("vl_convert.javascript_bundle", lambda: next(made))
    library = plots.library.__wrapped__  # as in a process of its own
    assert [library(), library()] == ["first", "first"]
    monkeypatch.setattr("kerv_cli.report.plots.version", lambda package: "another")
    assert library() == "second"


def test_a_page_is_made_though_its_javascript_cannot_be_kept(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("vl_convert.javascript_bundle", lambda: "made")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))  # as on a full disk
    try:
        assert plots.library.__wrapped__() == "made"
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
