"""Parts that do not belong together get one line before a policy is loaded, whatever the command."""

from __future__ import annotations

import pytest

from kerv_cli.config import compose, groups
from kerv_cli.errors import KervError
from kerv_cli.rollouts.composition import check_composition
from kerv_cli.settings import RolloutSettings


@pytest.mark.parametrize("method", groups()["method"])
def test_every_shipped_method_fits_together(method: str) -> None:
    check_composition(compose("rollout", [f"method={method}"], RolloutSettings).parts(), 4)


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ("method=heisd boundary=always", "proposer=hybrid with boundary=always"),
        ("method=spec_vla boundary=fused", "proposer=drafter with boundary=fused"),
        ("method=expert skip=similarity", "the expert verifies nothing"),
        ("opening.sources=[early,nope]", "source of an opening 'nope'"),
        ("opening.sources=[early] opening.nodes=0", "opening.nodes=0"),
        ("chunk=5", "trained for 4 control steps"),
        ("proposer.kind=nope", "proposer.kind 'nope'"),
        ("boundary.kind=nope", "boundary.kind 'nope'"),
        ("rectifier.kind=nope", "rectifier.kind 'nope'"),
        ("rectifier=compensate rectifier.predictor=nope", "rectifier.predictor 'nope'"),
        ("skip.kind=nope", "skip.kind 'nope'"),
        ("method=spec_vla proposer.depth=0", "proposer.depth"),
        ("method=retrieval_only proposer.neighbours=0", "at least one neighbour"),
        ("opening=retrieval opening.neighbours=0", "at least one neighbour"),
    ],
)
def test_what_does_not_belong_together_is_refused(overrides: str, says: str) -> None:
    method = compose("rollout", overrides.split(), RolloutSettings).parts()
    with pytest.raises(KervError) as refused:
        check_composition(method, 4)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)
