"""The packed weights of a bfloat16 trunk compute the trunk, up to bfloat16's rounding; and decode what it decodes."""

import copy

import numpy as np
import pytest
import torch

from kerv_cli.engine.draft import Draft
from kerv_cli.targets.compact.bfloat16 import Bfloat16Layers, multiplies_bfloat16
from kerv_cli.targets.compact.packable import pack
from kerv_cli.targets.compact.trunk import Trunk

pytestmark = [
    pytest.mark.bits,
    pytest.mark.skipif(not multiplies_bfloat16(), reason="this CPU does not multiply bfloat16"),
]


@pytest.fixture(scope="module")
def trunks():
    """The exact trunk of bfloat16 weights, in float32, and the packed one."""
    torch.manual_seed(3)
    trunk = Trunk(128, 3, 4, 320).eval().requires_grad_(False)
    for parameter in trunk.parameters():
        parameter.data = 0.1 * torch.randn_like(parameter) if parameter.dim() == 2 else 1 + 0.3 * torch.rand(128)
    packed = trunk.bfloat16()
    exact = copy.deepcopy(packed).float()
    pack(packed)
    assert isinstance(packed.packed, Bfloat16Layers)
    return exact, packed


def run(trunk: Trunk, x: torch.Tensor, tree: Draft) -> list[torch.Tensor]:
    """A prefill, a tree, its commit, two single tokens, a batch of two; then the tree in the prefill."""
    prompt, x = 20, x.to(trunk.norm.weight.dtype)
    cache = trunk.new_cache(1, 64)
    hidden = [trunk(x[:, :prompt], torch.arange(prompt), cache)]
    positions = tree.positions(prompt, 1, x.device)
    drafted = x[:, prompt : prompt + 1 + len(tree)]
    hidden.append(trunk(drafted, positions, cache, tree.visible(1)))
    cache.compact(prompt, torch.tensor([prompt, prompt + 2, prompt + 4]))
    hidden += [trunk(x[:, -i][:, None], torch.tensor([prompt + i]), cache) for i in (3, 4)]
    cache.length = 0
    whole = tree.positions(0, prompt, x.device)
    hidden.append(trunk(x[:, : prompt + len(tree)], whole, cache, tree.visible(prompt)))
    hidden.append(trunk(x[:, :10].view(2, 5, -1), torch.arange(5)))
    return hidden


def test_the_packed_trunk_is_the_trunk(trunks):
    tree = Draft.of(range(6), [-1, -1, 0, 1, 3, 2])
    x = torch.randn(1, 32, 128)
    with torch.inference_mode():
        for exact, packed in zip(*(run(trunk, x.bfloat16(), tree) for trunk in trunks), strict=True):
            assert packed.dtype == torch.bfloat16
            assert (packed.float() - exact).abs().mean() < 0.02 * exact.abs().mean()


def test_without_a_cache_one_token_sees_itself_alone(trunks):
    exact, packed = trunks
    x = torch.randn(1, 1, 128).bfloat16()
    with torch.inference_mode():
        told = packed(x, torch.tensor([7])).float()
        assert (told - exact(x.float(), torch.tensor([7]))).abs().mean() < 0.02 * told.abs().mean()


def test_one_verification_and_single_tokens_agree_but_for_ties(trunks):
    """Where their argmax differs, the two best logits lie within bfloat16's rounding: no other cause is allowed."""
    packed, head = trunks[1], torch.randn(50, 128)
    x, differ = torch.randn(1, 36, 128).bfloat16(), 0
    with torch.inference_mode():
        caches = [packed.new_cache(1, 40) for _ in range(2)]
        for cache in caches:
            packed(x[:, :20], torch.arange(20), cache)
        together = packed(x[:, 20:], torch.arange(20, 36), caches[0]).float()[0] @ head.T
        for i in range(16):
            alone = packed(x[:, 20 + i][:, None], torch.tensor([20 + i]), caches[1]).float()[0, 0] @ head.T
            best = np.sort(alone.numpy())[-2:]
            if alone.argmax() != together[i].argmax():
                differ += 1
                assert best[1] - best[0] < 0.05 * alone.abs().max()
            assert (alone - together[i]).abs().max() < 0.05 * alone.abs().max()
    assert differ <= 2


def test_a_copy_has_no_packed_weights(trunks):
    assert copy.deepcopy(trunks[1]).packed is None, "oneDNN's layouts cannot be copied"
