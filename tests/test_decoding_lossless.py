"""The property that guards the engine: strict speculative decoding yields AR's tokens, token for token, in float32."""

import dataclasses
import functools
import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mock_target import SEVEN, MockTarget
from test_acceptance import space_of

from kerv_cli.base.codes import FastCode
from kerv_cli.base.config import compose
from kerv_cli.base.errors import KervError
from kerv_cli.base.spaces import ActionSpace, Observation
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.decisions import ROOT
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.proposer import Proposer
from kerv_cli.engine.protocol import Target
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods import near
from kerv_cli.methods.compose import Method
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.drafter import EagleDrafter
from kerv_cli.methods.eagle.network import DrafterProposer
from kerv_cli.methods.reuse import JacobiProposer, JacobiProposerSettings, LastActionProposer
from kerv_cli.targets.compact.features import WordTokenizer
from kerv_cli.targets.compact.program import compile_parts
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.settings import TargetSettings
from kerv_cli.worlds.metaworld.spec import SPEC

pytestmark = pytest.mark.bits

ACTIONS, OBSERVATION = SPEC.actions, SPEC.observation


def short_code(chunk: int, dofs: int = ACTIONS.dofs) -> FastCode:
    """A code of few tokens, so that a random target ends most chunks early."""
    return FastCode(chunk, dofs, 0.5, ((0, 1), (1, 1), (1, 2)))


def random_target(
    seed: int, layers: int, heads: int, chunk: int, fixed: bool = False, actions: ActionSpace = ACTIONS
) -> CompactTarget:
    """Odd seeds run on the compiled weights that a shipped policy runs on, even ones on the modules' own path. fixed:
    with caches of fixed shapes, as on CUDA."""
    torch.manual_seed(seed)
    settings = TargetSettings(
        observation="state", width=16 * heads, layers=layers, heads=heads, feed_forward=48, chunk=chunk, scene_tokens=2
    )
    target = CompactTarget(settings, actions, OBSERVATION, WordTokenizer.build(["open the drawer"]))
    for parameter in target.trunk.parameters():  # far from initialisation, so that target_tokens depend on the context
        if parameter.dim() == 2:
            torch.nn.init.normal_(parameter, std=0.25)
    torch.nn.init.normal_(target.embedding.weight, std=1.0)
    target = target.eval().requires_grad_(False)
    if seed % 2:
        compile_parts(target)
    if fixed:
        target.new_cache = functools.partial(target.new_cache, fixed=True)  # type: ignore[method-assign]
    return target


def random_prompt(target: CompactTarget, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(1, target.max_prompt, target.width, generator=generator)


def size_of(target: Target) -> int:
    """N."""
    return target.actions.longest(target.chunk)


def plain_greedy(target: Target, prompt: torch.Tensor) -> list[int]:
    """An independent reference: no cache, no tree, the whole sequence forwarded anew for every token."""
    x, tokens = prompt, []
    for _ in range(size_of(target)):
        hidden = target.forward(x, torch.arange(x.shape[1]))
        tokens.append(int(target.head(hidden[0, -1]).argmax()))
        if tokens[-1] == target.actions.end:
            break
        x = torch.cat([x, target.embed(torch.tensor([[tokens[-1]]]))], 1)
    return tokens


class RandomTrees(Proposer):
    """Proposes random trees, seeded, with the true continuation hidden in some of them so that drafts are accepted."""

    name = "random"

    def __init__(self, truth: list[int], seed: int, nodes: int, vocabulary: int = ACTIONS.tokens) -> None:
        self.truth, self.nodes, self.vocabulary = truth, nodes, vocabulary
        self.random = np.random.default_rng(seed)

    def committed(self, chunk: Chunk, first: int, hidden: torch.Tensor, target_tokens: list[int]) -> None:
        assert hidden.shape[1] == len(chunk.tokens) - first - 1

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        ahead = self.truth[len(chunk.tokens) :]
        tokens: list[int] = []
        parents: list[int] = []
        depths: list[int] = []
        for _ in range(int(self.random.integers(0, self.nodes + 1))):
            candidates = [ROOT, *(i for i, d in enumerate(depths) if d + 1 < depth)]
            parent = int(self.random.choice(candidates))
            level = 0 if parent == ROOT else depths[parent] + 1
            right = self.random.random() < 0.6 and level < len(ahead)
            tokens.append(ahead[level] if right else int(self.random.integers(self.vocabulary)))
            parents.append(parent)
            depths.append(level)
        return Draft.of(tokens, parents)


def decode(target: Target, proposer: object, prompt: torch.Tensor) -> Chunk:
    return Decoder(target, Parts(proposer=proposer)).decode_prompt(prompt)  # type: ignore[arg-type]


def assert_adds_up(chunk: Chunk) -> None:
    """The record of every decode adds up: forwards, committed tokens, starts."""
    assert chunk.forwards == len(chunk.rounds)
    assert sum(r.committed for r in chunk.rounds) == len(chunk.tokens)
    assert chunk.ended or len(chunk.tokens) == chunk.size
    start = 0
    for r in chunk.rounds:
        assert r.start == start
        assert r.accepted <= len(r.drafted) <= r.accepted + 1
        start += r.committed


@settings(max_examples=30)
@given(
    seed=st.integers(0, 10_000),
    layers=st.integers(1, 3),
    heads=st.integers(1, 3),
    chunk=st.sampled_from([1, 2, 4, 8]),
    nodes=st.integers(0, 30),
    inside=st.booleans(),
    fixed=st.booleans(),
    coded=st.sampled_from([False, False, True]),
    data=st.data(),
)
@pytest.mark.parametrize("name", ["none", "trees", "drafter", "jacobi"])
def test_strict_decoding_equals_ar(name, seed, layers, heads, chunk, nodes, inside, fixed, coded, data):
    """docs/methods.md §5: with and without random trees in the prefill, and with every kind of draft after it. With a
    code, chunks end early, and drafts go on after the end token."""
    actions = dataclasses.replace(ACTIONS, code=short_code(chunk)) if coded else ACTIONS
    target = random_target(seed, layers, heads, chunk, fixed, actions)
    prompt = random_prompt(target, seed)
    truth = plain_greedy(target, prompt)
    trees = RandomTrees(truth, seed, nodes, actions.tokens)
    made = {"none": None, "trees": trees, "jacobi": JacobiProposer(JacobiProposerSettings())}
    if name == "drafter":
        drawn = st.fixed_dictionaries({"layers": st.integers(1, 2), "final_norm": st.booleans()})
        settings = DrafterSettings(**data.draw(drawn, "the drafter"))
        drafter = EagleDrafter().network(settings, target).eval().requires_grad_(False)
        if fixed:
            drafter.new_cache = functools.partial(drafter.new_cache, fixed=True)  # type: ignore[method-assign]
        depth, top_k, size = data.draw(st.tuples(st.integers(1, 6), st.integers(1, 5), st.integers(1, 20)), "tree")
        made["drafter"] = DrafterProposer(drafter, target, depth, top_k, size)
    first = RandomTrees(truth, seed + 1, nodes, actions.tokens) if inside else None
    parts = Parts(prefill_draft=first, proposer=made[name])
    result = Decoder(target, parts).decode_prompt(prompt)
    assert result.tokens == truth
    assert_adds_up(result)
    assert result.forwards <= size_of(target)
    if name == "none" and not inside:
        assert result.forwards == len(truth)


@pytest.mark.parametrize(("where", "most", "committed"), [("proposer", 5, [1, 6, 6, 3]), ("prefill_draft", 16, [16])])
def test_a_perfect_draft_commits_depth_plus_bonus_and_never_overshoots(where, most, committed):
    target = random_target(11, 2, 2, 4)
    prompt = random_prompt(target, 11)
    truth = plain_greedy(target, prompt)

    class Perfect(RandomTrees):
        def propose(self, chunk, depth):
            return Draft.of(self.truth[len(chunk.tokens) :][: min(most, depth)])

    result = Decoder(target, Parts(**{where: Perfect(truth, 0, 16)})).decode_prompt(prompt)  # type: ignore[arg-type]
    assert result.tokens == truth
    assert [r.committed for r in result.rounds] == committed
    assert result.forwards == len(committed)


HOST_TREE = Draft.of([0, 1, 2, 3, 4], [-1, 0, 1, 2, 0])
DEVICE = torch.device("meta")  # any device but the CPU


@pytest.mark.parametrize(
    ("draft", "says"),
    [
        (Draft.of([0, -1]), "drafted token -1"),
        (Draft.of([0, ACTIONS.tokens]), f"drafted token {ACTIONS.tokens}"),
        (Draft.of(range(4)), "drafted 4 tokens on a path: at most 3"),
        (HOST_TREE, "drafted 4 tokens on a path: at most 3"),
        (Draft.of([1, 2], [1, -1]), "node 0 has parent 1: parents come before their children"),
        (Draft(torch.zeros(4, dtype=torch.long, device=DEVICE)), "drafted 4 tokens on a path: at most 3"),
        (Draft(*torch.zeros(2, 4, dtype=torch.long, device=DEVICE), levels=4), "drafted 4 tokens on a path: at most 3"),
        (Draft(*torch.zeros(2, 4, dtype=torch.long, device=DEVICE)), "without Draft.levels"),
        (Draft(torch.zeros(2, dtype=torch.long), torch.zeros(2, dtype=torch.long, device=DEVICE)), "on one device"),
        (Draft(torch.zeros(2, dtype=torch.long, device=DEVICE), torch.tensor([-1, 0])), "on one device"),
    ],
)
@pytest.mark.parametrize("where", ["proposer", "prefill_draft"])
def test_a_draft_that_cannot_be_verified_is_refused_with_its_proposers_name(where, draft, says):
    target = random_target(1, 1, 1, 1)  # four tokens

    class Wrong(Proposer):
        name = "mine"

        def propose(self, chunk, depth):
            return draft

    if where == "proposer":
        says = says.replace("at most 3", "at most 2")
    with pytest.raises(KervError, match=f"'mine' .*{says}"):
        Decoder(target, Parts(**{where: Wrong()})).decode_prompt(random_prompt(target, 1))


# on a target that is no transformer: any action space, prompts of any length


@st.composite
def spaces(draw: st.DrawFn) -> ActionSpace:
    """OpenVLA's, or one of any groups and vocabulary."""
    if draw(st.booleans()):
        return SEVEN
    sizes = draw(st.lists(st.integers(1, 3), min_size=1, max_size=4))
    return dataclasses.replace(space_of(*sizes), bins=draw(st.integers(3, 40)))


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    actions=spaces(),
    chunk=st.integers(1, 4),
    words=st.integers(0, 11),
    nodes=st.integers(0, 24),
    inside=st.booleans(),
)
def test_any_target_is_decoded_losslessly(seed, actions, chunk, words, nodes, inside):
    target = MockTarget(actions, chunk, seed=seed)
    shown = Observation(np.array([0.1 * seed]), np.zeros(0), " ".join("word" * (1 + i % 3) for i in range(words)))
    prompt = target.encode(shown)
    assert prompt.shape[1] == words + 1
    truth = plain_greedy(target, prompt)
    trees = RandomTrees(truth, seed, nodes, actions.tokens)
    first = RandomTrees(truth, seed + 1, nodes, actions.tokens) if inside else None
    result = Decoder(target, Parts(prefill_draft=first, proposer=trees)).decode_prompt(prompt)
    assert result.tokens == truth
    assert_adds_up(result)


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    actions=spaces(),
    chunk=st.integers(1, 4),
    coded=st.booleans(),
    executed=st.lists(st.integers(0, 4), min_size=2, max_size=6),
    first=st.sampled_from(["last_action", "near"]),
    after=st.sampled_from(["jacobi", "last_action", "near", "none"]),
)
def test_an_episode_of_last_action_is_decoded_losslessly(seed, actions, chunk, coded, executed, first, after):
    """Whatever was executed between two decodes: nothing, a part of the chunk, all of it, or something else."""
    coded &= "near" not in (first, after)  # FAST tokens are no bins
    space = dataclasses.replace(actions, code=short_code(chunk, actions.dofs)) if coded else actions
    target, random = MockTarget(space, chunk, seed=seed), np.random.default_rng(seed)
    drafts = ["method=last_action", f"prefill_draft={first}", f"proposer={after}", "threshold.r=0"]
    method = Method.of(compose("rollout", drafts, RolloutSettings))
    decoder, plain, drafted = method.decoder(target, lambda kind: None), Decoder(target), False
    decoder.reset("t", seed, np.zeros(3))
    for number, steps in enumerate(executed):
        shown = Observation(np.array([0.01 * (seed % 7 + number)]), np.zeros(0), "word word")
        record = decoder.decode(shown)
        assert record.tokens == plain.decode(shown).tokens
        drafted |= bool(number) and record.rounds[0].proposer == first
        for action in [*record.actions, random.uniform(-1, 1, space.dofs)][:steps]:
            decoder.observe(action, np.zeros(3))
    assert drafted or space.longest(chunk) == 1


def test_near_drafts_the_most_probable_beginnings():
    """Against every prefix of three tokens, judged one by one."""
    random = np.random.default_rng(3)
    table, weights = random.uniform(0, 1, (2, 3, 6)) ** 4, np.array([0.3, 0.7])
    table /= table.sum(2, keepdims=True) * 1.001
    tokens, parents = near.likely_tree(table, weights, 20)
    prefixes = [tokens[:0]] * len(tokens)
    for node, parent in enumerate(parents):
        prefixes[node] = [*(prefixes[parent] if parent >= 0 else []), tokens[node]]

    def probability(prefix):
        return sum(w * math.prod(table[g, place, t] for place, t in enumerate(prefix)) for g, w in enumerate(weights))

    every = [list(prefix) for size in (1, 2, 3) for prefix in itertools.product(range(6), repeat=size)]
    assert sorted(prefixes) == sorted(sorted(every, key=probability)[-20:])


def test_near_expects_a_line_to_go_on_and_widens_with_its_errors():
    line, noise = np.arange(8)[:, None] * 3, np.array([0, 4, -3, 5, 0, -4, 3, 0])[:, None]
    guesses, scales, trust = near.expected(line, 2)
    assert guesses[:, :, 0].tolist() == [[21, 21], [24, 27]]
    assert trust[1] > 0.9
    assert scales[1, 0] < 0.3 < scales[0].min()
    assert near.expected(line + noise, 1)[1][1] > 2 * scales[1, 0]
    assert near.expected(line[:1], 2)[2].tolist() == [0.5, 0.5]


def test_last_action_drafts_the_rest_of_the_last_chunk_then_its_last_action():
    target = MockTarget(SEVEN, 4, seed=1)
    decoder = Decoder(target, Parts(prefill_draft=LastActionProposer()))
    decoder.reset("t", 0, np.zeros(3))
    shown = Observation(np.array([0.3]), np.zeros(0), "word")
    chunk = decoder._new_chunk(target.encode(shown))
    propose = LastActionProposer().chains
    assert propose(chunk, 27) == []
    tokens = list(decoder.decode(shown).tokens)
    rows = np.reshape(tokens, (4, 7))
    for executed in range(6):
        expected = rows[[min(executed + step, 3) for step in range(4)]].flatten().tolist()
        chunk.tokens = []
        assert propose(chunk, 28) == [expected]
        assert propose(chunk, 5) == [expected[:5]]
        chunk.tokens = expected[:9]  # a step and two tokens are committed
        assert propose(chunk, 7) == [expected[9:16]]
        decoder.observe(SEVEN.decode(rows[min(executed, 3)]), np.zeros(3))


def test_a_chunk_ends_at_its_end_token():
    """The record's size is the largest number of tokens, and actions are complete."""
    space = dataclasses.replace(SEVEN, code=short_code(2, SEVEN.dofs))
    target, lengths = MockTarget(space, 2, seed=3), set()
    decoder = Decoder(target)
    for number in range(12):
        shown = Observation(np.array([0.1 * number]), np.zeros(0), "word " * (1 + number % 3))
        record = decoder.decode(shown)
        assert record.actions.shape == (2, 7)
        assert (record.size, len(record.tokens)) == (space.longest(2), record.forwards)
        assert space.end not in record.tokens[:-1]
        lengths.add(len(record.tokens))
    assert len(lengths) > 1
    assert min(lengths) < space.longest(2)


def test_the_mock_sees_a_wrong_mask_position_or_cache():
    """Otherwise it would prove nothing."""
    target = MockTarget()
    x, positions = torch.randn(1, 5, 8).double(), torch.arange(5)
    right = target.head(target.forward(x, positions))[0, -1]
    blind = np.tri(5, dtype=bool)
    blind[4, 1] = False
    cache = target.new_cache(1, 8)
    target.forward(x[:, :3], positions[:3], cache)
    cache.compact(1, torch.tensor([2]))
    for wrong in (
        target.forward(x, positions, seen=blind),
        target.forward(x, positions + (positions == 1)),
        target.forward(x[:, 3:], positions[3:], cache),
    ):
        assert not torch.allclose(target.head(wrong)[0, -1], right)
