"""What seeds draw and worlds do is the same on every CPU: lengths, a recording, stress under another kernel."""

import hashlib
import math
import os
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kerv_cli.base.registry import parts
from kerv_cli.worlds import spec_of
from kerv_cli.worlds.demos.recording import DemoConfig, record
from kerv_cli.worlds.settings import CameraSettings, StressSettings
from kerv_cli.worlds.stress import base as stressing
from kerv_cli.worlds.vectors import length

pytestmark = pytest.mark.bits

SMALL = CameraSettings(size=24, supersample=1)


@given(st.lists(st.floats(1e-100, 1e100).flatmap(lambda x: st.sampled_from([x, -x])), max_size=9))
def test_a_length_is_rounded_once_per_number_and_for_the_root(numbers):
    total = 0.0
    for number in numbers:
        total = float(Fraction(number) ** 2 + Fraction(total))
    assert length(np.array(numbers)) == math.sqrt(total)


def recordings(folder: Path) -> list[str]:
    """Hashes of demonstrations with noise, in two environments."""
    configs = [
        DemoConfig((tasks,), episodes=2, camera=SMALL, frame_stride=25, workers=1, tail=5)
        for tasks in ("INSERTION", "reach")
    ]
    return [record(config, folder / config.spec.name).sha256 for config in configs]


def stressed() -> list[str]:
    """One hash per kind of stress, at its strongest: an episode's model, states and pictures."""
    spec, found = spec_of("insert-peg"), []
    with spec.open_world("insert-peg", SMALL) as world:
        expert, camera = spec.expert(world.task), world.camera.name
        for kind in sorted(parts("stress")):
            world.stress = stressing.build(StressSettings(kind, 4))
            observation, model = world.reset(50_000), world._drawable()[0]
            seen = [model.light_dir, model.light_pos, model.cam_pos, model.cam_quat, model.geom_rgba]
            for _ in range(12):
                seen += [observation.state, world.observe([camera]).images[camera]]
                observation = world.step(expert(observation))
            found.append(hashlib.sha256(b"".join(array.tobytes() for array in seen)).hexdigest())
    return found


def digests(folder: Path) -> list[str]:
    return recordings(folder) + stressed()


def test_another_kernel_records_and_draws_the_same(tmp_path):
    """OpenBLAS's kernels for Prescott run on every x86-64 and round other bits than those of later CPUs; on other
    machines the variable has no effect. Of Meta-World the float32 state of recordings is compared: in float64 the last
    bit of its gripper's opening is `np.linalg.norm`'s."""
    plugins = {"KERV_PLUGINS": "examples.insertion", "PYTHONPATH": os.pathsep.join(sys.path)}
    environment = os.environ | plugins | {"OPENBLAS_CORETYPE": "Prescott"}
    command = [sys.executable, __file__, str(tmp_path / "other")]
    other = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert other.stdout.split() == digests(tmp_path / "own"), other.stderr


if __name__ == "__main__":
    print(*digests(Path(sys.argv[1])))
