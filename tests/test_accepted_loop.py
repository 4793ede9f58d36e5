"""Relaxed, sequence and hybrid acceptance through the decode loop, against a loop that forwards every prefix anew.

The oracle knows no cache, no mask and no tree forward: it walks down the drafted trees, asks the target for one token
at a time, and decides by the definitions of docs/methods.md §2.1.
"""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mock_target import SEVEN, MockTarget
from test_acceptance import space_of
from test_decoding_lossless import assert_adds_up, random_prompt, random_target

from kerv_cli.base.spaces import ActionSpace, Observation
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.decisions import ROOT, TokenTree
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.parts import Fixed
from kerv_cli.engine.proposer import Proposer
from kerv_cli.engine.protocol import Target
from kerv_cli.methods.heisd import GroupRule, HybridRule
from kerv_cli.methods.spec_vla import RelaxedRule
from kerv_cli.worlds.metaworld.spec import SPEC

GROUP_LIMIT, TOKEN_LIMIT = 12, 7


class Greedy:
    """The target's token behind a prefix: one forward of all of it, remembered."""

    def __init__(self, target: Target, prompt: torch.Tensor) -> None:
        self.target, self.prompt = target, prompt
        self.known: dict[tuple[int, ...], int] = {}

    def behind(self, prefix: tuple[int, ...]) -> int:
        if prefix not in self.known:
            embedded = [self.target.embed(torch.tensor([[token]])) for token in prefix]
            x = torch.cat([self.prompt, *embedded], 1)
            hidden = self.target.forward(x, torch.arange(x.shape[1]))
            self.known[prefix] = int(self.target.head(hidden[0, -1]).argmax())
        return self.known[prefix]


class NearTrees(Proposer):
    """Seeded trees whose tokens lie near the target's, so that limits decide; the same ones for the same prefix.

    `retrieval` is the name that the hybrid rule judges by `sequence`; every other one is judged by `relaxed`.
    """

    def __init__(self, greedy: Greedy, name: str, seed: int, nodes: int, spread: int, switching: bool = False) -> None:
        self.greedy, self.own, self.seed, self.nodes, self.spread = greedy, name, seed, nodes, spread
        self.switching, self.turn = switching, 0

    @property
    def name(self) -> str:
        """A hybrid proposer changes its name with its side."""
        return "retrieval" if self.switching and self.turn % 2 else self.own

    def tree(self, prefix: tuple[int, ...], depth: int) -> TokenTree:
        random = np.random.default_rng([self.seed, len(prefix), *prefix])
        tokens: list[int] = []
        parents: list[int] = []
        paths: list[tuple[int, ...]] = []
        for _ in range(int(random.integers(0, self.nodes + 1))):
            open_ends = [i for i, path in enumerate(paths) if len(path) < depth]
            parent = int(random.choice([ROOT, *open_ends[-3:]]))
            behind = () if parent == ROOT else paths[parent]
            near = self.greedy.behind(prefix + behind) + int(random.integers(-self.spread, self.spread + 1))
            tokens.append(int(np.clip(near, 0, self.greedy.target.actions.tokens - 1)))
            parents.append(parent)
            paths.append((*behind, tokens[-1]))
        return TokenTree.build(tokens, parents)

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        self.turn += 1
        tree = self.tree(tuple(chunk.tokens), depth)
        return Draft.of(tree.tokens, tree.parents)


@dataclass
class Oracle:
    """Decodes by the definition; `judged` holds each verified round's path and the token rejected after it."""

    greedy: Greedy
    space: ActionSpace
    kind: str
    r: int
    strict_dofs: bool
    tokens: tuple[int, ...] = ()
    judged: list[tuple[int, ...]] = field(default_factory=list)

    def allowed(self, path: tuple[int, ...], by_group: bool) -> bool:
        """Whether a drafted path behind the committed tokens may be executed whole."""
        start, dofs = len(self.tokens), self.space.dofs
        total, bounds = 0, self.space.bounds
        for i, token in enumerate(path):
            dof = (start + i) % dofs
            bias = abs(token - self.greedy.behind(self.tokens + path[:i]))
            limit = TOKEN_LIMIT if by_group else self.r
            if self.space.is_strict[dof] and (by_group or self.strict_dofs):
                limit = 0
            total = bias if dof == bounds[dof][0] else total + bias
            if bias > limit or (by_group and total > GROUP_LIMIT):
                return False
        # a path judged by groups ends with a group
        return not by_group or not path or (start + len(path)) % dofs in (0, *(first for first, _ in bounds))

    def distance(self, path: tuple[int, ...]) -> int:
        return sum(abs(t - self.greedy.behind(self.tokens + path[:i])) for i, t in enumerate(path))

    def verify(self, tree: TokenTree, name: str, size: int) -> None:
        """Commit the longest allowed path, of those the nearest, of those the first; then the token behind it."""
        by_group = self.kind == "sequence" or (self.kind == "hybrid" and name == "retrieval")
        paths = {node: tuple(tree.tokens[i] for i in tree.path_to(node)) for node in range(len(tree))}
        good = [node for node, path in paths.items() if self.allowed(path, by_group)]
        node = min(good, key=lambda n: (-len(paths[n]), self.distance(paths[n])), default=ROOT)
        best = paths.get(node, ())
        children = [tree.tokens[i] for i, parent in enumerate(tree.parents) if parent == node]
        wanted = self.greedy.behind(self.tokens + best)
        nearest = sorted(children, key=lambda token: abs(token - wanted))[:1]
        if len(tree):
            self.judged.append((*best, *nearest))
        self.tokens += best
        if len(self.tokens) < size:
            self.tokens = (*self.tokens, self.greedy.behind(self.tokens))


def assert_same(
    target: Target, prompt: torch.Tensor, kind: str, r: int, strict_dofs: bool, seed: int, inside: bool, nodes: int
) -> int:
    """Both loops over the same trees; -> how many tokens a strict rule would not have accepted."""
    greedy, space = Greedy(target, prompt), target.actions
    size = target.chunk * space.dofs

    def made(name, offset):
        return NearTrees(greedy, name, seed + offset, nodes, spread=4, switching=kind == "hybrid" and not offset)

    before, after = (made("retrieval" if seed % 2 else "early", 1) if inside else None), made("drafter", 0)
    relaxed, sequence = RelaxedRule(space, strict_dofs), GroupRule(space, GROUP_LIMIT, TOKEN_LIMIT)
    rules = {"relaxed": relaxed, "sequence": sequence, "hybrid": HybridRule(space, strict_dofs, retrieved=sequence)}
    acceptance = rules.get(kind)  # none: strict
    parts = Parts(acceptance, Fixed(r), prefill_draft=before, proposer=after)
    result = Decoder(target, parts).decode_prompt(prompt)

    oracle = Oracle(greedy, space, kind, r, strict_dofs)
    again = made("drafter", 0)
    first = before.tree((), size - 1) if before is not None and size > 1 else TokenTree.build([], [])
    oracle.verify(first, before.name if before is not None else "none", size)
    while len(oracle.tokens) < size:
        left = size - len(oracle.tokens)
        again.turn += left > 1
        tree = again.tree(oracle.tokens, left - 1) if left > 1 else TokenTree.build([], [])
        oracle.verify(tree, again.name, size)
    assert tuple(result.tokens) == oracle.tokens
    judged = [r for r in result.rounds if r.tree_size]
    assert [r.drafted for r in judged] == oracle.judged
    assert_adds_up(result)
    return sum(d != t for r in judged for d, t in zip(r.drafted[: r.accepted], r.target_tokens, strict=False))


@pytest.mark.bits
@settings(max_examples=30)
@given(
    space=st.sampled_from([SEVEN, SPEC.actions, space_of(1, 2), space_of(5), None]),
    seed=st.integers(0, 10_000),
    chunk=st.integers(1, 3),
    r=st.integers(0, 5),
    strict_dofs=st.booleans(),
    inside=st.booleans(),
    nodes=st.integers(0, 20),
)
@pytest.mark.parametrize("kind", ["relaxed", "sequence", "hybrid"])
def test_the_loop_accepts_by_definition(kind, space, seed, chunk, r, strict_dofs, inside, nodes):
    """On mocks of several spaces, and on a transformer."""
    if space is None:
        target = random_target(seed, 2, 2, chunk)
        prompt = random_prompt(target, seed)
    else:
        target = MockTarget(space, chunk, seed=seed)
        prompt = target.encode(Observation(np.array([0.1 * seed]), np.zeros(0), "go there"))
    assert_same(target, prompt, kind, r, strict_dofs, seed, inside, nodes)


@pytest.mark.parametrize("kind", ["relaxed", "sequence", "hybrid"])
def test_the_trees_hold_tokens_that_only_a_limit_accepts(kind):
    """Otherwise the comparison would prove no more than that of strict decoding."""
    total = 0
    for seed in range(8):
        target = MockTarget(SEVEN, 2, seed=seed)
        prompt = target.encode(Observation(np.array([0.1 * seed]), np.zeros(0), "go there"))
        total += assert_same(target, prompt, kind, 4, True, seed, bool(seed % 2), 20)
    assert total > 10
