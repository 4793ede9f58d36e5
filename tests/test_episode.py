"""Real episodes on Meta-World: closed loop, pairing, what is timed and drawn; and a world that does not wait."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import refusal
from examples.insertion import SPEC as INSERTION
from examples.point_mass import SPEC, PointWorld

from kerv_cli.base.config import compose
from kerv_cli.base.errors import KervError
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.chunk import Follower
from kerv_cli.engine.record import PHASES, DecodeRecord, Delay, EpisodeRecord, Round
from kerv_cli.episodes import policy as policies_of
from kerv_cli.episodes import runner as run
from kerv_cli.episodes.cost import Profile
from kerv_cli.episodes.episode import RealClock, run_episode, steps_during
from kerv_cli.episodes.policy import profiled
from kerv_cli.episodes.rows import decodes_table, episode_row
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.worlds.metaworld.spec import SPEC as METAWORLD
from kerv_cli.worlds.metaworld.world import MetaWorld
from kerv_cli.worlds.settings import EVALUATION_SEED


def settings(results: Path, *overrides: str) -> RolloutSettings:
    common = ["task=drawer-open", "world.horizon=10", "record=0", f"results={results}"]
    return compose("rollout", [*common, *overrides], RolloutSettings)


def episodes(chosen: RolloutSettings, count: int = 2) -> list[EpisodeRecord]:
    runner, seeds = run.Runner(chosen, "drawer-open-v3"), range(EVALUATION_SEED, EVALUATION_SEED + count)
    return [runner.episode(seed, run.is_recorded(chosen, seed)) for seed in seeds]


@pytest.mark.bits
@pytest.mark.parametrize("policy", ["nano-state", "nano-vision"])
def test_strict_speculation_is_ar_in_closed_loop(policies, policy):
    ar = episodes(settings(policies, "method=ar", f"policy.target={policy}"))
    strict = episodes(settings(policies, "method=naive_sd", f"policy.target={policy}", "proposer.depth=4"))
    for a, b in zip(ar, strict, strict=True):
        assert (a.actions == b.actions).all()
        assert (a.path == b.path).all()
        assert [d.tokens for d in a.decodes] == [d.tokens for d in b.decodes]
    assert {d.forwards for e in ar for d in e.decodes} == {16}
    assert all(d.mode == "drafter" for e in strict for d in e.decodes)


def test_the_record_of_an_episode_adds_up(policies):
    wanted = settings(
        policies, "method=spec_vla", "threshold.r=200", "acceptance.strict_dofs=false", "policy.target=nano-vision"
    )
    wanted.record = 1
    record = episodes(wanted, 1)[0]
    assert record.steps == 10 == len(record.actions) == len(record.path) - 1 == len(record.gripper) - 1
    assert record.decode_steps == (0, 4, 8)
    assert sorted(record.frames) == list(range(11))
    assert record.frames[0].shape == (240, 240, 3)
    for decode in record.decodes:
        assert set(decode.phases) == set(PHASES)
        assert sum(decode.phases.values()) == pytest.approx(decode.seconds, rel=1e-6)
        assert decode.forwards == len(decode.rounds)
        assert sum(r.committed for r in decode.rounds) == len(decode.tokens) == 16
        assert decode.variability > 0
    assert (record.environment, record.space) == ("metaworld", METAWORLD.actions)
    first = METAWORLD.open_world("drawer-open-v3")
    first.reset(EVALUATION_SEED)
    assert (record.initial_state == first.initial_state).all()
    first.close()


def test_a_state_policy_never_draws(policies, monkeypatch):
    def drawn(self, camera=None):
        raise AssertionError("a frame was drawn that nobody reads")

    monkeypatch.setattr(MetaWorld, "_draw", drawn)
    assert len(episodes(settings(policies, "policy.target=nano-state"), 1)) == 1
    with pytest.raises(AssertionError, match="nobody reads"):
        episodes(settings(policies, "policy.target=nano-vision"), 1)


def test_deviation_is_sampled_and_zero_for_ar_itself(policies):
    ar = episodes(settings(policies, "policy.target=nano-state", "deviation_every=2"), 1)[0]
    assert [d.deviation for d in ar.decodes] == [None, 0.0, None]
    loose = settings(policies, "policy.target=nano-state", "deviation_every=1", "method=spec_vla", "threshold.r=120")
    assert any(d.deviation for d in episodes(loose, 1)[0].decodes)


# --- a world that goes on while the policy decodes


HZ = SPEC.actions.control_hz


class Numbered(Follower):
    """Its chunks of four are numbered: action `i` of decode `n` is (n, i) in hundredths of the limits."""

    def __init__(self, seconds: Callable[[int], float] = lambda n: 0.0) -> None:
        super().__init__(SPEC.actions)
        self.seconds, self.number = seconds, 0

    def decode(self, observation: Observation) -> DecodeRecord:
        """The next numbered chunk."""
        self.number += 1
        actions = np.array([(self.number, i) for i in range(4)], np.float32) / 2000
        return DecodeRecord((), actions, 0, (), "ar", self.seconds(self.number), {})


def played(record: EpisodeRecord) -> list[tuple[int, int]]:
    """The executed actions by their numbers; (0, 0) is standing still."""
    return [(round(2000 * a), round(2000 * b)) for a, b in record.actions.tolist()]


def point_episode(clock: RealClock | None, decoder: Any = None, horizon: int = 0) -> EpisodeRecord:
    """In a world in which the numbers lead nowhere near the goal."""
    with PointWorld(SPEC, "push-point", horizon=horizon) as world:
        return run_episode(world, decoder or Numbered(), EVALUATION_SEED + 1, clock=clock)


def constant(steps: float, compensation: str = "none") -> RealClock:
    return RealClock(lambda decode: steps / HZ, SPEC.actions, compensation)


@pytest.mark.bits
@pytest.mark.parametrize("compensation", ["none", "chunk"])
def test_without_latency_an_episode_is_bit_for_bit_the_one_in_a_waiting_world(policies, compensation):
    real = ["rollout.clock=real", "rollout.latency=constant", f"rollout.delay_compensation={compensation}"]
    a, b = (episode_of(policies, "method=spec_vla", *words) for words in ([], real))
    assert (a.actions == b.actions).all()
    assert (a.path == b.path).all()
    assert [d.tokens for d in a.decodes] == [d.tokens for d in b.decodes]
    assert a.decode_steps == b.decode_steps
    assert [d.delay for d in a.decodes] == [None] * len(a.decodes)
    assert [d.delay for d in b.decodes] == [Delay(0.0, 0, step) for step in b.decode_steps]


def episode_of(results: Path, *overrides: str) -> EpisodeRecord:
    chosen = settings(results, "policy.target=nano-state", *overrides)
    policies_of.check(chosen)
    return episodes(chosen, 1)[0]


@pytest.mark.parametrize(
    ("steps", "chunk"), [(1, (0, 1, 2, 3)), (3, (0, 1, 2, 3)), (4, (0, 1, 2, 3)), (6, (0, 1, 2, 3, 3, 3))]
)
def test_the_chunk_before_is_executed_on_and_then_its_last_action_is_held(steps, chunk):
    """k <= H: k old actions after an observation, and no pause after the first chunk."""
    record, pause = point_episode(constant(steps)), max(0, steps - 4)
    assert played(record)[: steps + 2 * len(chunk)] == [(0, 0)] * steps + [(n, i) for n in (1, 2) for i in chunk]
    assert record.decodes[0].delay == Delay(steps / HZ, steps, 0, carried=0, held=steps)
    assert record.decodes[1].delay == Delay(steps / HZ, steps, max(4, steps), steps - pause, pause)
    assert record.decode_steps[:2] == (steps, steps + len(chunk))


def test_a_fake_clock_says_how_long_each_decode_took():
    """Measured seconds, rounded up; a decode begins as early as the one before took long."""
    seconds = {1: 0.11, 2: 0.31, 3: 0.05}
    decoder = Numbered(lambda n: seconds.get(n, 0.2))
    record = point_episode(RealClock(lambda decode: decode.seconds, SPEC.actions), decoder)
    delays = [d.delay for d in record.decodes[:4] if d.delay is not None]
    assert [d.steps for d in delays] == [2, 4, 1, 2]
    assert [d.seconds for d in delays] == [0.11, 0.31, 0.05, 0.2]
    assert [(d.observed, d.carried, d.held) for d in delays] == [(0, 0, 2), (4, 2, 2), (8, 1, 0), (12, 1, 1)]
    assert len(decoder.path) == record.steps + 1  # held actions are part of the history


def test_an_episode_can_end_while_the_policy_decodes():
    record = point_episode(constant(6), horizon=9)
    assert record.steps == 9
    assert record.decodes[-1].delay == Delay(0.6, 6, 6, carried=3, held=0)
    assert record.decode_steps[-1] == 9
    row = episode_row(record)
    assert (row["delay_decodes"], row["delay_steps"], row["carried_steps"], row["held_steps"]) == (2, 12, 3, 6)
    assert row["delay_seconds"] == pytest.approx(1.2)
    assert [(r["observed"], r["delay_steps"], r["held"]) for r in decodes_table(record).to_pylist()] == [
        (0, 6, 6),
        (6, 6, 0),
    ]
    waiting = point_episode(None)
    waited, sums = decodes_table(waiting).to_pylist()[0], episode_row(waiting)
    assert waited["delay_steps"] is waited["observed"] is waited["delay_seconds"] is None
    assert {sums[f"{name}_steps"] for name in ("delay", "carried", "held", "dropped")} == {0}
    assert (sums["delay_decodes"], sums["delay_seconds"]) == (0, 0.0)


@pytest.mark.parametrize("compensation", ["none", "chunk"])
def test_what_is_planned_at_a_decode_is_the_rest_of_the_chunk_in_hand(compensation):
    """Its first step runs the chunk before, so a step of the new chunk is still to come when the next decode begins."""
    seen: list[list[int]] = []

    class Planning(Numbered):
        def decode(self, observation: Observation) -> DecodeRecord:
            seen.append([round(2000 * float(action[1])) for action in self.planned])
            record = super().decode(observation)
            self.planned = list(record.actions)
            return record

    point_episode(constant(1, compensation), Planning(), horizon=12)
    assert seen[1:] == [[3]] * len(seen[1:])


def test_rounding_up_ignores_float_noise_and_refuses_nonsense():
    assert [steps_during(s, 80.0) for s in (0.0, 0.0001, 0.0125, 0.0126, 5 * 0.0125, 0.2)] == [0, 1, 1, 2, 5, 16]
    for wrong in (-0.001, float("nan"), float("inf")):
        with pytest.raises(KervError):
            steps_during(wrong, 80.0)


def test_chunk_drops_what_is_stale():
    record = point_episode(constant(2, "chunk"))
    assert played(record)[:8] == [(0, 0), (0, 0), (1, 2), (1, 3), (2, 2), (2, 3), (3, 2), (3, 3)]
    assert {d.delay.dropped for d in record.decodes if d.delay} == {2}
    slow = point_episode(RealClock(lambda decode: decode.seconds, SPEC.actions, "chunk"), Numbered(lambda n: 0.6))
    assert played(slow)[6:12] == [(1, 3)] * 6  # the last action of a chunk is always left
    assert slow.decodes[0].delay == Delay(0.6, 6, 0, carried=0, held=6, dropped=3)


def test_before_its_first_action_a_robot_stands_still():
    assert METAWORLD.standstill(1.0).tolist() == [0.0, 0.0, 0.0, -1.0]
    assert METAWORLD.standstill(0.0).tolist() == [0.0, 0.0, 0.0, 1.0]
    assert INSERTION.standstill(0.0).tolist() == [0.0] * 7  # a held peg stays held
    assert INSERTION.standstill(1.0).tolist() == [0.0] * 6 + [1.0]


# --- sources of latency

PROFILE = Profile(
    31,
    {
        "encode": ((1,), (0.005,)),
        "prefill": ((31, 46), (0.008, 0.0095)),
        "verify": ((1, 16), (0.002, 0.005)),
        "draft": ((2, 6), (0.001, 0.005)),
        "feed": ((1, 31), (0.0005, 0.002)),
    },
)


def decode_of(rounds: Sequence[Round], propose: float = 0.0) -> DecodeRecord:
    phases = {"propose": propose, "accept": 0.0005, "other": 0.0005, "verify": 9.0}
    return DecodeRecord((0,) * 16, np.zeros((4, 4), np.float32), len(rounds), tuple(rounds), "ar", 9.5, phases, size=16)


AR = decode_of([Round("decode" if i else "prefill", "none", i, (), (i,), 0, 1, 0, ()) for i in range(16)])


def test_only_executed_actions_count_as_unverified():
    """Of chunks of four steps: one whole and skipped, one late by a step and compensated, one that the end cut."""
    zeros = np.zeros((4, 4), np.float32)
    skip = decode_of([Round("skip", "early", 0, (0,) * 16, (), 16, 16, 0, ())])
    skipped = dataclasses.replace(skip, skipped=True)
    late = dataclasses.replace(AR, compensated=6, filled=(2, 3, 4, 5, 14, 15), delay=Delay(0.01, 1, 4, dropped=1))
    record = EpisodeRecord("metaworld", METAWORLD.actions, "t", "go", 0, True, 9, (skipped, late, skipped), (0, 5, 7),
                           np.zeros((9, 4), np.float32), np.zeros((10, 3), np.float32), zeros[0], zeros[0])  # fmt: skip
    assert record.executed == [(0, 4), (1, 3), (0, 2)]
    row = episode_row(record)
    assert (row["executed_tokens"], row["unverified_tokens"]) == (32, 16 + 2 + 8)


def test_a_profile_prices_the_records_forwards():
    """All on another device but acceptance and the like, whose seconds are the record's own."""
    assert profiled(PROFILE)(AR) == pytest.approx(0.005 + 0.008 + 15 * 0.002 + 0.001)
    skipped = decode_of([Round("skip", "early", 0, (0,) * 16, (), 16, 16, 0, ())], propose=0.002)
    assert profiled(PROFILE)(skipped) == pytest.approx(0.005 + 0.002 + 0.001)
    one = decode_of([Round("verify", "merged", 0, (0,) * 15, (0,) * 16, 15, 16, 15, (9,))], propose=0.003)
    assert profiled(PROFILE)(one) == pytest.approx(0.005 + 0.0095 + 0.003 + 0.001)
    drafted = decode_of(
        [
            Round("prefill", "none", 0, (), (0,), 0, 1, 0, ()),
            Round("verify", "drafter", 1, (0,) * 14, (0,) * 15, 14, 15, 14, (9,)),
        ],
        propose=5.0,  # the drafter's, which the profile has its own times for
    )
    wanted = 0.005 + 0.008 + 0.002 + (0.002 + 14 * 0.0002) + 13 * 0.001 + 0.001
    assert profiled(PROFILE)(drafted) == pytest.approx(wanted)


def profile_file(folder: Path, **phases: tuple[list[Any], list[Any]]) -> None:
    """phases: rows and seconds that replace the ones in `PROFILE`."""
    document = {"profile": PROFILE.as_dict()}
    document["profile"]["phases"] |= {name: {"rows": costs[0], "seconds": costs[1]} for name, costs in phases.items()}
    path = folder / "bench" / "there.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(document))


@pytest.fixture
def results(policies, tmp_path):
    """The policies, in a folder to which a bench can be added."""
    (tmp_path / "artifacts").symlink_to(policies / "artifacts")
    return tmp_path


def test_the_world_feels_the_seconds_of_the_profile(results):
    profile_file(results)
    words = ("rollout.clock=real", "rollout.latency=profile", "rollout.profile=there")
    ar = episode_of(results, "method=ar", *words)
    host = [sum(d.phases[name] for name in ("propose", "accept", "rectify", "other")) for d in ar.decodes]
    felt = [d.delay.seconds for d in ar.decodes if d.delay is not None]
    assert felt == pytest.approx([0.043 + h for h in host])  # the profile's AR takes 43 ms
    assert steps_during(felt[0], 80.0) == ar.decodes[0].delay_steps


def test_a_profile_is_part_of_the_results_identity(results):
    words = [f"results={results}", "policy.target=nano-state", "rollout.clock=real", "rollout.latency=profile"]
    words.append("task=drawer-open")
    chosen = compose("rollout", [*words, "rollout.profile=there"], RolloutSettings)
    found = []
    for seconds in (0.005, 0.006):
        profile_file(results, encode=([1], [seconds]))
        found.append(policies_of.check(chosen)["profile"])
    assert found[0] != found[1]
    assert "profile" not in policies_of.check(dataclasses.replace(chosen, rollout=RolloutSettings().rollout))


# --- what is refused: one line, exit code 2

CONSTANT = "rollout.clock=real rollout.latency=constant"
FROM_PROFILE = "rollout.clock=real rollout.latency=profile rollout.profile=there"
COMPENSATED = "rollout.delay_compensation=chunk"


@pytest.mark.parametrize(
    ("words", "phases", "message"),
    [
        (f"{CONSTANT} rollout.latency_ms=nan", {}, "rollout.latency_ms=nan: from 0"),
        (f"{CONSTANT} rollout.latency_ms=6250", {}, "500 control steps, but an episode has 500"),
        (f"{CONSTANT} rollout.latency_ms=50 {COMPENSATED}", {}, "all 4 control steps of a chunk are stale"),
        (f"{CONSTANT} rollout.latency_ms=13 {COMPENSATED} chunk=2", {}, "all 2 control steps"),
        ("rollout.clock=real rollout.latency=profile", {}, "name a document of 'kerv bench"),
        (FROM_PROFILE.replace("there", "nowhere"), {}, "rollout.profile=nowhere: no such document"),
        (f"{FROM_PROFILE} method=spec_vla", {"draft": ([], [])}, "has no phase 'draft', which this method needs"),
        (f"{CONSTANT} rollout.latency_ms=20 policy=expert {COMPENSATED}", {}, "all 1 control steps"),
        (f"{FROM_PROFILE} policy=expert", {}, "it has no forwards"),
        (FROM_PROFILE, {"encode": ([1], [-0.1])}, "impossible times of the phase 'encode'"),
        (FROM_PROFILE, {"verify": ([1], [float("nan")])}, "impossible times of the phase 'verify'"),
        (FROM_PROFILE, {"verify": ([2, 1], [1, 1])}, "impossible times of the phase 'verify'"),
        (FROM_PROFILE, {"prefill": ([1, 2], [1])}, "impossible times of the phase 'prefill'"),
        (FROM_PROFILE, {"prefill": ([], [])}, "has no phase 'prefill'"),
        (FROM_PROFILE, {"prefill": ([1], ["x"])}, "holds no latency profile"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(results, words, phases, message):
    profile_file(results, **phases)
    target = [] if "expert" in words else ["policy.target=nano-state"]
    assert message in refusal("rollout", "task=drawer-open", f"results={results}", *target, *words.split(), code=2)
