"""Trees, ancestor masks, and every acceptance rule against its definition (docs/methods.md §2.1)."""

from itertools import groupby

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mock_target import SEVEN, MockTarget

from kerv_cli.base.registry import find
from kerv_cli.base.spaces import ActionSpace, Group
from kerv_cli.engine.acceptance import DistanceRule
from kerv_cli.engine.decisions import ROOT, TokenTree, merge
from kerv_cli.engine.draft import Draft, ancestors_of, ancestors_on_device
from kerv_cli.methods.context import Context
from kerv_cli.targets.attention import Cache, CapturedCache, attention_mask
from kerv_cli.worlds.metaworld.spec import SPEC

POSITION_GRIPPER = SPEC.actions


def space_of(*sizes: int) -> ActionSpace:
    """Groups of these sizes, the last one strict."""
    names = tuple(f"dof{i}" for i in range(sum(sizes)))
    groups = tuple(Group(f"group{i}", size) for i, size in enumerate(sizes))
    limits = (1.0,) * len(names)
    return ActionSpace(names, groups, names[-sizes[-1] :], 10.0, tuple(-x for x in limits), limits)


layouts = st.sampled_from([POSITION_GRIPPER, SEVEN, space_of(1, 2), space_of(5)])


def group_of_dof(space: ActionSpace) -> list[int]:
    """DoF -> number of its group."""
    return [g for g, group in enumerate(space.groups) for _ in range(group.size)]


def rule(kind: str, space: ActionSpace = POSITION_GRIPPER, **values: object) -> DistanceRule:
    """As a method's part."""
    part = find("acceptance", kind)
    target = MockTarget(space)
    built: DistanceRule = part.built(part.settings(kind=kind, **values), Context(target, lambda kind: None))
    return built


def test_the_settings_become_the_rule():
    chosen = rule("sequence", group_limit=20, token_limit=9)
    assert chosen.limits(3) == (9, 9, 9, 0)
    assert rule("sequence", SEVEN, token_limit=9).limits(3) == (9, 9, 9, 9, 9, 9, 0)
    assert chosen.judge(TokenTree.build([107, 107, 106, 100]), [100] * 5, 0, 3).path == (0, 1, 2, 3)
    assert chosen.judge(TokenTree.build([107, 107, 107, 100]), [100] * 5, 0, 3).path == ()
    assert rule("relaxed", strict_dofs=False).limits(3) == (3, 3, 3, 3)
    assert rule("relaxed").limits(3) == (3, 3, 3, 0)
    assert rule("relaxed", SEVEN).limits(3) == (3, 3, 3, 3, 3, 3, 0)
    assert rule("strict").limits(9) == (0, 0, 0, 0)
    assert (rule("sequence").group_limit, rule("sequence").token_limit) == (30, 15)  # HeiSD's


def test_every_strict_dof_must_match_wherever_it_stands():
    wrist = ActionSpace(("grip", "x", "lock"), (Group("all", 3),), ("grip", "lock"), 10.0, (-1.0,) * 3, (1.0,) * 3)
    assert rule("relaxed", wrist).limits(4) == (0, 4, 0)
    assert rule("sequence", wrist, token_limit=7).limits(4) == (0, 7, 0)


def test_hybrid_judges_retrieved_drafts_by_group_and_all_others_by_distance():
    chosen = rule("hybrid", group_limit=20, token_limit=9, strict_dofs=False)
    retrieved, drafted = chosen.of_drafts_from("retrieval"), chosen.of_drafts_from("drafter")
    tree = TokenTree.build([107, 107, 107, 100])
    assert (retrieved.limits(8), retrieved.judge(tree, [100] * 5, 0, 8).path) == ((9, 9, 9, 0), ())
    assert (drafted.limits(8), drafted.judge(tree, [100] * 5, 0, 8).path) == ((8, 8, 8, 8), (0, 1, 2, 3))
    for kind in ("strict", "relaxed", "sequence"):
        assert rule(kind).of_drafts_from("retrieval") == rule(kind)


def test_groups_that_do_not_cover_the_action_are_refused():
    for sizes in ((3,), (3, 2), (4, 0), ()):
        groups = tuple(Group("group", size) for size in sizes)
        with pytest.raises(ValueError, match="do not cover the 4 DoFs in order"):
            ActionSpace(("a", "b", "c", "d"), groups, (), 10.0, (-1.0,) * 4, (1.0,) * 4)


@given(layouts, st.integers(0, 30), st.integers(0, 30))
def test_segments_cut_a_stretch_of_the_chunk_at_the_groups(space, start, stop):
    cut = list(space.segments(start, stop))
    dofs, name = space.dofs, group_of_dof(space)
    expected = [
        list(g) for _, g in groupby(range(start, stop), lambda j: j // dofs * len(space.groups) + name[j % dofs])
    ]
    assert [list(range(first, last)) for first, last, _ in cut] == expected
    assert [strict for _, _, strict in cut] == [name[g[0] % dofs] == len(space.groups) - 1 for g in expected]


# --- tree and masks


@st.composite
def trees(draw: st.DrawFn) -> TokenTree:
    n = draw(st.integers(0, 12))
    parents = [draw(st.integers(-1, i - 1)) for i in range(n)]
    return TokenTree.build([draw(st.integers(0, 11)) for _ in range(n)], parents)


def reachable(tree: TokenTree) -> np.ndarray:
    """Ancestors by another road: the transitive closure of the parent relation, as powers of a matrix."""
    n = len(tree)
    step = np.zeros((n, n), dtype=int)
    for child, parent in enumerate(tree.parents):
        if parent != ROOT:
            step[child, parent] = 1
    closure = np.linalg.matrix_power(np.eye(n, dtype=int) + step, max(1, n))
    return closure > 0


@given(trees())
def test_ancestors_are_the_transitive_closure_of_parents(tree):
    assert (ancestors_of(tree.parents) == reachable(tree)).all()
    on_device = ancestors_on_device(torch.tensor(tree.parents, dtype=torch.long), max(tree.depths, default=0) + 1)
    assert (on_device.numpy() == reachable(tree)).all()
    assert tree.depths == tuple(int(row.sum()) - 1 for row in ancestors_of(tree.parents))


@given(trees(), st.integers(0, 9), st.integers(1, 6), st.booleans())
def test_the_mask_shows_the_cache_what_stands_before_and_the_ancestors(tree, cached, before, fixed):
    """A draft that is a chain after causal tokens states no mask, because attention is causal without one."""
    like = torch.zeros(())
    cache = CapturedCache(1, 1, 40, 1, like) if fixed else Cache(1, 1, 1, 40, 1, like)
    cache.length = cached
    n = len(tree)
    statement = Draft.of(tree.tokens, tree.parents).visible(before)
    mask = attention_mask(statement, before + n, cache, like)
    if mask is None:
        assert before + n == 1 or (statement is None and not cached)
        assert not fixed
        return
    stop = cached + before + n
    assert mask.shape == (before + n, cache.buffer.shape[-2] if fixed else stop)
    seen = mask.numpy() == 0
    assert np.isneginf(mask.numpy()[~seen]).all()
    assert seen[:, :cached].all()
    assert not seen[:, stop:].any()
    assert (seen[:before, cached : cached + before] == np.tri(before, dtype=bool)).all()
    assert not seen[:before, cached + before :].any()
    assert seen[before:, cached : cached + before].all()
    assert (seen[before:, cached + before : stop] == reachable(tree)).all()


@given(st.lists(st.lists(st.integers(0, 3), min_size=1, max_size=4), max_size=5))
def test_a_merged_tree_holds_exactly_the_prefixes(chains):
    tree = merge(chains)
    prefixes = {tuple(c[: k + 1]) for c in chains for k in range(len(c))}
    paths = [tuple(tree.tokens[i] for i in tree.path_to(node)) for node in range(len(tree))]
    assert sorted(paths) == sorted(prefixes)
