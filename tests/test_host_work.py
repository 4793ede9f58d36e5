"""Host work of a round: the stand-in decodes as a target does, and what is counted as a product."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kerv_cli.bench.host import METHODS, WRONG, decoder_of, measure_host, projected_token
from kerv_cli.bench.shares import is_product
from kerv_cli.decoding.proposers import rows_of
from kerv_cli.drafting.tree import ROOT, TokenTree, merge
from kerv_cli.drafting.unread import ancestors
from kerv_cli.spaces import Observation

CPU = torch.device("cpu")


@pytest.mark.bits
def test_the_stand_in_is_decoded_as_a_target() -> None:
    """Strict methods give AR's tokens in fewer forwards: every draft ends at the first wrong token."""
    observation = Observation(np.zeros(1), np.zeros(1), "", {})
    wanted = decoder_of("ar", CPU, 16).decode(observation)
    assert wanted.forwards == 16
    for method in ("naive_sd", "one_pass_strict"):
        found = decoder_of(method, CPU, 16).decode(observation)
        assert found.tokens == wanted.tokens
        assert found.forwards < 16
    one_pass = decoder_of("one_pass_strict", CPU, 16).decode(observation)
    assert one_pass.rounds[0].accepted == min(WRONG)


def test_every_method_is_measured() -> None:
    found = measure_host(CPU, 16, 3)
    assert [work.method for work in found] == list(METHODS)
    assert all(0 < work.per_round <= work.seconds for work in found)


def test_a_7b_token_reads_its_weights_once() -> None:
    layer = 4 * 4096**2 + 3 * 4096 * 11008
    assert projected_token() == pytest.approx(2 * 32 * layer / 4.8e12, rel=0.01)


@pytest.mark.parametrize("name", ["aten::mm", "aten::addmv_", "mkldnn::_linear_pointwise", "aten::_softmax"])
def test_products_and_attention_are_told_by_name(name: str) -> None:
    assert is_product(name)
    assert not is_product("aten::silu")
    assert not is_product("aten::cat")


@settings(max_examples=60, deadline=None)
@given(data=st.data(), keep=st.integers(1, 4))
def test_a_merged_trees_nodes_have_their_chains_rows(data: st.DataObject, keep: int) -> None:
    chains = data.draw(st.lists(st.lists(st.integers(0, 2), min_size=1, max_size=5), min_size=1, max_size=4))
    tree = merge(chains[:keep])
    flat = [tuple(chain[: i + 1]) for chain in chains for i in range(len(chain))]
    for node, row in enumerate(rows_of(tree, chains)):
        assert flat[row] == tuple(tree.tokens[i] for i in tree.path_to(node))


@settings(max_examples=60, deadline=None)
@given(data=st.data(), n=st.integers(1, 12))
def test_ancestors_of_tensors_are_those_of_the_tree(data: st.DataObject, n: int) -> None:
    parents = [data.draw(st.integers(ROOT, i - 1)) for i in range(n)]
    tree = TokenTree.build([0] * n, parents)
    found = ancestors(torch.tensor(parents), max(tree.depths) + 1)
    assert (found.numpy() == tree.ancestors()).all()
