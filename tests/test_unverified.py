"""What is executed unverified, what lies inside the clock, and K against the chunk's length."""

import time
from typing import Any

import numpy as np
import pytest
import torch
from examples.own_target import SEVEN, MockTarget
from test_decoding_lossless import plain_greedy, random_prompt, random_target
from test_proposers import stored

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.methods.heisd import SimilaritySkipSettings
from kerv_cli.methods.heisd.rules import RetrievalProposer, VerifySkip
from kerv_cli.methods.kerv.prediction import Hold, PredictionProposer
from kerv_cli.methods.merged import MergedProposer
from kerv_cli.methods.streak import AlwaysSkip
from kerv_cli.worlds.metaworld.spec import SPEC

PAUSE = 0.03
SHOWN = Observation(np.array([0.3]), np.zeros(0), "go there")
HOME = np.array([0.1, 0.6, 0.2])


class Near(ChainProposer):
    """Drafts the target's own tokens, each off by `bins`."""

    name = "near"

    def __init__(self, target: Any, prompt: torch.Tensor, bins: int = 0, pause: float = 0.0) -> None:
        truth = np.array(plain_greedy(target, prompt))
        self.drafted = np.where(truth + bins < target.actions.tokens, truth + bins, truth - bins).tolist()
        self.pause, self.calls = pause, 0

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        self.calls += 1
        time.sleep(self.pause)
        return [self.drafted[len(chunk.tokens) :][:depth]]


# --- the clock


def test_a_proposer_that_sleeps_is_in_the_clock_in_its_phase():
    target = MockTarget()
    slow = Near(target, target.encode(SHOWN), bins=1, pause=PAUSE)
    decoder = Decoder(target, Parts(proposer=slow))
    record = decoder.decode(SHOWN)
    assert slow.calls > 5
    assert record.phases["propose"] >= PAUSE * slow.calls
    assert record.seconds >= PAUSE * slow.calls
    assert record.seconds == pytest.approx(sum(record.phases.values()))
    assert record.seconds - record.phases["propose"] < PAUSE * slow.calls / 2


def test_an_in_prefill_draft_that_sleeps_is_not_the_prefills_time():
    target = MockTarget()
    slow = Near(target, target.encode(SHOWN), pause=PAUSE)
    decoder = Decoder(target, Parts(prefill_draft=slow))
    records = [decoder.decode(SHOWN) for _ in range(3)]
    assert (slow.calls, [r.forwards for r in records]) == (3, [1, 1, 1])
    assert min(r.phases["propose"] for r in records) >= PAUSE
    assert min(r.phases["prefill"] for r in records) < PAUSE  # a busy machine does not stop it three times
    record = Decoder(target, Parts(prefill_draft=slow, skip=AlwaysSkip(slow))).decode(SHOWN)
    assert record.forwards == 0
    assert record.seconds >= record.phases["propose"] >= PAUSE


def test_a_merged_draft_goes_unverified_as_its_first_chain():
    target = MockTarget()
    prompt = target.encode(SHOWN)
    first, second = Near(target, prompt, bins=1), Near(target, prompt)
    merged = MergedProposer([first, second], 40)
    record = Decoder(target, Parts(prefill_draft=merged, skip=AlwaysSkip(merged))).decode(SHOWN)
    assert (record.forwards, list(record.tokens)) == (0, first.drafted)


@pytest.mark.parametrize(("slow", "phase"), [("encode", "vision"), ("forward", "prefill")])
def test_a_target_that_sleeps_is_in_the_clock_in_its_phase(slow, phase):
    class Slow(MockTarget):
        def __getattribute__(self, name):
            if name == slow:
                time.sleep(PAUSE)
            return super().__getattribute__(name)

    decoder = Decoder(Slow(), Parts())
    records = [decoder.decode(SHOWN) for _ in range(3)]
    decodes = records[0].forwards - 1 if slow == "forward" else 0
    for record in records:
        assert record.phases[phase] >= PAUSE
        assert record.phases["verify"] >= PAUSE * decodes
        assert record.seconds >= PAUSE * (1 + decodes)
    # a busy machine does not stop the same phase three times
    others = set(records[0].phases) - {phase, "verify"}
    assert all(min(r.phases[name] for r in records) < PAUSE for name in others)


# --- skip=always


@pytest.mark.bits
def test_always_skip_executes_the_sources_tokens_without_a_forward():
    target = MockTarget()
    source = Near(target, target.encode(SHOWN), bins=5)
    decoder = Decoder(target, Parts(prefill_draft=source, skip=AlwaysSkip(source)))
    for _ in range(4):  # there is no cap
        record = decoder.decode(SHOWN)
        assert record.tokens == tuple(source.drafted) != tuple(plain_greedy(target, target.encode(SHOWN)))
        assert (record.forwards, record.skipped, record.mode) == (0, True, "skip")
        assert [(r.mode, r.proposer) for r in record.rounds] == [("skip", "near")]
        assert record.unverified == record.actions.size == len(record.tokens)


def test_always_skip_without_a_history_lets_the_target_decode():
    target = MockTarget()
    hold = PredictionProposer(Hold(SEVEN.is_strict, minimum=1, horizon=2))
    decoder = Decoder(target, Parts(prefill_draft=hold, skip=AlwaysSkip(hold)))
    decoder.reset("t", 0, HOME)
    first = decoder.decode(SHOWN)
    assert first.tokens == tuple(plain_greedy(target, target.encode(SHOWN)))
    assert (first.forwards, first.skipped, first.unverified) == (len(first.tokens), False, 0)
    decoder.observe(first.actions[0], HOME)
    second = decoder.decode(SHOWN)
    assert second.tokens == 2 * first.tokens[:7]
    assert (second.forwards, second.skipped, second.unverified) == (0, True, 14)


# --- skip levels through a sweep


def swept(blocks: list[list[int]]) -> dict[int, list[tuple[int, ...]]]:
    """Seed -> its decodes' tokens and forwards; every block has a decoder of its own, odd seeds fail."""
    target = random_target(2, 1, 1, 4)
    prompt = random_prompt(target, 2)
    store = stored(target, prompt, np.arange(64).reshape(4, 16))
    prompts = {seed: prompt + 0.4 * random_prompt(target, 100 + seed) for block in blocks for seed in block}
    every = [
        float(store.query(store.key_of(store.pooled(x, target).numpy()), "t", 1).similarity[0])
        for x in prompts.values()
    ]
    level = float(np.median(every))
    records = {}
    for block in blocks:
        retrieval = RetrievalProposer(store, target, 1, 16)
        levels = (level - 0.2, level, level + 0.2)
        skip = VerifySkip(SimilaritySkipSettings(max_skips=2), retrieval, levels)
        decoder = Decoder(target, Parts(proposer=retrieval, skip=skip))
        for seed in block:
            decoder.reset("t", seed, HOME)
            chunks = [decoder.decode_prompt(prompts[seed]) for _ in range(4)]
            records[seed] = [(c.forwards, *c.tokens) for c in chunks]
            decoder.finish(success=seed % 2 == 0)
    return records


ORDERS = [[[0, 1, 2, 3, 4, 5]], [[5, 3, 1, 4, 2, 0]], [[0, 1], [2, 3], [4, 5]], [[4], [0], [5], [2], [1], [3]]]


def test_frozen_skip_levels_know_no_order_and_no_block():
    found = [swept(blocks) for blocks in ORDERS]
    assert found[0] == found[1] == found[2] == found[3]
    forwards = [tokens[0] for record in found[0].values() for tokens in record]
    assert 0 in forwards  # some were skipped,
    assert all(record[2][0] > 0 for record in found[0].values())  # never three in a row,
    assert any(record[0][0] > 0 for record in found[0].values())  # and some episodes lie below s_min


# --- the path


def test_the_boundarys_path_begins_where_the_episode_does():
    seen: list[np.ndarray] = []

    class Watching:
        def numbers(self, task, seed):
            return np.random.default_rng(seed)

        def choose(self, path, random):
            seen.append(path.copy())

    decoder = Decoder(MockTarget(SPEC.actions, 1), Parts(boundary=Watching()))  # type: ignore[arg-type]
    for start in (HOME, 2 * HOME):
        decoder.reset("t", 0, start)
        decoder.decode(SHOWN)
        decoder.observe(np.zeros(4), start + 0.01)
        decoder.decode(SHOWN)
    assert [path.tolist() for path in seen] == [
        [HOME.tolist()],
        [HOME.tolist(), (HOME + 0.01).tolist()],
        [(2 * HOME).tolist()],
        [(2 * HOME).tolist(), (2 * HOME + 0.01).tolist()],
    ]
