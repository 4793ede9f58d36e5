"""Every proposer, in-prefill draft and boundary is lossless under strict acceptance; HeiSD's choice and skip."""

from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from loaded import datastore_of
from test_decoding_lossless import assert_adds_up, plain_greedy, random_prompt, random_target

from kerv_cli.base.registry import NoSettings
from kerv_cli.engine.chunk import Chunk, Follower
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.proposer import Proposer
from kerv_cli.methods.context import Context
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.drafter import EagleDrafter
from kerv_cli.methods.eagle.network import DrafterProposer
from kerv_cli.methods.early.network import EarlyProposer
from kerv_cli.methods.heisd import (
    Always,
    HybridProposer,
    RetrievalProposer,
    RetrievalProposerSettings,
    SimilaritySkipSettings,
    VerifySkip,
)
from kerv_cli.methods.heisd.datastore import Datastore, prompt_key
from kerv_cli.methods.kerv.prediction import Hold, Kalman, Noise, PredictionProposer
from kerv_cli.methods.merged import MergedProposer
from kerv_cli.methods.reuse import JacobiProposer, JacobiProposerSettings
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.worlds.metaworld.spec import SPEC

SPACE = SPEC.actions
D = SPACE.dofs
SIDES = "always_drafter", "always_retrieval"
HELD = SPACE.is_strict


class KnownDraft:
    """Stands for the early drafter: the truth with some tokens wrong."""

    def __init__(self, truth: list[int], random: np.random.Generator) -> None:
        self.odds = random.random()
        self.tokens = [t if random.random() < 0.8 else (t + 7) % 255 for t in truth]

    def draft(self, features: torch.Tensor, radius: int) -> torch.Tensor:
        return torch.tensor([[*self.tokens, self.odds]], dtype=torch.float64)


def retrieval_of(store: Datastore, target: CompactTarget, neighbours: int, nodes: int) -> RetrievalProposer:
    """The proposer that drafts from this datastore."""
    settings = RetrievalProposerSettings(neighbours=neighbours, nodes=nodes)
    return RetrievalProposer(settings, Context(target, lambda kind: store))


def stored(target: CompactTarget, prompt: torch.Tensor, chunks: np.ndarray, left: int = 50) -> Datastore:
    """A datastore whose entries lie around this prompt's key; entry i is of episode i."""
    random = np.random.default_rng(0)
    key = prompt_key(prompt, target, ["scene"])[0].numpy()
    vectors = key + 0.05 * random.standard_normal((len(chunks), len(key)))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return datastore_of(vectors, chunks, {"t": slice(0, len(chunks))}, left=left)


F = TypeVar("F", bound=Follower)


def moved(follower: F, random: np.random.Generator, executed: int) -> F:
    """The follower after some random actions of an episode."""
    follower.reset("t", 0, np.zeros(3))
    for _ in range(executed):
        action = follower.space.unnormalise(random.uniform(-1, 1, D))
        follower.observe(action, follower.path[-1] + 0.01 * random.standard_normal(3))
    return follower


def proposers(target: CompactTarget, prompt: torch.Tensor, truth: list[int], seed: int) -> dict[str, Any]:
    random = np.random.default_rng(seed)
    horizon = target.chunk
    wrong = np.array([truth] * 4)
    wrong[random.random(wrong.shape) < 0.2] = random.integers(255)
    retrieval = retrieval_of(stored(target, prompt, wrong), target, 3, 40)
    drafter = EagleDrafter().network(DrafterSettings(), target).eval().requires_grad_(False)
    drafting = DrafterProposer(drafter, target, depth=4, top_k=2, nodes=6)
    hold = PredictionProposer(Hold(HELD, minimum=1, horizon=horizon))
    early = EarlyProposer(KnownDraft(truth, random), target)  # type: ignore[arg-type]
    return {
        "hold": hold,
        "kalman": PredictionProposer(Kalman(HELD, Noise(*2 * [(1.0,) * D]), horizon=horizon)),
        "early": early,
        "retrieval": retrieval,
        "merged": MergedProposer([early, retrieval], int(random.integers(1, 80)), [hold]),
        "hybrid": HybridProposer(drafting, retrieval),
    }


@pytest.mark.bits
@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), chunk=st.sampled_from([1, 4, 8]), data=st.data())
@pytest.mark.parametrize("name", ["hold", "kalman", "early", "retrieval", "merged", "hybrid"])
def test_every_proposer_is_lossless(name, seed, chunk, data):
    """After the prefill, or inside it with and without drafts that follow."""
    target = random_target(seed, 2, 2, chunk)
    prompt = random_prompt(target, seed)
    truth = plain_greedy(target, prompt)
    known = proposers(target, prompt, truth, seed)
    where = "after" if name == "hybrid" else data.draw(st.sampled_from(["after", "inside", "both"]), "where")
    before = None if where == "after" else known[name]
    after = {"after": known[name], "inside": None, "both": known["hybrid"]}[where]
    boundary = Always(NoSettings(data.draw(st.sampled_from(SIDES)))) if after is known["hybrid"] else None
    steps = data.draw(st.integers(0, chunk), "steps decoded, 0: all")
    decoder = Decoder(target, Parts(prefill_draft=before, proposer=after, boundary=boundary), chunk=steps)
    moved(decoder, np.random.default_rng(seed), data.draw(st.integers(0, 12), "executed"))
    for _ in range(2):  # the second decode finds the parts as the first left them
        result = decoder.decode_prompt(prompt)
        assert result.tokens == truth[: (steps or chunk) * D]
        assert_adds_up(result)
        assert all(len(r.drafted) <= 4 for r in result.rounds if r.proposer == "drafter")  # its depth


def test_a_prediction_counts_committed_steps_as_executed():
    chunk = Chunk(4, SPACE, moved(Follower(SPACE), np.random.default_rng(0), 5), None)  # type: ignore[arg-type]
    chunk.tokens = [10, 20, 30, 254, 40]
    proposer = PredictionProposer(Hold(HELD, minimum=1, horizon=4))
    assert proposer.chains(chunk, 7) == [[20, 30, 254, 10, 20, 30, 254]]
    chunk.tokens = []
    last = SPACE.bins_of(chunk.episode.history()[-1]).tolist()
    assert proposer.chains(chunk, 15) == [(last * 4)[:15]]


def test_merging_drops_what_is_named_last_and_cuts_the_last_branch():
    class Fixed:
        def __init__(self, name, chains):
            self.name, self.found, self.sure = name, chains, False

        def is_sure(self, chunk):
            return self.sure

        def chains(self, chunk, depth):
            return [c[:depth] for c in self.found]

    one, two = Fixed("one", [[1, 2, 3], [1, 5, 6]]), Fixed("two", [[9, 9, 9]])
    chunk: Any = None
    assert MergedProposer([one, two], 8).propose(chunk, 3).tree.tokens == (1, 2, 3, 5, 6, 9, 9, 9)
    assert MergedProposer([one, two], 7).propose(chunk, 3).tree.tokens == (1, 2, 3, 5, 6)
    assert MergedProposer([two, one], 2).propose(chunk, 3).tree.tokens == (9, 9)
    assert (MergedProposer([one, two], 8).name, MergedProposer([two], 8).name) == ("one+two", "two")
    careful = MergedProposer([two], 8, fallback=[one])
    assert careful.name == "two+one"
    early = Fixed("early", [])
    assert (MergedProposer([early, two], 8).name, MergedProposer([early], 8).name) == ("merged", "early")
    assert careful.propose(chunk, 3).tree.tokens == (9, 9, 9, 1, 2, 3, 5, 6)
    two.sure = True
    assert careful.propose(chunk, 3).tree.tokens == (9, 9, 9)


def test_jacobis_guesses_stay_at_their_places_where_a_rectifier_filled_some():
    proposer = JacobiProposer(JacobiProposerSettings(depth=2))
    proposer.guess = list(range(1, 10))  # of the places 1 … 9, each the number of its place
    chunk: Any = SimpleNamespace(tokens=[0] * 6)  # two guesses were judged, a rectifier filled up to place 5
    proposer.committed(chunk, 0, torch.empty(0), [101, 102, 103])
    assert proposer.guess == [6, 7, 8, 9]
    proposer.guess, chunk.tokens = list(range(1, 10)), [0] * 2  # the first guess was rejected
    proposer.committed(chunk, 0, torch.empty(0), [101, 102, 103])
    assert proposer.guess == [102, 103, *range(4, 10)]


# --- HeiSD: choice and skip


def skipping(left: int = 50, **changes: Any) -> tuple[Decoder, torch.Tensor, list[int]]:
    target = random_target(2, 1, 1, 4)
    prompt = random_prompt(target, 2)
    tokens = list(range(16))
    store = stored(target, prompt, np.array([tokens]), left)
    retrieval = retrieval_of(store, target, 1, 16)
    skip = VerifySkip(SimilaritySkipSettings(**changes), retrieval, (0.4, 0.5, 0.9))
    decoder = Decoder(target, Parts(proposer=retrieval, skip=skip))
    return moved(decoder, np.random.default_rng(0), 3), prompt, tokens


def test_a_similar_enough_chunk_is_executed_without_a_forward():
    decoder, prompt, tokens = skipping(max_skips=2)
    truth = plain_greedy(decoder.target, prompt)
    assert truth != tokens
    chunks = [decoder.decode_prompt(prompt) for _ in range(4)]
    assert [c.forwards > 0 for c in chunks] == [False, False, True, False]  # at most two in a row
    assert [c.tokens for c in chunks] == [tokens, tokens, truth, tokens]
    assert [r.mode for r in chunks[0].rounds] == ["skip"]
    assert {r.mode for r in chunks[2].rounds[1:]} <= {"verify", "decode"}
    assert chunks[2].rounds[0].mode == "prefill"
    assert_adds_up(chunks[2])


def test_a_stored_episode_is_not_executed_beyond_its_end_or_below_s_min():
    decoder, prompt, _ = skipping(left=4, max_skips=9)
    assert [decoder.decode_prompt(prompt).forwards > 0 for _ in range(3)] == [False, True, True]
    decoder.reset("t", 0, np.zeros(3))  # a new episode may use it again
    assert decoder.decode_prompt(prompt).forwards == 0
    decoder.reset("t", 0, np.zeros(3))
    decoder.parts.skip.s_min = 1.01  # type: ignore[union-attr]
    assert decoder.decode_prompt(prompt).forwards > 0


def test_s_min_rises_after_a_failure_and_falls_after_a_success_within_bounds():
    decoder, _, _ = skipping(up=0.5, down=0.1)
    skip = decoder.parts.skip
    decoder.finish(False)
    assert skip.s_min == pytest.approx(0.75)
    decoder.finish(False)
    assert skip.s_min == pytest.approx(0.9)
    for _ in range(30):
        decoder.finish(True)
    assert skip.s_min == pytest.approx(0.4)


def test_nothing_is_skipped_on_the_drafters_side():
    decoder, prompt, _ = skipping()
    retrieval = decoder.parts.proposer
    drafter = EagleDrafter().network(DrafterSettings(), decoder.target).eval().requires_grad_(False)
    drafting = DrafterProposer(drafter, decoder.target, depth=4, top_k=1, nodes=4)
    for side, forwards in zip(SIDES, (True, False), strict=True):
        boundary = Always(NoSettings(side))
        parts = Parts(proposer=HybridProposer(drafting, retrieval), boundary=boundary, skip=decoder.parts.skip)  # type: ignore[arg-type]
        hybrid = Decoder(decoder.target, parts)
        moved(hybrid, np.random.default_rng(0), 3)
        assert (hybrid.decode_prompt(prompt).forwards > 0) == forwards


@pytest.mark.bits
@pytest.mark.parametrize("before", [True, False])
def test_the_cache_has_room_for_the_largest_tree_a_proposer_names(before):
    """A proposer that drafts more nodes than a chunk has tokens."""
    target = random_target(1, 1, 1, 1)
    prompt = random_prompt(target, 1)
    truth = plain_greedy(target, prompt)

    class Wide(Proposer):
        name, nodes = "wide", 200

        def propose(self, chunk, depth):
            right = truth[len(chunk.tokens)]
            return Draft.of([*[(right + 1) % 255] * 199, right], [-1] * 200)

    parts = Parts(prefill_draft=Wide()) if before else Parts(proposer=Wide())
    result = Decoder(target, parts).decode_prompt(prompt)
    assert result.tokens == truth
    assert max(r.tree_size for r in result.rounds) == 200
