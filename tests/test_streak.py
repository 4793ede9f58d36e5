"""skip=streak (docs/methods.md §4.5): when a draft is executed unverified, from the target's agreement alone."""

from typing import Any

import numpy as np
import pytest
import torch
from examples.own_target import MockTarget
from test_unverified import SHOWN, Near

from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.parts import Fixed
from kerv_cli.methods.merged import MergedProposer
from kerv_cli.methods.spec_vla import RelaxedRule
from kerv_cli.methods.streak import StreakSkip, StreakSkipSettings


def decoder_of(source: Any, target: MockTarget, draft: Any = None, radius: int = 0, **settings: Any) -> Decoder:
    skip = StreakSkip(StreakSkipSettings(**settings), source)
    acceptance = RelaxedRule(target.actions) if radius else None
    parts = Parts(acceptance, Fixed(radius), prefill_draft=draft or source, skip=skip)
    made = Decoder(target, parts)
    made.reset("t", 0, np.zeros(3))
    return made


def modes(decoder: Decoder, decodes: int) -> str:
    """s: skipped, v: verified, by decode."""
    return "".join("s" if decoder.decode(SHOWN).skipped else "v" for _ in range(decodes))


def near(target: MockTarget, bins: int = 0) -> Near:
    return Near(target, target.encode(SHOWN), bins)


@torch.inference_mode()
def test_agreement_doubles_what_is_allowed_up_to_the_most():
    target = MockTarget()
    assert (
        modes(decoder_of(near(target), target, most=4), 17)
        == "v" + "s" + "v" + "ss" + "v" + "ssss" + "v" + "ssss" + "vs"
    )


@torch.inference_mode()
def test_a_disagreement_ends_the_streak_and_counting_begins_anew():
    target = MockTarget()
    source = near(target)
    decoder = decoder_of(source, target, tolerance=0.0)
    good, bad = source.drafted, near(target, bins=1).drafted
    assert modes(decoder, 5) == "vsvss"
    source.drafted = bad
    assert modes(decoder, 3) == "vvv"
    source.drafted = good
    assert modes(decoder, 5) == "vsvss"


@torch.inference_mode()
def test_an_episode_begins_with_a_verification():
    target = MockTarget()
    decoder = decoder_of(near(target), target)
    assert modes(decoder, 4) == "vsvs"
    decoder.finish(True)
    decoder.reset("t", 1, np.zeros(3))
    assert modes(decoder, 3) == "vsv"


class ByPlace(MockTarget):
    """A target whose tokens depend on their places alone, so that what it says behind a rejected token is known."""

    def __init__(self) -> None:
        super().__init__()
        self.answers = torch.randn(64, self.actions.tokens, generator=torch.Generator().manual_seed(3)).double()

    def forward(self, x: torch.Tensor, positions: torch.Tensor, cache: Any = None, seen: Any = None) -> torch.Tensor:
        hidden = super().forward(x, positions, cache, seen)
        hidden[..., 0] = positions
        return hidden

    def head(self, hidden: torch.Tensor) -> torch.Tensor:
        return self.answers[hidden[..., 0].long()]


@torch.inference_mode()
@pytest.mark.parametrize(("bins", "agrees"), [(2, True), (12, False)])
def test_a_rejected_draft_near_enough_on_its_own_path_agrees(bins, agrees):
    """A draft that is off by `bins` everywhere but in the strict DoF: 2 bins are 0.013 on average, 12 are 0.08."""
    target = ByPlace()
    truth = np.array(near(target).drafted)
    source = near(target, bins)
    source.drafted = np.where(target.actions.strict_tokens(len(truth)), truth, source.drafted).tolist()
    assert modes(decoder_of(source, target, tolerance=0.05), 2) == ("vs" if agrees else "vv")
    assert modes(decoder_of(source, target, tolerance=0.0), 2) == "vv"


@torch.inference_mode()
def test_a_flipped_strict_dof_never_agrees():
    target = MockTarget()
    source = near(target)
    strict = np.flatnonzero(target.actions.strict_tokens(len(source.drafted)))
    source.drafted[int(strict[0])] = (source.drafted[int(strict[0])] + 1) % target.actions.tokens
    assert modes(decoder_of(source, target, tolerance=2.0), 2) == "vv"


@torch.inference_mode()
def test_another_sources_accepted_chain_does_not_count():
    """The fallback's draft is right, the first source's is not: what would be executed unverified is the first's."""
    target = MockTarget()
    wrong, right = near(target, bins=30), near(target)
    merged = MergedProposer([wrong, right], nodes=64)
    decoder = decoder_of(wrong, target, merged, tolerance=0.0)
    record = decoder.decode(SHOWN)
    assert record.forwards == 1  # the right one was accepted whole
    assert modes(decoder, 2) == "vv"
