"""method=watch (docs/methods.md §6.2): where a look at the world abandons a chunk, and what it costs."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from examples.own_target import MockTarget
from examples.point_mass import SPEC, PointWorld
from test_decoding_lossless import plain_greedy
from test_unverified import HOME, SHOWN

from kerv_cli.base.config import compose
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.settings import EVALUATION_SEED, RolloutSettings, ServeSettings
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.lab import policy as policies_of
from kerv_cli.lab.episode import run_episode
from kerv_cli.lab.rows import DECODE_SCHEMA, decode_rows
from kerv_cli.methods.agreement import FARTHEST, Watch, WatchSettings, check_source
from kerv_cli.serve.policy import Policy
from kerv_cli.worlds.metaworld.spec import SPEC as METAWORLD

SPACE = SPEC.actions
PAUSE = 0.01


class Closed(ChainProposer):
    """Drafts what the target itself would decode from what it sees, and remembers the first action of every draft."""

    name = "closed"

    def __init__(self, target: MockTarget, pause: float = 0.0) -> None:
        self.target, self.pause = target, pause
        self.drafted: list[list[int]] = []

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """The target's greedy chunk."""
        time.sleep(self.pause)
        self.drafted.append(plain_greedy(self.target, chunk.prompt)[:depth])
        return [self.drafted[-1]]


class Fixed(ChainProposer):
    """Drafts the same tokens always."""

    name = "fixed"

    def __init__(self, tokens: list[int]) -> None:
        self.tokens = tokens

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        """These."""
        return [self.tokens[:depth]] if self.tokens else []


def episode(watch: Watch | None, horizon: int = 30) -> EpisodeRecord:
    with PointWorld(SPEC, "push-point", horizon=horizon) as world:
        return run_episode(world, Decoder(MockTarget(SPACE, 4), Parts(skip=watch)), EVALUATION_SEED + 1)


def watching(tolerance: float, every: int = 1, pause: float = 0.0) -> tuple[EpisodeRecord, list[list[int]]]:
    """An episode, and what the source would have done at every look."""
    source = Closed(MockTarget(SPACE, 4), pause)
    return episode(Watch(source, every, tolerance)), source.drafted


@pytest.mark.bits
def test_a_watch_that_forgives_everything_is_autoregressive_decoding() -> None:
    plain, (watched, looks) = episode(None), watching(FARTHEST)
    assert (watched.actions == plain.actions).all()
    assert (watched.path == plain.path).all()
    assert [d.tokens for d in watched.decodes] == [d.tokens for d in plain.decodes]
    assert (watched.decode_steps, watched.forwards) == (plain.decode_steps, plain.forwards)
    assert [d.looks for d in watched.decodes] == [3] * 7 + [1]  # 30 steps: the last chunk is executed for two
    assert len(looks) == 22
    assert not any(d.abandoned for d in watched.decodes)
    assert {d.looks for d in plain.decodes} == {0}


@pytest.mark.parametrize("every", [1, 2, 3])
@pytest.mark.parametrize("tolerance", [0.4, 0.7])
def test_a_plan_is_abandoned_exactly_where_the_source_disagrees(tolerance: float, every: int) -> None:
    record, looks = watching(tolerance, every)
    stops = [*record.decode_steps[1:], record.steps]
    seen = iter(looks)
    outcomes = []
    for decode, start, stop in zip(record.decodes, record.decode_steps, stops, strict=True):
        planned = SPACE.values_of(np.array(decode.tokens)).reshape(4, 2)
        kept, executed = True, 0
        for step in range(4):
            if start + step == record.steps:
                break  # the horizon
            if step and step % every == 0:
                kept = bool(np.abs(SPACE.values_of(np.array(next(seen))) - planned[step]).mean() <= tolerance)
                outcomes.append(kept)
            if not kept:
                break
            executed += 1
        assert (stop - start, decode.abandoned) == (executed, 0 if kept else 4 - executed)
    assert next(seen, None) is None
    assert set(outcomes) == {True, False}
    assert sum(d.looks for d in record.decodes) == len(looks) == len(outcomes)


def test_the_target_decodes_at_once_from_what_the_look_saw() -> None:
    record, _ = watching(0.0)
    assert record.decode_steps == tuple(range(30))  # never the same action twice: each step is planned anew
    assert [d.abandoned for d in record.decodes] == [3] * 29 + [0]
    assert record.forwards == 30 * 8
    assert len(record.actions) == 30


def test_a_look_is_inference_time_of_its_decode() -> None:
    record, looks = watching(FARTHEST, pause=PAUSE)
    assert record.seconds >= PAUSE * len(looks)
    for decode in record.decodes:
        assert decode.phases["propose"] >= PAUSE * decode.looks
        assert decode.seconds == pytest.approx(sum(decode.phases.values()))
    rows = decode_rows(record)
    assert [(row["looks"], row["abandoned"]) for row in rows] == [(3, 0)] * 7 + [(1, 0)]
    assert len(pa.Table.from_pylist(rows, schema=DECODE_SCHEMA)) == len(rows)


@pytest.mark.parametrize(("dof", "bins", "keeps"), [(0, 40, True), (0, 60, False), (3, 1, False)])
def test_strict_dofs_must_agree_and_the_others_on_average(dof: int, bins: int, keeps: bool) -> None:
    """40 bins of one DoF of four are 0.078 on average, 60 are 0.118."""
    target = MockTarget(METAWORLD.actions, 4)
    source = Fixed([])
    decoder = Decoder(target, Parts(skip=Watch(source, 1, 0.1)))
    decoder.reset("t", 0, HOME)
    planned = np.array(decoder.decode(SHOWN).tokens).reshape(4, 4)
    assert decoder.look(SHOWN, 2).keeps  # a source without a draft says nothing
    source.tokens = planned[2].tolist()
    assert decoder.look(SHOWN, 2).keeps
    source.tokens[dof] += bins if source.tokens[dof] < 127 else -bins
    assert decoder.look(SHOWN, 2).keeps == keeps


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("rollout.batch=4", r"rollout\.batch=4 with method=watch"),
        ("rollout.clock=real", r"skip=watch with rollout\.clock=real: a look has no latency there"),
    ],
)
def test_where_nobody_can_look_it_is_refused(policies: Path, words: str, says: str) -> None:
    with pytest.raises(UsageError, match=says) as refused:
        policies_of.check(chosen(policies, *words.split()))
    assert "\n" not in str(refused.value)


def chosen(results: Path, *words: str) -> RolloutSettings:
    common = ["method=watch", "policy.target=nano-state", "task=reach", f"results={results}"]
    return compose("rollout", [*common, *words], RolloutSettings)


def test_a_server_refuses_it(policies: Path) -> None:
    words = ["method=watch", "policy.target=nano-state", f"results={policies}"]
    with pytest.raises(UsageError, match="skip=watch with kerv serve: a client executes chunks"):
        Policy(compose("serve", words, ServeSettings))


def test_without_what_looks_the_message_is_that_of_its_source(policies: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no early drafter in .*: run 'kerv prepare policy.target=nano-state'"):
        policies_of.check(chosen(policies))
    policies_of.check(chosen(policies, "skip.source=hold"))
    with pytest.raises(UsageError, match=r"skip\.source=drafter: it does not draft whole chunks"):
        check_source(WatchSettings(source="drafter"))


def test_sampled_decodes_are_watched_too(policies: Path) -> None:
    words = ["skip.source=hold", "skip.tolerance=0", "deviation_every=1", "world.horizon=8", "record=0"]
    decoder: Any = policies_of.decoder_for(chosen(policies, *words), "reach-v3")
    assert decoder.watcher is decoder.decoder


def test_looks_are_warmed_up_with_the_decodes(policies: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[int] = []
    look = Decoder.look
    monkeypatch.setattr(Decoder, "look", lambda self, seen, step: (steps.append(step), look(self, seen, step))[1])
    policies_of.decoder_for(chosen(policies, "skip.source=hold", "skip.every=2"), "reach-v3")
    assert steps == policies_of.WARM_UP_DECODES * [2]
