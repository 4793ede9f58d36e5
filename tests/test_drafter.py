"""The drafter's dynamic tree against a drafter that walks every path alone: positions, masks, states, ranking."""

import pytest
import torch
from test_decoding_lossless import random_prompt, random_target

from kerv_cli.engine.tree import ROOT, TokenTree
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.drafter import DrafterProposer, EagleDrafter
from kerv_cli.targets.compact.target import CompactTarget


def drafted(seed: int, depth: int, top_k: int, nodes: int) -> tuple[DrafterProposer, CompactTarget, TokenTree]:
    target = random_target(seed, 2, 2, 4)
    torch.manual_seed(seed)
    drafter = EagleDrafter().network(DrafterSettings(), target).eval().requires_grad_(False)
    for parameter in drafter.parameters():
        if parameter.dim() == 2:
            torch.nn.init.normal_(parameter, std=0.3)
    prompt = random_prompt(target, seed)
    hidden = torch.randn(prompt.shape, generator=torch.Generator().manual_seed(seed))
    proposer = DrafterProposer(drafter, target, depth, top_k, nodes)
    following = torch.cat([prompt[:, 1:], target.embed(torch.tensor([[7]]))], 1)
    proposer.observe(following, hidden, 0)
    return proposer, target, proposer.tree(depth).tree


def along(state: DrafterProposer, target: CompactTarget, tokens: list[int]) -> torch.Tensor:
    """Log-probabilities (V,) behind a path that is walked token by token, without tree or mask."""
    base, hidden = state.cache.length, state.hidden[None, None]
    for i, token in enumerate(tokens):
        following = target.embed(torch.tensor([[token]]))
        hidden = state.drafter(following, hidden, torch.tensor([base + i]), state.cache)
    state.cache.length = base
    return torch.log_softmax(target.head(hidden[0, 0]), -1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("depth", "top_k", "nodes"), [(4, 3, 12), (3, 8, 50), (5, 2, 7), (5, 1, 5)])
def test_every_child_is_among_its_own_paths_best(seed, depth, top_k, nodes):
    state, target, tree = drafted(seed, depth, top_k, nodes)
    assert 0 < len(tree) <= nodes
    assert max(tree.depths) < depth
    for parent in {*tree.parents}:
        path = [tree.tokens[i] for i in tree.path_to(parent)] if parent != ROOT else []
        best = along(state, target, path).topk(top_k).indices.tolist()
        children = [tree.tokens[i] for i, p in enumerate(tree.parents) if p == parent]
        assert set(children) <= set(best)
        assert len(set(children)) == len(children)


@pytest.mark.parametrize("seed", range(3))
def test_the_kept_nodes_are_the_most_probable_ones(seed):
    """With every child expanded (top_k wide enough for two levels) the ranking can be done by brute force."""
    state, target, tree = drafted(seed, 2, 4, 9)
    scores: dict[tuple[int, ...], float] = {}
    first = along(state, target, []).topk(4)
    for value, token in zip(first.values.tolist(), first.indices.tolist(), strict=True):
        scores[(token,)] = value
        second = along(state, target, [token]).topk(4)
        for more, child in zip(second.values.tolist(), second.indices.tolist(), strict=True):
            scores[(token, child)] = value + more
    expected = sorted(sorted(scores, key=lambda path: -scores[path])[:9])
    assert sorted(tuple(tree.tokens[i] for i in tree.path_to(n)) for n in range(len(tree))) == expected


def test_true_states_replace_what_was_drafted():
    """After a round the cache holds what a drafter that never drafted would hold."""
    state, _, _ = drafted(1, 4, 3, 12)
    length = state.cache.length
    following, hidden = torch.randn(2, 1, 3, 32).unbind(0)
    state.observe(following, hidden, length)
    fresh = drafted(1, 1, 1, 1)[0]
    fresh.observe(following, hidden, length)
    assert state.cache.length == fresh.cache.length == length + 3
    assert torch.allclose(state.hidden, fresh.hidden, atol=1e-6)
    kept = state.cache.buffer[..., : length + 3, :]
    assert torch.allclose(kept, fresh.cache.buffer[..., : length + 3, :], atol=1e-6)
