"""The `sequence` rule against METHODS §2.1 read aloud, and the kinematic groups that it judges by."""

from __future__ import annotations

from itertools import groupby

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kerv_cli.decoding.acceptance import accept_by_distance, accept_by_group, acceptance_rule, limits_of
from kerv_cli.decoding.chunk import Chunk
from kerv_cli.decoding.decoder import Decoder, Parts
from kerv_cli.drafting.groups import Groups, bounds, kinematic_groups, segments
from kerv_cli.drafting.tree import ROOT, TokenTree
from kerv_cli.environments.metaworld.spec import SPEC
from kerv_cli.settings import AcceptanceSettings, MethodSettings, ProposerSettings, TargetSettings
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.compact.text import WordTokenizer

ACTIONS, OBSERVATION = SPEC.actions, SPEC.observation

POSITION_GRIPPER = kinematic_groups(4)
LIMITS = (15, 15, 15, 0)
layouts = st.sampled_from([POSITION_GRIPPER, kinematic_groups(7), ((0,), (1, 2)), ((0, 1, 2, 3, 4),)])


@st.composite
def bushes(draw: st.DrawFn, most: int = 16, vocabulary: int = 6) -> TokenTree:
    """Deep trees: a node's parent is one of the last few nodes."""
    n = draw(st.integers(0, most))
    parents = [draw(st.integers(max(ROOT, i - 3), i - 1)) for i in range(n)]
    return TokenTree.build([draw(st.integers(0, vocabulary - 1)) for _ in range(n)], parents)


def slow_acceptance(
    tree: TokenTree, target_tokens: list[int], start: int, limits: list[int], group_limit: int, groups: Groups
) -> tuple[int, int, int]:
    """(−length, distance, node) of the best path, by the definition: every root path of whole groups, judged group by
    group."""
    dofs = len(limits)
    name = [g for g, group in enumerate(groups) for _ in group]  # DoF -> its group
    best = (0, 0, ROOT)
    for node in range(len(tree)):
        path = tree.path_to(node)
        bias = [abs(tree.tokens[i] - target_tokens[tree.parents[i] + 1]) for i in path]
        where = [(start + d) // dofs * len(groups) + name[(start + d) % dofs] for d in range(len(path))]
        behind = start + len(path)
        whole = behind % dofs == 0 or name[behind % dofs] != name[(behind - 1) % dofs]
        accepted = all(
            all(bias[d] <= limits[(start + d) % dofs] for d in members) and sum(bias[d] for d in members) <= group_limit
            for members in (list(g) for _, g in groupby(range(len(path)), where.__getitem__))
        )
        if whole and accepted:
            best = min(best, (-len(path), sum(bias), node))
    return best


@settings(max_examples=400, deadline=None)
@given(bushes(), st.data(), layouts, st.integers(0, 15), st.integers(0, 6))
def test_the_sequence_rule_is_its_definition(
    tree: TokenTree, data: st.DataObject, groups: Groups, start: int, group_limit: int
) -> None:
    dofs = sum(map(len, groups))
    limits = data.draw(st.lists(st.integers(0, 4), min_size=dofs, max_size=dofs))
    target_tokens = [data.draw(st.integers(0, 5)) for _ in range(len(tree) + 1)]
    found = accept_by_group(tree, target_tokens, start, limits, group_limit=group_limit, groups=groups)
    _, _, node = slow_acceptance(tree, target_tokens, start, limits, group_limit, groups)
    assert list(found.path) == (tree.path_to(node) if node != ROOT else [])
    children = [i for i, parent in enumerate(tree.parents) if parent == node]
    assert (found.rejected is None) == (not children)
    if children:
        assert found.rejected in children


@given(bushes(), st.data(), st.integers(0, 15))
@settings(deadline=None)
def test_no_limits_on_single_dofs_is_acceptance_by_distance(tree: TokenTree, data: st.DataObject, start: int) -> None:
    """Groups of one DoF and a loose sum leave only the token limits: Spec-VLA's rule."""
    limits = data.draw(st.lists(st.integers(0, 4), min_size=4, max_size=4))
    target_tokens = [data.draw(st.integers(0, 5)) for _ in range(len(tree) + 1)]
    single = accept_by_group(tree, target_tokens, start, limits, group_limit=99, groups=((0,), (1,), (2,), (3,)))
    assert single == accept_by_distance(tree, target_tokens, start, limits)


def judge(tokens: list[int], start: int = 0, verdict: int = 100) -> int:
    """Accepted length of a chain whose target_tokens are all `verdict`."""
    tree = TokenTree.chain(tokens)
    return len(accept_by_group(tree, [verdict] * (len(tokens) + 1), start, LIMITS, group_limit=30).path)


@pytest.mark.parametrize(
    ("tokens", "start", "accepted"),
    [
        ([110, 110, 110, 100], 0, 4),  # 10 + 10 + 10 = 30
        ([110, 110, 111, 100], 0, 0),  # 31: the whole group goes, its good tokens too
        ([115, 85, 100, 100], 0, 4),  # signs do not cancel, but 15 + 15 = 30
        ([116, 100, 100, 100], 0, 0),  # one token beyond 15
        ([100, 100, 116, 100], 0, 0),
        ([110, 110, 110, 101], 0, 3),  # the gripper is exact and a group of its own
        ([100, 100, 100, 100, 110, 110, 111], 0, 4),  # the sum starts anew with every group …
        ([110, 110, 110, 100, 110, 110, 110], 0, 7),
        ([100, 100, 100, 100, 100, 100], 0, 4),  # leaves the tree inside a group
        ([100, 100], 0, 0),
        ([115, 115, 100], 1, 3),  # begun by the bonus: two tokens remain, 30
        ([115, 116, 100], 1, 0),
        ([115, 100], 2, 2),
        ([100, 110, 110, 111], 3, 1),
        ([101], 3, 0),
        ([100] * 15, 1, 15),
        ([], 0, 0),
    ],
)
def test_groups_are_accepted_or_rejected_whole(tokens: list[int], start: int, accepted: int) -> None:
    assert judge(tokens, start) == accepted


def test_a_rejected_group_is_shown_by_its_first_token() -> None:
    tree = TokenTree.build([100, 100, 100, 100, 104, 100, 90, 103], [-1, 0, 1, 2, 3, 4, 5, 3])
    verdict = accept_by_group(tree, [100] * 9, 0, LIMITS, group_limit=10)
    assert verdict.path == (0, 1, 2, 3)
    assert verdict.rejected == 7  # nearer to the verdict than node 4, which began a group that failed


def test_the_settings_become_the_rule() -> None:
    chosen = AcceptanceSettings("sequence", group_limit=20, token_limit=9)
    assert limits_of(chosen, r=3, dofs=4, gripper=3) == (9, 9, 9, 0)
    assert limits_of(chosen, r=3, dofs=7, gripper=6) == (9, 9, 9, 9, 9, 9, 0)
    rule = acceptance_rule(chosen)
    tree = TokenTree.chain([107, 107, 106, 100])
    assert rule(tree, [100] * 5, 0, (9, 9, 9, 0)).path == (0, 1, 2, 3)
    assert rule(TokenTree.chain([107, 107, 107, 100]), [100] * 5, 0, (9, 9, 9, 0)).path == ()
    assert limits_of(AcceptanceSettings("relaxed"), r=3, dofs=4, gripper=3) == (3, 3, 3, 3)
    assert limits_of(AcceptanceSettings("relaxed", strict_gripper=True), r=3, dofs=4, gripper=3) == (3, 3, 3, 0)


def test_groups_cover_the_action_in_order() -> None:
    assert bounds(kinematic_groups(4)) == [(0, 3), (0, 3), (0, 3), (3, 4)]
    assert bounds(kinematic_groups(7)) == [(0, 3)] * 3 + [(3, 6)] * 3 + [(6, 7)]
    for wrong in (((0, 2), (1,)), ((0,), (2,)), ((1, 2),), ((0,), ())):
        with pytest.raises(ValueError, match="do not cover the DoFs in order"):
            bounds(wrong)
    with pytest.raises(ValueError, match="no kinematic groups for 5 DoFs"):
        kinematic_groups(5)


@given(layouts, st.integers(0, 30), st.integers(0, 30))
def test_segments_cut_a_stretch_of_the_chunk_at_the_groups(groups: Groups, start: int, stop: int) -> None:
    cut = list(segments(start, stop, groups))
    dofs = sum(map(len, groups))
    name = [g for g, group in enumerate(groups) for _ in group]
    indices = range(start, stop)
    expected = [list(g) for _, g in groupby(indices, lambda j: j // dofs * len(groups) + name[j % dofs])]
    assert [list(range(first, last)) for first, last, _ in cut] == expected
    assert [gripper for _, _, gripper in cut] == [name[g[0] % dofs] == len(groups) - 1 for g in expected]


class Shifted:
    """Drafts AR's own chunk, shifted by a few bins, so that whole groups are accepted and rejected."""

    name = "shifted"
    needs_states = False

    def __init__(self, truth: list[int], seed: int) -> None:
        self.truth, self.rng = truth, np.random.default_rng(seed)

    def begin(self, chunk: Chunk) -> None:
        pass

    def committed(self, chunk: Chunk, first: int, hidden: torch.Tensor, target_tokens: list[int]) -> None:
        pass

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        ahead = np.array(self.truth[len(chunk.tokens) :][:depth])
        return TokenTree.chain([int(t) for t in np.clip(ahead + self.rng.integers(-1, 2, len(ahead)), 0, 254)])


def test_in_the_loop_paths_end_with_groups_and_a_begun_group_has_one_verdict() -> None:
    torch.manual_seed(0)
    shape = TargetSettings(observation="state", width=32, layers=2, heads=2, feed_forward=48, scene_tokens=2)
    target = CompactTarget(shape, ACTIONS, OBSERVATION, WordTokenizer.build(["open"])).eval()
    accepted = 0
    for seed in range(20):
        prompt = torch.randn(1, target.max_prompt, 32, generator=torch.Generator().manual_seed(seed))
        truth = Decoder(target, MethodSettings()).decode_prompt(prompt).tokens
        loose = MethodSettings("x", ProposerSettings("shifted", nodes=16), AcceptanceSettings("sequence"))
        chunk = Decoder(target, loose, Parts(proposer=Shifted(truth, seed))).decode_prompt(prompt)
        assert len(chunk.tokens) == 16
        for r in chunk.rounds:
            if r.mode == "verify":
                assert (r.start + r.accepted) % 4 in (0, 3) or r.accepted == 0
                assert r.threshold == LIMITS
                accepted += r.accepted
    assert accepted > 20
