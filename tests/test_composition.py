"""Parts that do not belong together get one line before a policy is loaded, whatever the command."""

from __future__ import annotations

import pytest
from kerv_cli.rollouts.composition import check_composition

from kerv_cli.config import compose, groups
from kerv_cli.errors import KervError
from kerv_cli.rollouts.policy import needs_calibration, needs_datastore, needs_drafter, needs_early
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
        ("method=heisd boundary.window=2", "boundary.window=2"),
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


@pytest.mark.parametrize(
    ("overrides", "drafter", "early", "datastore", "calibration"),
    [
        ("method=ar", False, False, False, False),
        ("method=spec_vla", True, False, False, False),
        ("method=spec_vla threshold=kinematic", True, False, False, True),
        ("method=kerv", True, False, False, True),
        ("method=heisd", True, False, True, True),
        ("method=heisd boundary=always_retrieval skip=none", True, False, True, False),
        ("method=retrieval_only", False, False, True, False),
        ("method=kalman_only", False, False, False, True),
        ("method=one_pass", False, True, False, False),
        ("method=one_pass opening.sources=[damped]", False, False, False, True),
        ("method=one_pass opening=retrieval", False, False, True, False),
        ("method=one_pass_skip", False, True, True, True),
        ("method=one_pass_skip skip.s_min=0.99", False, True, True, False),
    ],
)
def test_a_method_loads_what_it_needs_and_nothing_else(
    overrides: str, drafter: bool, early: bool, datastore: bool, calibration: bool
) -> None:
    method = compose("rollout", overrides.split(), RolloutSettings).parts()
    needs = (needs_drafter(method), needs_early(method), needs_datastore(method), needs_calibration(method))
    assert needs == (drafter, early, datastore, calibration)
