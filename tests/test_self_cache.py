"""The self-cache: the target's own chunks of earlier episodes as drafts (docs/methods.md §5.3)."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
import torch
from test_decoding_lossless import plain_greedy, random_prompt, random_target

from kerv_cli.base.settings import RolloutSettings
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.lab.identity import depends_on_order
from kerv_cli.methods.certified import ScopedSettings
from kerv_cli.methods.merged import MergedProposerSettings
from kerv_cli.methods.merged.proposer import MergedProposer
from kerv_cli.methods.self_cache import SelfCacheSettings
from kerv_cli.methods.self_cache.proposer import SelfCacheProposer
from kerv_cli.methods.streak import StreakSkip, StreakSkipSettings
from kerv_cli.targets.compact.target import CompactTarget

TASK = "reach-v3"


@pytest.fixture(scope="module")
def target() -> CompactTarget:
    return random_target(3, 1, 2, 2)


def episode(decoder: Decoder, prompts: list[torch.Tensor], ends: bool = True) -> list[int]:
    """Forwards of each decode; every decode equals AR's."""
    decoder.reset(TASK, 0, np.zeros(3))
    chunks = [decoder.decode_prompt(prompt) for prompt in prompts]
    assert [chunk.tokens for chunk in chunks] == [plain_greedy(decoder.target, prompt) for prompt in prompts]
    if ends:
        decoder.finish(True)
    return [chunk.forwards for chunk in chunks]


@pytest.mark.parametrize("merged", [False, True])
@torch.inference_mode()
def test_a_scene_that_was_decoded_before_is_one_forward_from_the_least_number_of_episodes_on(
    target: CompactTarget, merged: bool
) -> None:
    prompts = [random_prompt(target, seed) for seed in range(3)]
    cache = SelfCacheProposer(SelfCacheSettings(least=2), target)
    decoder = Decoder(target, Parts(prefill_draft=MergedProposer([cache], 48) if merged else cache))
    size = target.chunk * target.actions.dofs
    assert episode(decoder, prompts) == [size] * 3
    assert episode(decoder, prompts) == [size] * 3  # one episode is too few
    assert episode(decoder, prompts) == [1] * 3
    assert episode(decoder, [random_prompt(target, 9)])[0] <= size  # a wrong draft costs nothing but its nodes


@torch.inference_mode()
def test_an_episode_without_an_end_is_not_remembered(target: CompactTarget) -> None:
    prompts = [random_prompt(target, 0)]
    decoder = Decoder(target, Parts(prefill_draft=SelfCacheProposer(SelfCacheSettings(least=1), target)))
    for _ in range(3):  # as a warm-up
        assert episode(decoder, prompts, ends=False)[0] > 1
    episode(decoder, prompts)
    assert episode(decoder, prompts) == [1]


@pytest.mark.parametrize("merged", [False, True])
@torch.inference_mode()
def test_an_episode_that_never_asks_the_cache_leaves_nothing_in_it(target: CompactTarget, merged: bool) -> None:
    cache = SelfCacheProposer(SelfCacheSettings(least=1), target)
    decoder = Decoder(target, Parts(prefill_draft=MergedProposer([], 48, [cache]) if merged else cache))
    episode(decoder, [random_prompt(target, 0)], ends=False)  # as a warm-up
    episode(decoder, [])
    assert not cache.tasks


@torch.inference_mode()
def test_the_newest_chunks_are_kept_and_unverified_ones_are_not(target: CompactTarget) -> None:
    cache = SelfCacheProposer(SelfCacheSettings(least=1, most=2), target)
    decoder = Decoder(target, Parts(prefill_draft=cache))
    episode(decoder, [random_prompt(target, seed) for seed in range(3)])
    assert cache.tasks[TASK].tokens == [plain_greedy(target, random_prompt(target, seed)) for seed in (1, 2)]
    trusting = Decoder(target, Parts(prefill_draft=cache, skip=StreakSkip(StreakSkipSettings(opening=1), cache)))
    before = [list(tokens) for tokens in cache.tasks[TASK].tokens]
    assert episode(trusting, [random_prompt(target, 2)]) == [0]
    assert cache.tasks[TASK].tokens == before


def test_results_that_depend_on_earlier_episodes_are_reused_whole() -> None:
    def settings(draft: object) -> dict[str, object]:
        return asdict(RolloutSettings(prefill_draft=draft))

    assert depends_on_order(settings(SelfCacheSettings()))
    assert depends_on_order(settings(MergedProposerSettings(fallback=["hold", "self_cache"])))
    assert not depends_on_order(settings(MergedProposerSettings()))
    assert depends_on_order(settings(ScopedSettings(outside="self_cache")))
    assert not depends_on_order(settings(ScopedSettings()))
