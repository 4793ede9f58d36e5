"""skip=agreement (docs/methods.md §4.8): a draft is executed unverified where another source drafts nearly the same."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from examples.own_target import MockTarget
from test_unverified import SHOWN, Near

from kerv_cli.base.config import compose
from kerv_cli.base.errors import UsageError
from kerv_cli.base.settings import RolloutSettings
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.methods.agreement import AgreementSkip
from kerv_cli.methods.compose import Method


@torch.inference_mode()
@pytest.mark.parametrize(
    ("bins", "tolerance", "executed"), [(0, 0.0, True), (3, 0.0, False), (3, 0.1, True), (40, 0.1, False)]
)
def test_a_draft_is_executed_where_both_sources_agree(bins: int, tolerance: float, executed: bool) -> None:
    target = MockTarget()
    prompt = target.encode(SHOWN)
    draft, other = Near(target, prompt), Near(target, prompt, bins)
    strict = target.actions.strict_tokens(len(draft.drafted))
    other.drafted = np.where(strict, draft.drafted, other.drafted).tolist()
    decoder = Decoder(target, Parts(prefill_draft=draft, skip=AgreementSkip(draft, other, tolerance)))
    decoder.reset("t", 0, np.zeros(3))
    record = decoder.decode(SHOWN)
    assert record.skipped == executed
    assert list(record.tokens) == draft.drafted  # verified strictly, it is the target's own chunk


@torch.inference_mode()
def test_a_strict_dof_that_differs_and_a_missing_draft_are_verified() -> None:
    target = MockTarget()
    draft, other = (Near(target, target.encode(SHOWN)) for _ in range(2))
    other.drafted[int(np.flatnonzero(target.actions.strict_tokens(len(other.drafted)))[0])] ^= 1
    skip = AgreementSkip(draft, other, 1.0)
    decoder = Decoder(target, Parts(prefill_draft=draft, skip=skip))
    decoder.reset("t", 0, np.zeros(3))
    assert not decoder.decode(SHOWN).skipped
    other.drafted = []
    assert not decoder.decode(SHOWN).skipped


def test_the_other_view_brings_its_own_needs_and_must_draft_whole_chunks() -> None:
    words = ("method=scout_unverified", "skip=agreement")
    assert set(Method.of(compose("rollout", words, RolloutSettings)).needs) == {"scout", "early"}
    for source in ("drafter", "jacobi"):
        with pytest.raises(UsageError, match=f"skip.source={source}: it does not draft whole chunks"):
            compose("rollout", [*words, f"skip.source={source}"], RolloutSettings)
    with pytest.raises(UsageError, match=r"skip\.source=self_cache: it remembers episodes"):
        compose("rollout", [*words, "skip.source=self_cache"], RolloutSettings)
