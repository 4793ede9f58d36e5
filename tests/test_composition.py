"""What a method is composed of, what each part needs, what does not fit, and what has no effect."""

import dataclasses
import json
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from conftest import refused

from kerv_cli.base.config import compose, groups
from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.registry import NoSettings
from kerv_cli.base.runtime import set_up
from kerv_cli.base.settings import RuntimeSettings, read_settings
from kerv_cli.episodes.policy import check as check_rollout
from kerv_cli.episodes.resolve import Point, ResolvedStudy, idle_overrides
from kerv_cli.episodes.settings import RolloutSettings, SweepSettings
from kerv_cli.methods import heisd
from kerv_cli.methods.compose import Method
from kerv_cli.methods.eagle import DrafterProposerSettings
from kerv_cli.methods.kerv import CompensateSettings, KinematicThresholdSettings
from kerv_cli.methods.reuse import JacobiProposerSettings
from kerv_cli.methods.spec_vla import FixedThresholdSettings, RelaxedAcceptanceSettings
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.worlds.metaworld.spec import SPEC

METHODS = groups()["method"]
AR: dict[str, Any] = {
    "prefill_draft": NoSettings(),
    "proposer": NoSettings(),
    "acceptance": NoSettings("strict"),
    "threshold": FixedThresholdSettings(r=9),
    "rectifier": NoSettings("reinfer"),
    "boundary": NoSettings("always"),
    "skip": NoSettings(),
}
PRESETS: dict[str, dict[str, Any]] = {
    # what differs from AR, spelled out, in the presets whose tokens tests/golden does not hold
    "naive_sd": {"proposer": DrafterProposerSettings(depth=5)},
    "jacobi": {"proposer": JacobiProposerSettings(depth=0)},
    "spec_vla": {
        "proposer": DrafterProposerSettings(shape="tree", depth=5, top_k=8, nodes=49),
        "acceptance": RelaxedAcceptanceSettings(strict_dofs=False),
    },
    "kerv": {
        "proposer": DrafterProposerSettings(shape="tree", depth=5, top_k=8, nodes=49),
        "acceptance": RelaxedAcceptanceSettings(strict_dofs=False),
        "threshold": KinematicThresholdSettings("offset", r_min=5, r_max=15, phi=2.0, k_s=None),
        "rectifier": CompensateSettings(predictor="kalman", use_target_token=False, drop=False, min_verified=0, rest=4),
    },
    "heisd": {
        "proposer": heisd.HybridProposerSettings(shape="tree", depth=5, top_k=8, nodes=49, neighbours=5),
        "acceptance": heisd.HybridAcceptanceSettings(strict_dofs=False, group_limit=30, token_limit=15),
        "boundary": heisd.FusedBoundarySettings(alpha=0.5, window=15, quantile=0.25, f_star=None),
        "skip": heisd.SimilaritySkipSettings(s_min=None, max_skips=2, up=0.25, down=0.05),
    },
    "heisd_code": {
        "proposer": heisd.HybridProposerSettings(shape="tree", depth=5, top_k=8, nodes=49, neighbours=5),
        "acceptance": heisd.HybridAcceptanceSettings(strict_dofs=False, group_limit=44, token_limit=24),
        "boundary": heisd.FusedBoundarySettings(alpha=0.5, window=15, quantile=0.25, f_star=None),
        "skip": heisd.SimilaritySkipSettings(s_min=-1.0, max_skips=2, up=0.0, down=0.0),
    },
}


def composed(*overrides: str) -> RolloutSettings:
    return compose("rollout", overrides, RolloutSettings)


@pytest.mark.parametrize("method", METHODS)
def test_a_preset_is_the_parts_that_its_name_promises(method):
    asked = composed(f"method={method}")
    assert asked.method == method
    if method in PRESETS:
        assert asked.parts() == {**AR, **PRESETS[method]}
    assert asked.chunk == 0
    Method.of(asked).check(SimpleNamespace(chunk=4, actions=SPEC.actions, parallel=method == "parallel"))


@pytest.mark.parametrize("method", METHODS)
def test_settings_survive_a_file(method):
    asked = composed(f"method={method}", "threshold=change", "policy.artifacts={own: mine}")
    plain = dataclasses.asdict(asked)
    assert read_settings(RolloutSettings, plain) == asked
    again = read_settings(RolloutSettings, json.loads(json.dumps(plain)))
    assert again == asked
    for kind, part in asked.parts().items():
        assert type(getattr(again, kind)) is type(part)


def test_only_what_needs_no_states_can_be_chosen_before_the_prefill():
    before = groups()["prefill_draft"]
    assert {"none", "early", "hold", "kalman", "retrieval", "merged"} <= set(before)
    assert not {"drafter", "hybrid", "jacobi"} & set(before)
    with pytest.raises(UnknownName, match="unknown prefill_draft 'drafter'"):
        composed("prefill_draft=drafter")
    # a part from elsewhere can still be named in settings that Hydra did not compose
    method = {**AR, "prefill_draft": heisd.HybridProposerSettings()}
    with pytest.raises(UsageError, match="prefill_draft=hybrid: it reads the target's states"):
        Method(method).check(SimpleNamespace(chunk=4, actions=SPEC.actions))


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ("method=spec_vla boundary=fused", "proposer=drafter with boundary=fused"),
        ("method=one_pass prefill_draft.sources=[early,nope]", "source of a merged draft 'nope'"),
        ("method=one_pass prefill_draft.sources=[]", "name at least one of sources"),
        ("prefill_draft.kind=drafter", "prefill_draft=drafter"),
        ("chunk=5", "trained for 4 control steps"),
        ("proposer.kind=nope", "proposer.kind 'nope'"),
        ("rectifier=compensate rectifier.predictor=nope", "rectifier.predictor 'nope'"),
        ("rectifier=compensate_draft rectifier.use_target_token=false", "leave rectifier.use_target_token=true"),
        ("skip=always", "skip=always with prefill_draft=none: it executes a draft from before the prefill"),
        ("method=spec_vla threshold.r=255", "threshold.r=255: bins from 0 to 254"),
        ("method=kerv threshold.r_max=255", "threshold.r_max=255: bins from 0 to 254"),
        ("policy=expert skip=similarity", "policy=expert with skip=similarity: the expert decodes nothing"),
        ("policy=expert deviation_every=5", "deviation_every=5: the expert decodes nothing"),
        ("policy.kind=exprt", "unknown policy.kind 'exprt': did you mean expert"),
        ("seed=7", "seed 7 is for training; seeds for evaluation are 100000 to"),
        ("seed=99999 episodes=2", "seed 100000 is for evaluation"),
        ("policy=state method=parallel", "decodes token by token"),
        ("policy=parallel method=ar", "use method=parallel"),
        ("policy=parallel method=parallel proposer=jacobi", "proposer=jacobi: nothing is drafted"),
        ("policy=parallel method=parallel deviation_every=2", "no AR to differ from"),
        (
            "policy=vision world.camera.name=topview",
            "camera.name=topview: mt10-h1 sees corner4, leave it out",
        ),
    ],
)
def test_a_rollout_that_cannot_be_is_refused(overrides, says):
    with refused(says, error=UsageError):
        check_rollout(composed("task=reach", *overrides.split()))


@pytest.mark.parametrize(
    ("overrides", "wanted"),
    [
        ("method=ar", ()),
        ("method=spec_vla", ("drafter",)),
        ("method=spec_vla threshold=offset", ("drafter", "calibration")),
        ("method=kerv", ("drafter", "calibration")),
        ("method=heisd", ("drafter", "datastore", "calibration")),
        ("method=heisd boundary=always_retrieval skip=none", ("drafter", "datastore")),
        ("proposer=kalman", ("calibration",)),
        ("method=one_pass", ("early",)),
        ("method=one_pass prefill_draft.sources=[early] prefill_draft.fallback=[retrieval]", ("early", "datastore")),
    ],
)
def test_a_method_needs_what_its_parts_read_and_nothing_else(overrides, wanted):
    assert sorted(Method.of(composed(*overrides.split())).needs) == sorted(wanted)


# --- effects


@pytest.mark.parametrize(
    ("words", "idle"),
    [
        ("method=spec_vla threshold.r=5", ""),
        ("method=spec_vla acceptance=sequence threshold.r=5", "threshold.r=5"),
        ("method=spec_vla policy.artifacts.datastore=mine", "policy.artifacts.datastore=mine"),
        ("method=spec_vla policy.artifacts.drafter=mine", ""),
        ("method=early_unverified rectifier=compensate", "rectifier=compensate"),
        ("method=one_pass_streak prefill_draft=hold skip=always rectifier=compensate", ""),
        ("method=ar runtime.workers=4", "runtime.workers=4"),
        ("method=ar record=0 record_size=64", "record_size=64"),
        ("method=ar episodes=2 seed=100007 world.horizon=9", ""),
        ("rollout.latency_ms=20", "rollout.latency_ms=20"),
        ("rollout.clock=real rollout.latency_ms=20", "rollout.latency_ms=20"),
        ("rollout.clock=real rollout.latency=constant rollout.profile=x", "rollout.profile=x"),
    ],
)
def test_an_override_without_effect_is_found(words, idle):
    settings = {"x": compose("rollout", words.split(), RolloutSettings)}
    points = {"x": Point("x", tuple(words.split()))}
    assert " ".join(idle_overrides(ResolvedStudy(SweepSettings(), settings, points), sweep=False)) == idle


def test_a_sweep_names_what_none_of_its_settings_reads():
    written = {"a": "method=ar threshold.r=3", "b": "method=spec_vla"}
    settings = {label: compose("rollout", text.split(), RolloutSettings) for label, text in written.items()}
    points = {label: Point(label, tuple(text.split())) for label, text in written.items()}
    common = ("acceptance=relaxed", "policy.artifacts.early=mine", "runtime.workers=2")
    found = idle_overrides(ResolvedStudy(SweepSettings(), settings, points, common))
    assert list(found) == ["a: threshold.r=3", "policy.artifacts.early=mine"]


def test_a_tree_with_more_children_than_there_are_tokens_is_refused(policies):
    target = load_target(policies / "artifacts/target/nano-vision")[0]
    method = Method.of(composed("method=spec_vla", "proposer.shape=tree", "proposer.top_k=300"))
    with refused("proposer.top_k=300: the target has only 255 action tokens", error=UsageError):
        method.decoder(target, lambda kind: None)


def test_a_numbered_gpu_becomes_the_one_that_is_measured(monkeypatch):
    chosen: list[str] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    assert set_up(RuntimeSettings(device="cuda:1"))[0] == "cuda:1"
    assert chosen == ["cuda:1"]
    with refused("runtime.device=cuda:2: torch sees 2 here", error=UsageError):
        set_up(RuntimeSettings(device="cuda:2"))
