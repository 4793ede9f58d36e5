"""Real episodes on real Meta-World: closed loop, pairing, what is timed and what is drawn."""

from pathlib import Path

import pytest

from kerv_cli.base.config import compose
from kerv_cli.engine.record import PHASES, EpisodeRecord
from kerv_cli.episodes import runner as run
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.worlds.metaworld.spec import SPEC
from kerv_cli.worlds.metaworld.world import MetaWorld
from kerv_cli.worlds.settings import EVALUATION_SEED


def settings(results: Path, *overrides: str) -> RolloutSettings:
    common = ["world.horizon=10", "record=0", f"results={results}"]
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
    assert (record.environment, record.space) == ("metaworld", SPEC.actions)
    first = SPEC.open_world("drawer-open-v3")
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
