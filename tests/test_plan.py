"""A plan is what a study wants minus what the database has, with a reason for the rest."""

import dataclasses
import hashlib
import shlex
from dataclasses import asdict
from typing import Any

import pandas as pd
import pytest
from conftest import raising
from studies_synthetic import IDENTITY, part, planned, settings_of, study_of, swept, threshold_study

from kerv_cli.base.errors import Interrupted, UsageError
from kerv_cli.cli.sweep import tables
from kerv_cli.episodes import identity
from kerv_cli.episodes.identity import ENGINE, Setting, hash_of, without
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.plan import Block, all_episodes, blocks_of
from kerv_cli.lab.store import Study, counts_of, frame_of, loaded, remove_study, row_of, sweep_command
from kerv_cli.lab.study import plan_study
from kerv_cli.report.summary import not_in_turn
from kerv_cli.report.tables import load_study

TASKS = ("reach-v3", "push-v3")
Found = dict[tuple[str, str], tuple[list[int], str]]


on_sqlite = pytest.mark.parametrize("database", ["sqlite"], indirect=True)
"""For what is decided after the database has answered."""


def work(settings: RolloutSettings, weights: dict[str, str] = IDENTITY) -> str:
    return Setting("x", (), without(asdict(settings), {"task"}), weights).work


def changed(path: str, value: Any) -> RolloutSettings:
    settings = settings_of("spec_vla", 9)
    owner: Any = settings
    *groups, name = path.split(".")
    for group in groups:
        owner = getattr(owner, group)
    assert getattr(owner, name) != value
    setattr(owner, name, value)
    return settings


def to_run(split: Study) -> Found:
    """(label, task) -> the seeds to run and why."""
    found: Found = {}
    for one, why in split.missing.items():
        found.setdefault((one.setting.label, one.task), ([], why))[0].append(one.seed)
    return found


def why(split: Study) -> set[str]:
    return set(split.missing.values())


def table_of(store: Study) -> pd.DataFrame:
    return pd.DataFrame([row.columns() for row in load_study(store).results]).set_index("label")


def same_wanted(store: Study, study: Study) -> bool:
    return {(one.setting.label, one.key) for one in loaded(store).episodes} == {
        (one.setting.label, one.key) for one in study.episodes
    }


def test_what_determines_a_result_is_another_episode():
    for path, value in {
        "proposer.kind": "hold", "proposer.depth": 3, "acceptance.strict_dofs": False, "threshold.r": 5,
        "rectifier.kind": "compensate", "boundary.kind": "fused", "world.horizon": 200, "world.camera.size": 64,
        "rollout.latency_ms": 5.0, "runtime.device": "cuda", "runtime.dtype": "bfloat16", "runtime.threads": 2,
        "deviation_every": 4,
    }.items():  # fmt: skip
        assert work(changed(path, value)) != work(settings_of("spec_vla", 9)), path
    for path, value in {
        "seed": 100_001, "episodes": 5, "runtime.workers": 2, "runtime.launch": "sbatch {command}",
        "results": "elsewhere", "record": -1, "record_size": 480,
        "method": "other_name", "policy.target": "same-weights-elsewhere", "task": ["push-v3"],
    }.items():  # fmt: skip
        assert work(changed(path, value)) == work(settings_of("spec_vla", 9)), path


def test_stored_settings_that_have_left_are_passed_over():
    (setting, *_) = threshold_study(["reach-v3"]).settings
    plain = {**setting.settings, "rollout": {**setting.settings["rollout"], "batch": 4, "ar_ms": 5.0}}
    assert dataclasses.replace(setting, settings=plain).on("reach-v3") == setting.on("reach-v3")


def test_weights_and_engine_are_part_of_the_meaning(monkeypatch):
    settings = settings_of("ar")
    assert work(settings, {**IDENTITY, "drafter": "c" * 64}) != work(settings)
    before = work(settings)
    monkeypatch.setattr(identity, "ENGINE", ENGINE + 1)
    assert work(settings) != before
    expected = hashlib.sha256(b'{"a":1,"b":{"c":[1,2],"d":null}}').hexdigest()[:16]
    assert hash_of({"b": {"d": None, "c": [1, 2]}, "a": 1}) == expected
    with pytest.raises(ValueError, match="JSON compliant"):
        hash_of({"a": float("nan")})


def test_blocks_go_by_task_and_seeds():
    settings = {"ar": settings_of("ar", episodes=7), "b": settings_of("spec_vla", 9, episodes=7)}
    study = study_of(settings, TASKS, block=3)
    assert len({one.key for one in study.episodes}) == len(study.episodes) == 2 * 2 * 7
    blocks = blocks_of(study.episodes, 3)
    assert [(b.task, len(b.seeds)) for b in blocks[:4]] == [*(("reach-v3", n) for n in (3, 3, 1)), ("push-v3", 3)]
    assert [b.seeds[0] for b in blocks[:3]] == [100_000, 100_003, 100_006]
    assert all([setting.label for setting in block.settings] == ["ar", "b"] for block in blocks)
    assert blocks[0].title.startswith("reach-v3 100000-100002: ")
    assert blocks[-1].title.startswith("push-v3 100006: ")


def test_settings_take_turns_seed_by_seed_in_a_drawn_order():
    (block,) = blocks_of(threshold_study(["reach-v3"], episodes=5).episodes, 5)
    turns = list(block.turns())
    assert [one.seed for one in turns] == sorted(one.seed for one in turns)
    orders = [tuple(one.setting.label for one in turns[at : at + 4]) for at in range(0, 20, 4)]
    assert {frozenset(order) for order in orders} == {frozenset(threshold_study(["reach-v3"]).labels)}
    assert len(set(orders)) > 1
    assert list(Block(block.episodes).turns()) == turns


def test_what_differs_in_threads_cannot_take_turns_in_one_process():
    study = study_of({"a": settings_of("ar"), "b": changed("runtime.threads", 2)}, ["reach-v3"])
    assert [len(block.settings) for block in blocks_of(study.episodes, 5)] == [1, 1]


def test_a_study_is_counted_before_it_is_planned():
    setting = study_of({"ar": settings_of("ar", episodes=1)}, ["reach-v3"]).settings[0]
    large = dataclasses.replace(setting, settings={**setting.settings, "episodes": 10**7})
    with pytest.raises(UsageError, match="10000000 episodes: at most 1000000"):
        all_episodes([large], ["reach-v3"])


@on_sqlite
def test_more_episodes_run_only_the_new_seeds_in_turn(database):
    swept(database.results, threshold_study(TASKS, episodes=3, radii=(3,)))
    study = threshold_study(TASKS, episodes=5, radii=(3,))
    new = {(label, task): ([100_003, 100_004], "new seeds") for label in study.labels for task in TASKS}
    assert to_run(planned(database, study)) == new
    store, outcome = swept(database.results, study)
    assert (len(outcome.done), len(outcome.reused)) == (12, 18)
    row = table_of(store).loc["spec_vla r=3"]
    assert (row["pairs"], row["same_block"]) == (10, 1.0)
    assert row["speedup"] > 0
    store, outcome = swept(database.results, threshold_study(TASKS, episodes=2, radii=(3,)))
    assert outcome.done == []
    assert table_of(store)["episodes"].tolist() == [4, 4, 4]


def test_sweeps_over_other_tasks_end_in_one_study(database):
    swept(database.results, threshold_study(["reach-v3"]))
    store, _ = swept(database.results, threshold_study(["push-v3"]))
    assert same_wanted(store, threshold_study(TASKS))
    assert counts_of(store) == (32, 32)
    store, _ = swept(database.results, threshold_study(["push-v3"], episodes=2))  # fewer seeds are fewer on all tasks
    assert same_wanted(store, threshold_study(TASKS, episodes=2))
    settings = {label: settings_of("ar", episodes=2) for label in ("ar", "other")}
    store, _ = swept(database.results, study_of(settings, ["push-v3"]))
    assert {(one.setting.label, one.task) for one in loaded(store).episodes} == {
        ("ar", "reach-v3"), ("ar", "push-v3"), ("other", "push-v3")
    }  # fmt: skip


@on_sqlite
def test_another_study_runs_only_what_it_does_not_share(database):
    store, _ = swept(database.results, threshold_study(["reach-v3"]))
    settings = {"renamed": settings_of("spec_vla", 3), "ar": settings_of("ar"), "new": settings_of("spec_vla", 15)}
    study = study_of(settings, ["reach-v3"], "other")
    assert to_run(planned(database, study)) == {("new", "reach-v3"): (list(range(100_000, 100_004)), "new setting")}
    other, outcome = swept(database.results, study)
    assert len(outcome.reused) == 8
    remove_study(store)
    assert row_of(store) is None
    assert counts_of(other) == (12, 12)
    assert len(table_of(other)) == 3
    assert len(to_run(planned(database, threshold_study(["reach-v3"])))) == 2  # only naive_sd and r=9 are gone


@on_sqlite
def test_two_labels_of_one_result_run_once(database):
    study = study_of({"ar": settings_of("ar"), "again": settings_of("ar")}, ["reach-v3"])
    store, outcome = swept(database.results, study)
    assert len(outcome.done) == 4
    assert counts_of(store) == (8, 8)
    data = tables(store, outcome)
    assert data is not None
    assert [row.episodes for row in data.results] == [4, 4]  # both rows have them


@on_sqlite
def test_a_sweep_shows_what_a_report_of_the_same_study_shows(database):
    """Speeds over three runs, if three commands ran all of it."""
    study = threshold_study(["reach-v3"])
    for rerun in ("never", "all", "all"):
        store, outcome = swept(database.results, study, rerun=rerun)
    data = tables(store, outcome)
    assert data is not None
    assert len(data.runs) == len(load_study(store).runs) == 3


@on_sqlite
def test_a_suggested_sweep_names_the_tasks_of_earlier_sweeps(database):
    for tasks in (["reach-v3"], ["push-v3"]):
        store, _ = swept(database.results, threshold_study(tasks), words=[f"task={tasks[0]}"])
    whole = loaded(store)
    suggested = shlex.split(sweep_command(whole, "episodes=9"))
    assert suggested[2:5] == ["study=threshold", "episodes=9", "task=[reach-v3,push-v3]"]


@on_sqlite
def test_times_of_other_blocks_are_no_ratio_until_they_are_taken_in_turn(database):
    swept(database.results, threshold_study(["reach-v3"], radii=(3,)))
    study = threshold_study(["reach-v3"], radii=(3, 9))
    store, _ = swept(database.results, study)
    assert not_in_turn(load_study(store).results) == ["spec_vla r=9"]
    assert table_of(store).loc["spec_vla r=9", "pairs"] == 4  # successes are compared
    swept(database.results, study, rerun="all")
    assert not_in_turn(load_study(store).results) == []


@on_sqlite
def test_a_rerun_keeps_the_older_measurement(database):
    study = threshold_study(["reach-v3"])
    store, _ = swept(database.results, study)
    first = set(frame_of(store)["episode"])
    assert why(planned(database, study, "all")) == {"rerun=all"}
    swept(database.results, study, rerun="all")
    assert first.isdisjoint(frame_of(store)["episode"])
    newest = set(planned(database, study).existing.values())
    assert newest == set(frame_of(store)["episode"])


def test_an_interrupted_rerun_goes_on_without_rerun(database):
    """The same command with rerun=all begins anew."""
    study = threshold_study(["reach-v3"])
    store, _ = swept(database.results, study)
    first = set(frame_of(store)["episode"])
    with pytest.raises(Interrupted, match="run the same command without rerun=all to resume"):
        swept(database.results, study, raising(KeyboardInterrupt(), seeds=[100_002]), rerun="all")
    rest = {(label, "reach-v3"): ([100_002, 100_003], "rerun=all") for label in study.labels}
    assert to_run(planned(database, study)) == rest
    assert len(planned(database, study, "all").missing) == 16
    swept(database.results, study)
    assert first.isdisjoint(frame_of(store)["episode"])


@on_sqlite
def test_an_interrupted_rerun_goes_on_although_the_baseline_has_changed(database):
    """The row of a study stays what it was when it was first planned."""
    study = threshold_study(["reach-v3"], radii=(3,))
    store, _ = swept(database.results, study)
    created = row_of(store).created
    first = set(frame_of(store)["episode"])
    with pytest.raises(Interrupted):
        swept(database.results, study, raising(KeyboardInterrupt()), rerun="all")
    slower = settings_of("ar")
    slower.runtime.threads = 2
    label = "spec_vla r=3"
    study = study_of({"ar": slower, label: settings_of("spec_vla", 3)}, ["reach-v3"])
    seeds = [100_000, 100_001, 100_002, 100_003]
    assert to_run(planned(database, study))[label, "reach-v3"] == (seeds, "rerun=all")
    store, outcome = swept(database.results, study)
    assert (len(outcome.done), len(outcome.reused)) == (8, 0)
    assert first.isdisjoint(frame_of(store)["episode"])
    assert row_of(store).created == created


@on_sqlite
def test_reasons_name_what_changed(database, monkeypatch):
    swept(database.results, threshold_study(["reach-v3"]))

    def reason(settings, task="reach-v3", weights=IDENTITY):
        setting = Setting("spec_vla r=3", (), without(asdict(settings), {"task"}), weights)
        split = plan_study(Study(database, "threshold", "sweep", (setting,), all_episodes([setting], [task])))
        return next(iter(split.missing.values()), "")

    same = settings_of("spec_vla", 3)
    assert reason(same) == ""
    assert reason(same, "push-v3") == "new task"
    assert reason(settings_of("spec_vla", 4)) == "threshold.r 3 → 4"
    assert reason(same, weights={**IDENTITY, "target": "c" * 64}) == "weights of mt10-h1 changed"
    another = dataclasses.replace(same, policy=dataclasses.replace(same.policy, target="mine"))
    assert reason(another, weights={**IDENTITY, "target": "c" * 64}) == "new setting"  # nobody's weights changed
    idle = settings_of("spec_vla", 3)
    idle.policy.artifacts["datastore"] = "mine"  # not read
    assert reason(idle) == ""
    monkeypatch.setattr(identity, "ENGINE", 4)
    assert reason(same) == "the decoding has changed since, to engine 4"


@on_sqlite
def test_what_depends_on_the_order_of_episodes_is_reused_whole(database):
    def study(episodes):
        settings = settings_of("retrieval", episodes=episodes)
        settings.skip = part("skip", "similarity", up=0.25)
        return study_of({"ar": settings_of("ar", episodes=episodes), "heisd": settings}, ["reach-v3"])

    swept(database.results, study(2))
    assert not planned(database, study(2)).missing
    split = planned(database, study(4))
    assert {key: sorted(seeds) for key, (seeds, _) in to_run(split).items()} == {
        ("ar", "reach-v3"): [100_002, 100_003],
        ("heisd", "reach-v3"): [100_000, 100_001, 100_002, 100_003],
    }
    assert why(split) == {"new seeds", "order of episodes"}
    store, outcome = swept(database.results, study(4))
    assert len(outcome.done) == 6
    ran = frame_of(store).query("label == 'heisd'")
    assert ran["block"].nunique() == 1
    assert ran.sort_values("order")["seed"].is_monotonic_increasing
