"""An environment in one file of its own: run and drawn like those that kerv ships."""

import dataclasses

import numpy as np
import pytest
from examples.point_mass import SPEC
from rerun_synthetic import read_recording

from kerv_cli.base import registry
from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.registry import Part
from kerv_cli.episodes.episode import run_episode
from kerv_cli.episodes.policy import ExpertDecoder
from kerv_cli.report.viewing import save_recording
from kerv_cli.worlds.settings import CameraSettings


def test_an_episode_runs_and_is_recorded(tmp_path, monkeypatch):
    part = Part("environment", SPEC.name, "examples.point_mass:SPEC")
    monkeypatch.setitem(registry._PARTS, "environment", {**registry.parts("environment"), SPEC.name: part})
    with SPEC.open_world("push-point") as world:
        record = run_episode(world, ExpertDecoder(), 100_000, CameraSettings(size=24))
        world.reset(100_000)
        assert record.initial_state.tolist() == world.initial_state.tolist()
        with pytest.raises(KervError, match="2 finite numbers"):
            world.step([0.0, 0.0, 0.0])
    assert record.success
    assert (record.environment, record.space) == ("point-mass", SPEC.actions)
    assert record.actions.shape == (record.steps, 2)
    assert np.abs(record.actions).max() <= np.float32(0.05)
    assert record.gripper.tolist() == [1.0] * (record.steps + 1)
    assert record.frames[0].shape == (24, 24, 3)
    found = read_recording(save_recording(record, tmp_path / "point.rrd", method="expert"))
    assert found["timelines"]["time"] == (0, record.steps * 100_000_000)


def test_an_environment_may_have_no_experts():
    with pytest.raises(UsageError, match="point-mass has no scripted experts"):
        dataclasses.replace(SPEC, expert_class="").expert("push-point")
