"""What a method does not read is said in one line."""

from dataclasses import asdict

import pytest

from kerv_cli.base.config import compose, conf_dir
from kerv_cli.episodes.identity import effective, idle_keys, without_effect
from kerv_cli.episodes.resolve import Point, ResolvedStudy, idle_overrides
from kerv_cli.episodes.settings import RolloutSettings, SweepSettings


@pytest.mark.parametrize(
    ("words", "idle"),
    [
        ("method=ar acceptance=relaxed", "acceptance=relaxed"),
        ("method=ar threshold.r=5", "threshold.r=5"),
        ("method=ar rectifier=compensate", "rectifier=compensate"),
        ("method=naive_sd threshold.r=5", "threshold.r=5"),
        ("method=spec_vla threshold.r=5", ""),
        ("method=spec_vla acceptance=sequence threshold.r=5", "threshold.r=5"),
        ("method=spec_vla policy.artifacts.datastore=mine", "policy.artifacts.datastore=mine"),
        ("method=spec_vla policy.artifacts.drafter=mine", ""),
        ("method=spec_vla datastore=exact", "datastore=exact"),
        ("method=early_unverified rectifier=compensate", "rectifier=compensate"),
        ("method=one_pass_streak prefill_draft=scout skip=always rectifier=compensate", "rectifier=compensate"),
        ("method=one_pass_streak prefill_draft=hold skip=always rectifier=compensate", ""),
        ("method=ar runtime.workers=4", "runtime.workers=4"),
        ("method=ar record=0 record_size=64", "record_size=64"),
        ("method=ar episodes=2 seed=100007 world.horizon=9", ""),
        ("rollout.ar_ms=20", "rollout.ar_ms=20"),
        ("rollout.clock=real rollout.latency_ms=20 rollout.ar_ms=20", "rollout.latency_ms=20"),
        ("rollout.clock=real rollout.latency=constant rollout.ar_ms=20", "rollout.ar_ms=20"),
    ],
)
def test_an_override_without_effect_is_found(words, idle):
    settings = compose("rollout", words.split(), RolloutSettings)
    assert " ".join(without_effect(settings, words.split())) == idle


def test_no_rectifier_counts_in_the_shipped_methods_that_verify_nothing():
    names = [path.stem for path in conf_dir().glob("method/*_unverified.yaml")]
    assert len(names) == 3
    for name in names:
        settings = compose("rollout", [f"method={name}"], RolloutSettings)
        assert "rectifier" in idle_keys(settings)
        assert "rectifier" not in effective(asdict(settings))


def test_a_sweep_names_what_none_of_its_settings_reads():
    written = {"a": "method=ar threshold.r=3", "b": "method=spec_vla"}
    settings = {label: compose("rollout", text.split(), RolloutSettings) for label, text in written.items()}
    points = {label: Point(label, tuple(text.split())) for label, text in written.items()}
    common = ("acceptance=relaxed", "policy.artifacts.early=mine", "runtime.workers=2")
    found = idle_overrides(ResolvedStudy(SweepSettings(), settings, points, common))
    assert list(found) == ["a: threshold.r=3", "policy.artifacts.early=mine"]
