"""Trees, ancestor masks against an independent reference, acceptance against its definition, cache commit."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kerv_cli.engine.acceptance import accept_by_distance
from kerv_cli.engine.draft import Draft, ancestors_of, ancestors_on_device
from kerv_cli.engine.tree import ROOT, TokenTree, merge
from kerv_cli.targets.attention import Cache, attention_mask


@st.composite
def trees(draw: st.DrawFn, most: int = 12, vocabulary: int = 12) -> TokenTree:
    n = draw(st.integers(0, most))
    parents = [draw(st.integers(-1, i - 1)) for i in range(n)]
    return TokenTree.build([draw(st.integers(0, vocabulary - 1)) for _ in range(n)], parents)


def visible(tree: TokenTree, before: int) -> np.ndarray:
    """Who sees whom; a chain behind causal tokens, of which a draft says nothing, is causal."""
    seen = Draft.of(tree.tokens, tree.parents).visible(before)
    return np.tri(before + len(tree), dtype=bool) if seen is None else np.asarray(seen)


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
    assert tree.depths == tuple(int(row.sum()) - 1 for row in ancestors_of(tree.parents))


@given(trees(), st.integers(0, 9), st.integers(1, 6), st.booleans())
def test_the_mask_shows_the_cache_what_stands_before_and_the_ancestors(tree, cached, before, fixed):
    like = torch.zeros(())
    cache = Cache(1, 1, 1, 40, 1, like, fixed)
    cache.length = cached
    n = len(tree)
    mask = attention_mask(visible(tree, before), before + n, cache, like)
    if mask is None:
        assert before + n == 1
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


@pytest.mark.parametrize("fixed", [False, True])
def test_without_a_statement_new_tokens_are_causal(fixed):
    like = torch.zeros(())
    cache = Cache(1, 1, 1, 8, 1, like, fixed)
    cache.length = 2
    mask = attention_mask(None, 3, cache, like)
    assert (mask.numpy()[:, :5] == 0).tolist() == np.tri(3, 5, 2, dtype=bool).tolist()
    assert (attention_mask(None, 1, cache, like) is None) == (not fixed)
    cache.length = 0
    assert (attention_mask(None, 3, cache, like) is None) == (not fixed)


def test_a_child_before_its_parent_is_refused():
    with pytest.raises(ValueError, match="parents come before their children"):
        TokenTree.build([1, 2], [1, -1])


@given(st.lists(st.lists(st.integers(0, 3), min_size=1, max_size=4), max_size=5))
def test_a_merged_tree_holds_exactly_the_prefixes(chains):
    tree = merge(chains)
    prefixes = {tuple(c[: k + 1]) for c in chains for k in range(len(c))}
    paths = [tuple(tree.tokens[i] for i in tree.path_to(node)) for node in range(len(tree))]
    assert sorted(paths) == sorted(prefixes)


def slow_acceptance(tree: TokenTree, target_tokens: list[int], start: int, limits: list[int]) -> tuple[int, int]:
    """docs/methods.md §2.1: the longest root path whose tokens are all within their limits, then the nearest."""
    best = (0, 0)
    for node in range(len(tree)):
        path = tree.path_to(node)
        gaps = [abs(tree.tokens[i] - target_tokens[tree.parents[i] + 1]) for i in path]
        allowed = [limits[(start + d) % len(limits)] for d in range(len(path))]
        if all(gap <= limit for gap, limit in zip(gaps, allowed, strict=True)):
            best = min(best, (-len(path), sum(gaps)))
    return best


@settings(max_examples=200)
@given(trees(), st.data(), st.integers(0, 7), st.lists(st.integers(0, 5), min_size=1, max_size=4))
def test_acceptance_is_its_definition(tree, data, start, limits):
    target_tokens = [data.draw(st.integers(0, 11)) for _ in range(len(tree) + 1)]
    found = accept_by_distance(tree, target_tokens, start, limits)
    gaps = [abs(tree.tokens[i] - target_tokens[tree.parents[i] + 1]) for i in found.path]
    assert (-len(found.path), sum(gaps)) == slow_acceptance(tree, target_tokens, start, limits)
    assert list(found.path) == (tree.path_to(found.path[-1]) if found.path else [])
    end = found.path[-1] if found.path else ROOT
    children = [i for i, parent in enumerate(tree.parents) if parent == end]
    assert (found.rejected is None) == (not children)


@settings(max_examples=60, deadline=None)
@given(data=st.data(), n=st.integers(1, 12))
def test_ancestors_of_tensors_are_those_of_the_tree(data, n):
    parents = [data.draw(st.integers(ROOT, i - 1)) for i in range(n)]
    tree = TokenTree.build([0] * n, parents)
    found = ancestors_on_device(torch.tensor(parents), max(tree.depths) + 1)
    assert (found.numpy() == ancestors_of(parents)).all()
