"""An environment in one file of its own: registered, found, run and drawn like those that kerv ships."""

from __future__ import annotations

import dataclasses
import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from kerv_cli.base import registry
from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.settings import CameraSettings
from kerv_cli.lab.episode import run_episode
from kerv_cli.lab.expert import ExpertDecoder
from kerv_cli.report.viewing import save_recording
from kerv_cli.report.viewing.viewer import read_recording
from kerv_cli.worlds.spec import EnvironmentSpec

TESTS = Path(__file__).parent


@pytest.fixture
def spec(monkeypatch: pytest.MonkeyPatch) -> EnvironmentSpec:
    """The example's, registered for one test."""
    monkeypatch.setitem(registry._PARTS, "environment", dict(registry.parts("environment")))
    monkeypatch.delitem(sys.modules, "examples.point_mass", raising=False)
    module = importlib.import_module("examples.point_mass")
    found: EnvironmentSpec = module.SPEC
    return found


def test_an_episode_runs_and_is_recorded(spec: EnvironmentSpec, tmp_path: Path) -> None:
    with spec.open_world("push-point") as world:
        record = run_episode(world, ExpertDecoder(), 100_000, CameraSettings(size=24))
        world.reset(100_000)
        assert record.initial_state.tolist() == world.initial_state.tolist()
        with pytest.raises(KervError, match="2 finite numbers"):
            world.step([0.0, 0.0, 0.0])
    assert record.success
    assert (record.environment, record.space) == ("point-mass", spec.actions)
    assert record.actions.shape == (record.steps, 2)
    assert np.abs(record.actions).max() <= np.float32(0.05)
    assert record.gripper.tolist() == [1.0] * (record.steps + 1)
    assert record.frames[0].shape == (24, 24, 3)
    found = read_recording(save_recording(record, tmp_path / "point.rrd", method="expert"))
    assert found["timelines"]["time"] == (0, record.steps * 100_000_000)


def test_an_environment_may_have_no_experts(spec: EnvironmentSpec) -> None:
    with pytest.raises(UsageError, match="point-mass has no scripted experts"):
        dataclasses.replace(spec, expert_class="").expert("push-point")
