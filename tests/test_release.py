"""A policy that the wheel leaves out is unpacked from its archive of the release."""

import re
import shutil
import subprocess
import tarfile
from pathlib import Path

from command import told

from kerv_cli.targets import folders


def test_the_released_policies_are_those_of_a_checkout():
    shipped = Path(__file__).resolve().parents[1].glob("results/pretrained/*/target/target.json")
    assert sorted(path.parts[-3] for path in shipped) == sorted(folders.RELEASED)


def test_the_printed_command_installs_a_policy_that_the_wheel_leaves_out(policies, tmp_path, monkeypatch):
    monkeypatch.setattr(folders, "shipped_dir", lambda: tmp_path / "nothing")
    for kind in ("target", "drafter"):
        shutil.copytree(policies / "artifacts" / kind / "nano-vision", tmp_path / "release/mt50-vision" / kind)
    with tarfile.open(tmp_path / "mt50-vision.tar.gz", "w:gz") as file:
        file.add(tmp_path / "release/mt50-vision", "mt50-vision")
    words = ("rollout", "policy=mt50", "task=reach", f"results={tmp_path}/results", "--plan")
    printed = re.search("'(mkdir .*)'", told(*words, code=2))
    assert printed
    subprocess.run(printed[1], shell=True, cwd=tmp_path, check=True)
    assert "1 task, 3 episodes" in told(*words)
    assert "mt50-vision" in folders.target_names(f"{tmp_path}/results")
