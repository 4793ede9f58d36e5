"""Episodes whose decodes are computed together: tokens as one by one, no times, and no speedups made of them."""

import itertools
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from command import kerv
from mock_target import MockTarget
from studies_synthetic import episode, swept, threshold_study
from test_compact_target import small, some_observation
from test_episode import settings

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.chunk import Follower
from kerv_cli.engine.decoder import BatchDecoder, Decoder, Parts
from kerv_cli.engine.parts import Fixed
from kerv_cli.engine.record import UNTIMED, EpisodeRecord
from kerv_cli.episodes import runner as run
from kerv_cli.episodes.cost import Profile
from kerv_cli.episodes.identity import Setting
from kerv_cli.episodes.runner import Request, run_together
from kerv_cli.lab.plan import Episode, blocks_of
from kerv_cli.lab.store import Study, frame_of
from kerv_cli.lab.work import EpisodeRunner, RunEpisode
from kerv_cli.methods.early import EarlySettings
from kerv_cli.methods.early.drafter import EarlyDrafter, EarlyProposer
from kerv_cli.methods.unverified import AlwaysSkip, ParallelPass
from kerv_cli.report.plots import study_figures
from kerv_cli.report.profiles import NamedProfile
from kerv_cli.report.reprice import repriced
from kerv_cli.report.summary import summary
from kerv_cli.report.tables import load_study
from kerv_cli.targets.compact.program import compile_parts
from kerv_cli.worlds.metaworld.spec import SPEC

HOME = np.zeros(3)


def shown(count: int) -> list[Observation]:
    """Observations with instructions of one word to four."""
    words = ["pull", "pull the", "pull the drawer", "pull the drawer open"]
    return [
        Observation(o.proprioception, o.state, words[i % 4], {})
        for i, o in enumerate(map(some_observation, range(count)))
    ]


def decoded(decoder: Decoder, observations: Sequence[Observation], history: int = 0) -> tuple[list[Any], list[Any]]:
    """The records of a decoder's decodes, one by one and together, after `history` executed actions."""
    together = BatchDecoder(decoder)
    states, alone = [], []
    for place, observation in enumerate(observations):
        state = together.new_episode()
        for follower in (decoder, state):
            follower.reset("", 0, HOME)
            for step in range(history):
                follower.observe(np.full(4, 0.05 * place - 0.1 * step), HOME)
        alone.append(decoder.decode(observation))
        states.append(state)
    return alone, together.decode(states, observations)


def same(alone: Sequence[Any], together: Sequence[Any]) -> None:
    for one, other in zip(alone, together, strict=True):
        assert one.tokens == other.tokens
        assert (one.actions == other.actions).all()
        assert (one.forwards, one.rounds, one.mode) == (other.forwards, other.rounds, other.mode)
        assert (one.size, one.skipped, one.unverified) == (other.size, other.skipped, other.unverified)
        assert math.isnan(other.seconds)
        assert not math.isnan(one.seconds)
        assert other.phases.keys() == one.phases.keys()
        assert all(map(math.isnan, other.phases.values()))


@pytest.mark.bits
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("batch", [1, 2, 7])
def test_autoregressive_tokens_of_a_batch_are_those_of_its_rows(compiled, batch):
    policy = small()
    if compiled:
        policy.requires_grad_(False)
        compile_parts(policy)
        assert policy.trunk.compiled is not None
    alone, together = decoded(Decoder(policy), shown(batch))
    assert len({one.tokens for one in alone}) > batch / 2
    same(alone, together)


@pytest.mark.bits
@pytest.mark.parametrize("parallel", [False, True])
def test_a_smaller_batch_after_a_larger_one(parallel):
    policy = small(f"target.parallel={str(parallel).lower()}")
    decoder = Decoder(policy, Parts(skip=ParallelPass(policy))) if parallel else Decoder(policy, chunk=1)
    for count in (5, 1, 2):
        same(*decoded(decoder, shown(count)))


@pytest.mark.bits
@pytest.mark.parametrize(("radius", "history"), [(0, 0), (9, 1), (9, 30)])
def test_early_drafts_of_a_batch_follow_each_episodes_own_history(radius, history):
    policy = small()
    torch.manual_seed(3)
    drafter = EarlyDrafter().network(EarlySettings(layers=1, width=32), policy).eval()
    torch.nn.init.normal_(drafter.head.weight, std=1.0)
    draft = EarlyProposer(drafter, policy)
    parts = Parts(prefill_draft=draft, skip=AlwaysSkip(draft), threshold=Fixed(radius))
    alone, together = decoded(Decoder(policy, parts), shown(4), history)
    same(alone, together)
    assert len({one.tokens for one in alone}) == 4
    assert {one.mode for one in together} == {"skip"}


@pytest.mark.bits
def test_prompts_of_different_lengths_are_decoded_apart():
    policy = MockTarget()
    seen = [Observation(np.array([0.1 * i]), np.zeros(0), "on " * (i % 3)) for i in range(6)]
    assert len({policy.encode(one).shape[1] for one in seen}) == 3
    same(*decoded(Decoder(policy), seen))


# --- episodes


class Stub:
    """A world that ends after `seed % 7` steps. opened, closed: of all of them, by task."""

    opened: list[str]
    closed: list[str]

    def __init__(self, task: str) -> None:
        self.spec, self.task, self.instruction, self.horizon = SPEC, task, "pull", 9
        self.steps, self.success, self.succeeded, self.length = 0, False, False, 0
        Stub.opened.append(task)

    def reset(self, seed: int) -> None:
        if seed == 13:
            raise RuntimeError("the table broke")
        self.steps, self.length = 0, seed % 7

    def step(self, action: np.ndarray) -> None:
        self.steps += 1

    def observe(self, cameras: Sequence[str]) -> Observation:
        return some_observation(self.steps)

    def close(self) -> None:
        Stub.closed.append(self.task)

    @property
    def done(self) -> bool:
        return self.steps >= self.length

    end_effector, gripper, initial_state, object_position, object_distance = HOME, 1.0, HOME, HOME, 0.1


@pytest.fixture
def stubs():
    Stub.opened, Stub.closed = [], []
    return Stub


class Forwards(BatchDecoder):
    """Notes how many episodes each decode had."""

    def decode(self, episodes: Sequence[Follower], observations: Sequence[Observation]) -> list[Any]:
        self.sizes.append(len(episodes))
        return super().decode(episodes, observations)


def test_the_next_episode_begins_where_one_ends_and_every_world_is_closed(stubs):
    decoder = Forwards(Decoder(small(), chunk=1))
    decoder.sizes = []
    requests = [Request((task, seed), task, seed) for task in ("a", "b", "c") for seed in range(1, 7)]
    ended = list(run_together(decoder, requests, 4, stubs))
    assert sorted(request.key for request, _ in ended) == sorted(one.key for one in requests)
    for request, record in ended:
        assert (record.task, record.seed) == request.key
        assert record.steps == request.seed
        assert not record.timed
        assert record.wall_seconds > 0
    assert sum(decoder.sizes) == 3 * sum(range(1, 7))
    assert decoder.sizes[:10] == [4] * 10
    assert sorted(decoder.sizes, reverse=True) == decoder.sizes  # full until nothing waits
    assert sorted(stubs.opened) == sorted(stubs.closed)
    assert len(stubs.opened) <= 3 + 3


def test_a_world_that_fails_ends_its_own_episode(stubs):
    requests = [Request(seed, "a", seed) for seed in (10, 11, 12, 13, 15)]
    decoder = BatchDecoder(Decoder(small(), chunk=1))
    ended = {request.key: result for request, result in run_together(decoder, requests, 2, stubs)}
    assert str(ended.pop(13)) == "the table broke"
    assert {seed: record.steps for seed, record in ended.items()} == {10: 3, 11: 4, 12: 5, 15: 1}
    assert sorted(stubs.opened) == sorted(stubs.closed)


def test_stopping_early_closes_the_worlds(stubs):
    running = run_together(BatchDecoder(Decoder(small(), chunk=1)), [Request(0, "a", 1), Request(1, "b", 6)], 2, stubs)
    next(running)
    running.close()
    assert sorted(stubs.opened) == sorted(stubs.closed) == ["a", "b"]


# --- real episodes


@pytest.mark.bits
def test_a_batch_of_real_episodes_is_what_they_are_one_by_one(policies):
    words = ["policy.target=nano-vision"]
    tasks, seeds = ("drawer-open-v3", "reach-v3"), range(100_000, 100_002)
    alone = {
        (task, record.seed): record
        for task in tasks
        for record in map(run.Runner(settings(policies, *words), task).episode, seeds)
    }
    requests = [Request(None, task, seed) for task in tasks for seed in seeds]
    together = [record for _, record in run.run_batch(settings(policies, *words, "rollout.batch=3"), requests)]
    assert len(together) == len(alone)
    for record in together:
        one = alone[record.task, record.seed]
        assert [d.tokens for d in record.decodes] == [d.tokens for d in one.decodes]
        assert (record.success, record.steps, record.decode_steps) == (one.success, one.steps, one.decode_steps)
        assert (record.actions == one.actions).all()
        assert (record.path == one.path).all()
        assert (record.initial_state == one.initial_state).all()


# --- studies


def batched(study: Study, labels: Sequence[str], batch: int = 4) -> Study:
    """The study with these settings in batches."""
    settings = {}
    for one in study.settings:
        rollout = {**one.settings["rollout"], "batch": batch if one.label in labels else 1}
        settings[one.label] = replace(one, settings={**one.settings, "rollout": rollout})
    wanted = tuple(replace(one, setting=settings[one.setting.label]) for one in study.episodes)
    return replace(study, settings=tuple(settings.values()), episodes=wanted)


class Prepared:
    """Runs episodes in turn, and those of a batch together, the last first."""

    def __init__(self, broken: str = "") -> None:
        self.broken, self.groups = broken, []

    def __call__(self, setting: Setting, task: str) -> RunEpisode:
        return lambda seed: episode(setting, task, seed)

    def together(self, wanted: Sequence[Episode]) -> Iterator[tuple[Episode, EpisodeRecord | Exception]]:
        self.groups.append(len(wanted))
        if self.broken == "all":
            raise KervError("no such policy")
        for one in reversed(wanted):
            record = episode(one.setting, one.task, one.seed)
            untimed = [replace(decode, seconds=math.nan, phases=dict(UNTIMED)) for decode in record.decodes]
            fell = one.task == self.broken
            yield one, KervError("it fell") if fell else replace(record, decodes=tuple(untimed))


TASKS = ["reach-v3", "push-v3", "drawer-open-v3"]


def ar_study(*tasks: str, episodes: int = 7, batch: int = 4) -> Study:
    study = batched(threshold_study(tasks or TASKS, episodes=episodes), ["ar"], batch)
    return replace(
        study, settings=study.settings[:1], episodes=tuple(one for one in study.episodes if one.setting.label == "ar")
    )


def test_a_batch_is_another_setting_and_has_no_times(tmp_path):
    assert ar_study().settings[0].work != threshold_study(TASKS, episodes=7).settings[0].work
    prepared = Prepared()
    swept(tmp_path, ar_study("reach-v3"), prepared)
    store, outcome = swept(tmp_path, ar_study(), prepared)
    assert (len(outcome.reused), len(outcome.done), prepared.groups) == (7, 14, [7, 14])
    episodes = frame_of(store)
    assert (episodes["wall_seconds"] > 0).all()
    assert episodes["seconds"].isna().all()
    assert episodes["seconds.prefill"].isna().all()
    assert episodes.groupby("block")["order"].apply(lambda order: order.is_unique).all()
    assert (episodes["forwards"] > 0).all()


def test_blocks_of_a_batch_hold_many_tasks_and_share_out_over_workers():
    wanted, timed = ar_study().episodes, threshold_study(TASKS, episodes=7).episodes
    (block,) = blocks_of(wanted, 5)
    assert {one.task for one in block.episodes} == set(TASKS)
    assert "21 episodes, 4 at a time" in block.title
    assert len(blocks_of(wanted, 5, workers=3)) == 3
    many = ar_study(episodes=60, batch=2).episodes
    assert max(len(block.episodes) for block in blocks_of(many, 5)) == 32
    mixed = blocks_of([*wanted, *timed], 5)
    assert {block.batch for block in mixed} == {1, 4}
    assert all(len({one.setting.settings["rollout"]["batch"] for one in block.episodes}) == 1 for block in mixed)


def test_a_failure_in_a_batch_is_of_its_setting_and_what_ran_is_kept(tmp_path):
    _, outcome = swept(tmp_path, ar_study(), Prepared(broken="all"))
    assert [(failure.reason, len(failure.episodes)) for failure in outcome.failed] == [("no such policy", 7)] * 3
    _, outcome = swept(tmp_path, ar_study(), Prepared(broken="push-v3"))
    assert [failure.reason for failure in outcome.failed] == ["it fell"]
    assert len(outcome.done) + len(outcome.failed[0].episodes) == 21
    assert "push-v3" not in {one.task for one in outcome.done}
    _, again = swept(tmp_path, ar_study(), Prepared())
    assert (len(again.reused), len(again.done)) == (len(outcome.done), len(outcome.failed[0].episodes))


@pytest.mark.parametrize("which", ["baseline", "method"])
def test_no_speedup_is_made_of_what_was_not_timed(tmp_path, which):
    study = threshold_study(TASKS)
    labels = [one for one in study.labels if (which == "baseline") == (one == "ar")]
    store, _ = swept(tmp_path, batched(study, labels), Prepared())
    data = load_study(store)
    table = pd.DataFrame([row.columns() for row in data.results])
    methods = table[table["label"] != "ar"]
    for name in ("speedup", "speedup_low", "episode_speedup"):
        assert methods[name].isna().all()
    assert table.loc[table["rollout.batch"] > 1, "time_per_step_ms"].isna().all()
    assert table.loc[table["rollout.batch"] > 1, "latency_p50_ms"].isna().all()
    assert table.loc[table["rollout.batch"] == 1, "time_per_step_ms"].notna().all()
    assert (methods["pairs"] > 0).all()
    assert methods["success"].notna().all()
    printed = {row["setting"]: row["speed, per episode"] for row in summary(data.results)}
    assert printed.pop("ar") == ("1×" if which == "method" else "–")
    assert set(printed.values()) == {"–"}
    assert study_figures(data.results, "threshold.r")


def test_decodes_without_host_times_have_no_price(tmp_path):
    store, _ = swept(tmp_path, ar_study(), Prepared())
    with pytest.raises(UsageError, match="setting 'ar' ran 4 episodes at a time, without times"):
        repriced(load_study(store), [NamedProfile("there", Profile(31, {}))])


# --- the command


def test_a_rollout_in_batches_prints_success_and_goes_on_where_it_was(results, monkeypatch):
    words = ["policy=state", "policy.target=nano-state", "task=reach-v3,push-v3", "world.horizon=8"]
    command = ["rollout", "method=ar", "episodes=2", "rollout.batch=3", *words, f"results={results}"]
    original = EpisodeRunner.together

    def interrupted(self, wanted):
        yield from itertools.islice(original(self, wanted), 2)
        raise KeyboardInterrupt

    monkeypatch.setattr(EpisodeRunner, "together", interrupted)
    stopped = kerv(*command, code=130)
    assert "2 of 4 episodes of" in stopped.stderr
    monkeypatch.setattr(EpisodeRunner, "together", original)
    again = kerv(*command)
    assert "2 of 4 episodes are there" in again.stderr
    assert "not timed: 3 episodes at a time" in again.stdout
    assert "time by phase" not in again.stdout
    for name in ("reach-v3", "push-v3", "all"):
        assert re.search(rf"{name} .*/[24] .*–", again.stdout), again.stdout
    assert not list(results.glob("rollouts/*/rollouts/*.rrd"))
    rows = json.loads(kerv(*command, "--json").stdout)["tasks"]
    assert [row["time_per_step_ms"] for row in rows] == [None] * len(rows)
