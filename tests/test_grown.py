"""A grown target decodes the tokens of its policy, and takes the policy's artifacts."""

import json

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import Observation
from kerv_cli.cli.app import app
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.eagle.drafter import DrafterProposer
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.targets.compact.packable import pack
from kerv_cli.targets.folders import find_target
from kerv_cli.targets.grown import grow_stack
from kerv_cli.targets.settings import GrowSettings
from kerv_cli.worlds.metaworld.spec import SPEC


def observation(seed: int, size: int = 96) -> Observation:
    random = np.random.default_rng(seed)
    return Observation(
        images={"": random.integers(0, 255, (size, size, 3), dtype=np.uint8)},
        proprioception=random.normal(0, 0.1, 4).astype(np.float32) + np.float32([0, 0.6, 0.2, 0.5]),
        state=random.normal(0, 0.1, 39).astype(np.float32),
        instruction=SPEC.task("reach-v3").instruction,
    )


@pytest.mark.parametrize(("width", "heads", "units", "layers"), [(64, 2, 64, 2), (128, 4, 96, 3), (96, 3, 65, 4)])
def test_grown_layers_compute_the_same(policies, width, heads, units, layers):
    target, _ = load_target(find_target(str(policies), "nano-vision"))
    x, positions = torch.randn(1, 9, target.width), torch.arange(9)
    with torch.inference_mode():
        expected = target.trunk(x, positions)
        grow_stack(target.trunk, GrowSettings(width=width, heads=heads, feed_forward=units), layers)
        assert len(target.trunk.layers) == layers
        torch.testing.assert_close(target.trunk(x, positions), expected, rtol=1e-3, atol=1e-5)
        pack(target)
        torch.testing.assert_close(target.trunk(x, positions), expected, rtol=1e-3, atol=1e-5)


def test_a_shape_that_is_too_small_is_refused(policies):
    target, _ = load_target(find_target(str(policies), "nano-vision"))
    for shape in (GrowSettings(width=16, heads=2, feed_forward=64), GrowSettings(width=72, heads=3, feed_forward=64)):
        with pytest.raises(UsageError, match=r"grow\.width"):
            grow_stack(target.trunk, shape, 2)


def test_a_policy_grows_by_command_and_keeps_its_drafter(policies, tmp_path):
    shape = ["grow.width=128", "grow.heads=2", "grow.feed_forward=160", "grow.layers=3", "grow.drafter=true"]
    command = ["build", "target", *shape, "policy.target=nano-vision", f"name={tmp_path}/large"]
    run = CliRunner().invoke(app, [*command, f"results={policies}", "--json"])
    assert run.exit_code == 0, run.output
    folder = tmp_path / "large"
    assert sorted(path.name for path in folder.iterdir()) == ["target.json"], "no weights"
    small = Artifacts(str(policies), PolicySettings(target="nano-vision"))
    large = Artifacts(str(policies), PolicySettings(target=str(folder)))
    assert large.description.sha256 != small.description.sha256
    drafter, grown = small.load("drafter"), large.load("drafter")
    assert (drafter.width, grown.width) == (32, 128)
    prompts = [artifacts.target.encode(observation(0)) for artifacts in (small, large)]
    assert torch.equal(*prompts), "the encoder is the policy's"
    chunks = []
    for artifacts, network in ((small, drafter), (large, grown)):
        target = artifacts.target
        parts = Parts(proposer=DrafterProposer(network, target, 5, 1, 5))
        for method in (None, parts):
            decoder = Decoder(target, method)
            decoder.reset("reach-v3", 0, np.zeros(3))
            chunks.append([decoder.decode(observation(seed)).tokens for seed in range(3)])
    assert all(chunk == chunks[0] for chunk in chunks), "AR and strict drafts, small and grown"


def test_a_grown_target_whose_policy_changed_is_refused(policies, tmp_path):
    command = ["build", "target", "grow=60m", "policy.target=nano-vision", f"name={tmp_path}/large"]
    assert CliRunner().invoke(app, [*command, f"results={policies}"]).exit_code == 0
    path = tmp_path / "large/target.json"
    content = json.loads(path.read_text())
    content["settings"]["grown"]["sha256"] = "0" * 64
    path.write_text(json.dumps(content))
    run = CliRunner().invoke(app, ["doctor", f"policy.target={tmp_path}/large", f"results={policies}"])
    assert run.exit_code == 1
    assert "build it again" in run.output
