"""The property that guards the engine: strict speculative decoding yields AR's tokens, token for token, in float32."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kerv_cli.decoding.chunk import Chunk
from kerv_cli.decoding.decoder import Decoder, Parts
from kerv_cli.decoding.proposers import DrafterProposer, JacobiProposer
from kerv_cli.drafting.eagle import Drafter
from kerv_cli.drafting.tree import ROOT, TokenTree
from kerv_cli.settings import (
    AcceptanceSettings,
    DrafterSettings,
    MethodSettings,
    OpeningSettings,
    ProposerSettings,
    TargetSettings,
    ThresholdSettings,
)
from kerv_cli.spaces import VOCABULARY, ActionTokenizer
from kerv_cli.targets.compact.layout import lay_out_for_inference
from kerv_cli.targets.compact.target import Target
from kerv_cli.targets.compact.text import WordTokenizer

STRICT = AcceptanceSettings(kind="strict")


def random_target(seed: int, layers: int, heads: int, chunk: int) -> Target:
    """Odd seeds run on the plans that a shipped policy runs on, even ones on the modules' own path."""
    torch.manual_seed(seed)
    settings = TargetSettings(
        observation="state", width=16 * heads, layers=layers, heads=heads, feed_forward=48, chunk=chunk, scene_tokens=2
    )
    target = Target(settings, ActionTokenizer(-np.ones(4), np.ones(4)), WordTokenizer.build(["open the drawer"]))
    for parameter in target.trunk.parameters():  # far from initialisation, so that target_tokens depend on the context
        if parameter.dim() == 2:
            torch.nn.init.normal_(parameter, std=0.25)
    torch.nn.init.normal_(target.embedding.weight, std=1.0)
    target = target.eval().requires_grad_(False)
    if seed % 2:
        lay_out_for_inference(target)
    return target


def random_prompt(target: Target, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(1, target.prompt_length, target.settings.width, generator=generator)


def plain_greedy(target: Target, prompt: torch.Tensor) -> list[int]:
    """An independent reference: no cache, no tree, the whole sequence forwarded anew for every token."""
    x, tokens = prompt, []
    for _ in range(target.tokens_per_chunk):
        hidden = target.trunk(x, torch.arange(x.shape[1]))
        tokens.append(int(target.head(hidden[0, -1]).argmax()))
        x = torch.cat([x, target.embedding(torch.tensor([[tokens[-1]]]))], 1)
    return tokens


class RandomTrees:
    """Proposes random trees, seeded, with the true continuation hidden in some of them so that drafts are accepted."""

    name = "random"
    needs_states = False

    def __init__(self, truth: list[int], seed: int, nodes: int) -> None:
        self.truth, self.nodes = truth, nodes
        self.random = np.random.default_rng(seed)

    def begin(self, chunk: Chunk) -> None:
        pass

    def committed(self, chunk: Chunk, first: int, hidden: torch.Tensor, target_tokens: list[int]) -> None:
        assert hidden.shape[1] == len(chunk.tokens) - first - 1

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        ahead = self.truth[len(chunk.tokens) :]
        tokens: list[int] = []
        parents: list[int] = []
        depths: list[int] = []
        for _ in range(int(self.random.integers(0, self.nodes + 1))):
            candidates = [ROOT, *(i for i, d in enumerate(depths) if d + 1 < depth)]
            parent = int(self.random.choice(candidates))
            level = 0 if parent == ROOT else depths[parent] + 1
            right = self.random.random() < 0.6
            tokens.append(ahead[level] if right else int(self.random.integers(VOCABULARY)))
            parents.append(parent)
            depths.append(level)
        return TokenTree.build(tokens, parents)


def decode(target: Target, proposer: object, prompt: torch.Tensor, nodes: int) -> Chunk:
    method = MethodSettings("test", ProposerSettings(nodes=nodes), STRICT, ThresholdSettings(r=0))
    return Decoder(target, method, Parts(proposer=proposer)).decode_prompt(prompt)  # type: ignore[arg-type]


def assert_adds_up(chunk: Chunk) -> None:
    """The record of every decode adds up: forwards, committed tokens, starts."""
    assert chunk.forwards == len(chunk.rounds)
    assert sum(r.committed for r in chunk.rounds) == chunk.size == len(chunk.tokens)
    start = 0
    for r in chunk.rounds:
        assert r.start == start
        assert r.accepted <= len(r.drafted) <= r.accepted + 1
        start += r.committed


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    layers=st.integers(1, 3),
    heads=st.integers(1, 3),
    chunk=st.sampled_from([1, 2, 4, 8]),
    nodes=st.integers(0, 24),
)
def test_strict_decoding_of_random_trees_equals_ar(seed: int, layers: int, heads: int, chunk: int, nodes: int) -> None:
    target = random_target(seed, layers, heads, chunk)
    prompt = random_prompt(target, seed)
    truth = plain_greedy(target, prompt)
    result = decode(target, RandomTrees(truth, seed, nodes), prompt, nodes)
    assert result.tokens == truth
    assert_adds_up(result)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    chunk=st.sampled_from([1, 4]),
    depth=st.integers(1, 6),
    top_k=st.integers(1, 5),
    nodes=st.integers(1, 20),
    layers=st.integers(1, 2),
)
def test_strict_decoding_with_a_drafter_equals_ar(
    seed: int, chunk: int, depth: int, top_k: int, nodes: int, layers: int
) -> None:
    target = random_target(seed, 2, 2, chunk)
    drafter = Drafter.beside(DrafterSettings(layers=layers), target).eval().requires_grad_(False)
    proposer = DrafterProposer(drafter, target, ProposerSettings("drafter", depth, top_k, nodes))
    prompt = random_prompt(target, seed)
    result = decode(target, proposer, prompt, nodes)
    assert result.tokens == plain_greedy(target, prompt)
    assert_adds_up(result)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), chunk=st.sampled_from([1, 4, 8]))
def test_the_fixed_point_of_jacobi_decoding_is_ar(seed: int, chunk: int) -> None:
    target = random_target(seed, 2, 2, chunk)
    prompt = random_prompt(target, seed)
    result = decode(target, JacobiProposer(), prompt, 0)
    assert result.tokens == plain_greedy(target, prompt)
    assert result.forwards <= target.tokens_per_chunk
    assert_adds_up(result)


@pytest.mark.parametrize("chunk", [1, 4, 8])
def test_ar_takes_exactly_n_forwards(chunk: int) -> None:
    target = random_target(3, 2, 2, chunk)
    prompt = random_prompt(target, 5)
    result = Decoder(target, MethodSettings()).decode_prompt(prompt)
    assert result.tokens == plain_greedy(target, prompt)
    assert result.forwards == target.tokens_per_chunk
    assert {r.mode for r in result.rounds} == {"prefill", "decode"} if chunk else True


def test_a_perfect_draft_commits_depth_plus_bonus_and_never_overshoots() -> None:
    target = random_target(11, 2, 2, 4)
    prompt = random_prompt(target, 11)
    truth = plain_greedy(target, prompt)

    class Perfect(RandomTrees):
        def propose(self, chunk: Chunk, depth: int) -> TokenTree:
            return TokenTree.chain(self.truth[len(chunk.tokens) :][: min(5, depth)])

    result = decode(target, Perfect(truth, 0, 5), prompt, 5)
    assert result.tokens == truth
    assert [r.committed for r in result.rounds] == [1, 6, 6, 3]


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    heads=st.integers(1, 3),
    chunk=st.sampled_from([1, 4, 8]),
    nodes=st.integers(0, 30),
    drafting=st.booleans(),
)
def test_drafts_verified_inside_the_prefill_are_lossless(
    seed: int, heads: int, chunk: int, nodes: int, drafting: bool
) -> None:
    """METHODS §5: an opening of random trees, then plain decoding or the drafter, still yields AR's tokens."""
    target = random_target(seed, 2, heads, chunk)
    prompt = random_prompt(target, seed)
    truth = plain_greedy(target, prompt)
    proposer = None
    if drafting:
        drafter = Drafter.beside(DrafterSettings(), target).eval().requires_grad_(False)
        proposer = DrafterProposer(drafter, target, ProposerSettings("drafter", 4, 2, 6))
    method = MethodSettings(
        "test", ProposerSettings(nodes=6), STRICT, ThresholdSettings(), opening=OpeningSettings(["random"], nodes)
    )
    parts = Parts(opening=RandomTrees(truth, seed, nodes), proposer=proposer)
    result = Decoder(target, method, parts).decode_prompt(prompt)
    assert result.tokens == truth
    assert_adds_up(result)


def test_a_perfect_opening_takes_one_forward() -> None:
    target = random_target(5, 2, 2, 4)
    prompt = random_prompt(target, 5)
    truth = plain_greedy(target, prompt)

    class Whole(RandomTrees):
        def propose(self, chunk: Chunk, depth: int) -> TokenTree:
            return TokenTree.chain(self.truth[:depth])

    method = MethodSettings("test", acceptance=STRICT, opening=OpeningSettings(["whole"], 16))
    result = Decoder(target, method, Parts(opening=Whole(truth, 0, 16))).decode_prompt(prompt)
    assert result.tokens == truth
    assert result.forwards == 1
    assert [r.committed for r in result.rounds] == [16]
