"""What is executed unverified: always, by similarity or by agreement; and what lies inside the clock."""

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from mock_target import SEVEN, MockTarget
from test_decoding_lossless import plain_greedy, random_prompt, random_target
from test_proposers import retrieval_of, stored

from kerv_cli.base.config import compose
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.decisions import Choice
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.parts import Boundary
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.context import Context
from kerv_cli.methods.heisd import SimilaritySkipSettings, VerifySkip
from kerv_cli.methods.kerv.prediction import Hold, PredictionProposer
from kerv_cli.methods.merged import MergedProposer
from kerv_cli.methods.unverified import AlwaysSkip, StreakSkip, StreakSkipSettings
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


# --- HeiSD's public code: two of three


def test_two_retrieved_chunks_of_three_are_skipped_and_the_drafters_none():
    """Decision by decision against the rule, for random choices of the boundary and any similarity."""
    asked = compose("rollout", ["method=heisd_code"], RolloutSettings).skip
    random = np.random.default_rng(0)
    modes, similarities = random.choice(["retrieval", "drafter"], 200, p=[0.75, 0.25]), random.uniform(-1, 1, 200)
    found: list[bool] = []

    class Stored:
        name = "retrieval"

        def neighbours(self, chunk):
            left, chunks = np.array([99]), np.zeros((1, 4), int)
            return SimpleNamespace(similarity=similarities[[len(found)]], seeds=np.array([0]), left=left, chunks=chunks)

    skip = VerifySkip(asked, Stored(), (asked.s_min,) * 3)  # type: ignore[arg-type]
    skip.begin("reach-v3", 0)
    for mode in modes:
        chunk = SimpleNamespace(choice=Choice(mode), steps=1)
        found.append(skip.take(chunk).tokens is not None)  # type: ignore[arg-type]
    expected, row = [], 0
    for mode in modes:
        row = row + 1 if mode == "retrieval" and row < 2 else 0
        expected.append(row > 0)
    assert found == expected
    assert 0.4 < np.mean(found) < 0.6  # about half of the decodes


# --- the clock


class Slow(MockTarget):
    """Sleeps before one of its methods."""

    slow = ""

    def __getattribute__(self, name: str) -> Any:
        if name == super().__getattribute__("slow"):
            time.sleep(PAUSE)
        return super().__getattribute__(name)


DRAFTING = ("proposer", "prefill_draft", "skip")


@pytest.mark.parametrize(
    ("slow", "phase"), [*((slow, "propose") for slow in DRAFTING), ("encode", "vision"), ("forward", "prefill")]
)
def test_what_sleeps_is_in_the_clock_in_its_phase(slow, phase):
    target = Slow()
    near = Near(target, target.encode(SHOWN), bins=slow == "proposer", pause=PAUSE)
    parts = {"proposer": Parts(proposer=near), "prefill_draft": Parts(prefill_draft=near)}
    parts["skip"] = Parts(prefill_draft=near, skip=AlwaysSkip(near))
    decoder = Decoder(target, parts.get(slow, Parts()))
    target.slow = slow
    records = [decoder.decode(SHOWN) for _ in range(3)]
    calls = near.calls // 3 if slow in DRAFTING else 1
    assert calls > 5 if slow == "proposer" else calls == 1
    for record in records:
        assert record.phases[phase] >= PAUSE * calls
        assert slow != "forward" or record.phases["verify"] >= PAUSE * (record.forwards - 1)
        assert record.seconds == pytest.approx(sum(record.phases.values()))
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
        assert record.unverified_among(0, len(record.actions)) == record.actions.size == len(record.tokens)


def test_always_skip_without_a_history_lets_the_target_decode():
    target = MockTarget()
    hold = PredictionProposer(Hold(SEVEN.is_strict, minimum=1, horizon=2))
    decoder = Decoder(target, Parts(prefill_draft=hold, skip=AlwaysSkip(hold)))
    decoder.reset("t", 0, HOME)
    first = decoder.decode(SHOWN)
    assert first.tokens == tuple(plain_greedy(target, target.encode(SHOWN)))
    assert (first.forwards, first.skipped, first.unverified_among(0, 2)) == (len(first.tokens), False, 0)
    decoder.observe(first.actions[0], HOME)
    second = decoder.decode(SHOWN)
    assert second.tokens == 2 * first.tokens[:7]
    assert (second.forwards, second.skipped, second.unverified_among(0, 2)) == (0, True, 14)


# --- skip levels through a sweep


def swept(blocks: list[list[int]]) -> dict[int, list[tuple[int, ...]]]:
    """Seed -> its decodes' tokens and forwards; every block has a decoder of its own, odd seeds fail."""
    target = random_target(2, 1, 1, 4)
    prompt = random_prompt(target, 2)
    store = stored(target, prompt, np.arange(64).reshape(4, 16))
    prompts = {seed: prompt + 0.4 * random_prompt(target, 100 + seed) for block in blocks for seed in block}
    every = [float(store.query(store.key_of(x, target), "t", 1).similarity[0]) for x in prompts.values()]
    level = float(np.median(every))
    records = {}
    for block in blocks:
        retrieval = retrieval_of(store, target, 1, 16)
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

    class Watching(Boundary):
        def choose(self, path):
            seen.append(path.copy())

    decoder = Decoder(MockTarget(SPEC.actions, 1), Parts(boundary=Watching()))
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


# --- streak


def decoder_of(source: Any, target: MockTarget, draft: Any = None, **settings: Any) -> Decoder:
    built = {"prefill_draft": draft or source}
    skip = StreakSkip(StreakSkipSettings(**settings), Context(target, None, built=built))  # type: ignore[arg-type]
    made = Decoder(target, Parts(prefill_draft=draft or source, skip=skip))
    made.reset("t", 0, np.zeros(3))
    return made


def modes(decoder: Decoder, decodes: int) -> str:
    """s: skipped, v: verified, by decode."""
    return "".join("s" if decoder.decode(SHOWN).skipped else "v" for _ in range(decodes))


def near(target: MockTarget, bins: int = 0) -> Near:
    return Near(target, target.encode(SHOWN), bins)


@torch.inference_mode()
def test_agreement_doubles_what_is_allowed_up_to_the_most():
    target = MockTarget()
    assert (
        modes(decoder_of(near(target), target, most=4), 17)
        == "v" + "s" + "v" + "ss" + "v" + "ssss" + "v" + "ssss" + "vs"
    )


@torch.inference_mode()
def test_a_disagreement_ends_the_streak_and_counting_begins_anew():
    target = MockTarget()
    source = near(target)
    decoder = decoder_of(source, target, tolerance=0.0)
    good, bad = source.drafted, near(target, bins=1).drafted
    assert modes(decoder, 5) == "vsvss"
    source.drafted = bad
    assert modes(decoder, 3) == "vvv"
    source.drafted = good
    assert modes(decoder, 5) == "vsvss"


class ByPlace(MockTarget):
    """A target whose tokens depend on their places alone, so that what it says behind a rejected token is known."""

    def __init__(self) -> None:
        super().__init__()
        self.answers = torch.randn(64, self.actions.tokens, generator=torch.Generator().manual_seed(3)).double()

    def forward(self, x: torch.Tensor, positions: torch.Tensor, cache: Any = None, seen: Any = None) -> torch.Tensor:
        hidden = super().forward(x, positions, cache, seen)
        hidden[..., 0] = positions
        return hidden

    def head(self, hidden: torch.Tensor) -> torch.Tensor:
        return self.answers[hidden[..., 0].long()]


@torch.inference_mode()
@pytest.mark.parametrize(("bins", "agrees"), [(2, True), (12, False)])
def test_a_rejected_draft_near_enough_on_its_own_path_agrees(bins, agrees):
    """A draft that is off by `bins` everywhere but in the strict DoF: 2 bins are 0.013 on average, 12 are 0.08."""
    target = ByPlace()
    truth = np.array(near(target).drafted)
    source = near(target, bins)
    source.drafted = np.where(target.actions.strict_tokens(len(truth)), truth, source.drafted).tolist()
    assert modes(decoder_of(source, target, tolerance=0.05), 2) == ("vs" if agrees else "vv")
    assert modes(decoder_of(source, target, tolerance=0.0), 2) == "vv"


@pytest.mark.parametrize("which", [0, -1])
@torch.inference_mode()
def test_a_flipped_strict_dof_never_agrees(which):
    """The last one is the chunk's last token, which no draft contains."""
    target = MockTarget()
    source = near(target)
    strict = np.flatnonzero(target.actions.strict_tokens(len(source.drafted)))
    source.drafted[int(strict[which])] = (source.drafted[int(strict[which])] + 1) % target.actions.tokens
    assert modes(decoder_of(source, target, tolerance=2.0), 2) == "vv"


@torch.inference_mode()
def test_another_sources_accepted_chain_does_not_count():
    """The fallback's draft is right, the first source's is not: what would be executed unverified is the first's."""
    target = MockTarget()
    wrong, right = near(target, bins=30), near(target)
    merged = MergedProposer([wrong, right], nodes=64)
    decoder = decoder_of(wrong, target, merged, tolerance=0.0)
    record = decoder.decode(SHOWN)
    assert record.forwards == 1  # the right one was accepted whole
    assert modes(decoder, 2) == "vv"


@torch.inference_mode()
def test_the_first_source_is_compared_on_its_own_path_where_another_path_wins():
    """Both are rejected at their first token. The other one is nearer, so its path is recorded."""
    target = ByPlace()
    truth = np.array(near(target).drafted)
    strict = target.actions.strict_tokens(len(truth))
    first, other = near(target, 2), near(target, 1)
    for source in (first, other):
        source.drafted = np.where(strict, truth, source.drafted).tolist()
    assert modes(decoder_of(first, target, MergedProposer([first, other], nodes=64)), 2) == "vs"
    first.drafted = np.where(strict, truth, near(target, 12).drafted).tolist()
    assert modes(decoder_of(first, target, MergedProposer([first, other], nodes=64)), 2) == "vv"
