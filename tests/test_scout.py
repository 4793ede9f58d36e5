"""The scout: a drafter with a vision encoder of its own."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from command import kerv
from loaded import of_target

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.batched import BatchDecoder
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.methods.early import ScoutSettings
from kerv_cli.methods.early.drafter import ScoutDrafter, ScoutNetwork, ScoutProposer, check_sees
from kerv_cli.methods.unverified import AlwaysSkip
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.targets.compact.program import compile_parts
from kerv_cli.targets.compact.target import CompactTarget

pytestmark = pytest.mark.usefixtures("quick_report")

SMALL = ScoutSettings(width=24, rank=4, keypoints=4, cell_width=8, cell_features=2, word_width=4)
TASK = "drawer-close-v3"


@pytest.fixture(scope="module")
def target(policies):
    return load_target(policies / "artifacts/target/nano-vision")[0]


@pytest.fixture
def scout(target):
    torch.manual_seed(0)
    scout = ScoutDrafter().network(SMALL, target).eval().requires_grad_(False)
    for parameter in scout.parameters():
        parameter.data += 0.05 * torch.randn_like(parameter)
    return scout


def observed(target: CompactTarget, seed: int) -> Observation:
    random = np.random.default_rng(seed)
    size = target.settings.image_size
    images = {name: random.integers(0, 256, (size, size, 3), dtype=np.uint8) for name in target.cameras}
    state = random.normal(size=target.observation.state)
    return Observation(state[: len(target.observation.proprioception)], state, "close the drawer", images)


def decoder(target: CompactTarget, proposer: ScoutProposer, **parts: Any) -> Decoder:
    made = Decoder(target, Parts(prefill_draft=proposer, **parts))
    made.reset(TASK, 1, np.zeros(3))
    return made


def test_an_unverified_decode_never_runs_the_targets_encoder(target, scout, monkeypatch):
    proposer = ScoutProposer(scout, target)
    unverified = decoder(target, proposer, skip=AlwaysSkip(proposer))
    seen = [observed(target, i) for i in range(3)]
    monkeypatch.setattr(type(target), "encode_batch", lambda self, inputs: pytest.fail("encoded"))
    records = [unverified.decode(one) for one in seen]
    assert all(record.forwards == 0 and record.phases["vision"] == 0 for record in records)
    assert len({record.actions.tobytes() for record in records}) == 3  # it looks
    batch = BatchDecoder(unverified)
    episodes = [batch.new_episode() for _ in seen]
    for state in episodes:
        state.reset(TASK, 1, np.zeros(3))
    for one, together in zip(records, batch.decode(episodes, seen), strict=True):
        assert (one.actions == together.actions).all()


def test_verified_strictly_its_drafts_change_no_token(target, scout):
    plain, drafted = Decoder(target), decoder(target, ScoutProposer(scout, target))
    plain.reset(TASK, 1, np.zeros(3))
    for seed in range(4):
        one = observed(target, seed)
        record = drafted.decode(one)
        assert (record.actions == plain.decode(one).actions).all()
        assert record.phases["vision"] > 0  # encoded once, when the prefill asked


@pytest.mark.parametrize("views", [1, 2])
def test_packed_weights_give_the_same_draft(target, scout, views):
    inputs = target.inputs(observed(target, 0))
    inputs = dataclasses.replace(inputs, images=torch.cat([inputs.images, 255 - inputs.images][:views], -1))
    made = ScoutNetwork(scout.settings, target, views).eval().requires_grad_(False)
    with torch.no_grad():
        for part in made.modules():
            if isinstance(part, (torch.nn.Linear, torch.nn.RMSNorm, torch.nn.GroupNorm)):
                part.weight.normal_(0, 0.3)
    with torch.inference_mode():
        plain, places = made(inputs)
        compile_parts(made)
        assert made.compiled is not None
        compiled, again = made(inputs)
        other = made(dataclasses.replace(inputs, images=255 - inputs.images))[0]
        assert (other - compiled).abs().max() > 10 * (compiled - plain).abs().max()  # it reads the image
    assert torch.allclose(compiled, plain, rtol=1e-3, atol=1e-3)
    assert torch.allclose(again, places, atol=1e-4)


@pytest.mark.usefixtures("quick_training")
def test_it_is_trained_from_the_command_line_for_its_target_alone(demonstrated):
    words = ["train", "drafter", "drafter=scout", "demos=few", "policy.target=nano-vision"]
    words += ["policy.artifacts.scout=mine", "drafter.width=24", "drafter.rank=4", "train.batch=8", "train.steps=4"]
    words += ["train.scene_steps=2", "train.held_out=0.34", "train.validate_every=4"]
    done = kerv(*words, f"results={demonstrated}")
    assert "object_error_cm" in done.stdout
    target, description = load_target(demonstrated / "artifacts/target/nano-vision")
    files, folder = ScoutDrafter(), demonstrated / "artifacts/scout/mine"
    assert files.load(folder, of_target(description, target)).settings.width == 24
    state = load_target(demonstrated / "artifacts/target/nano-state")[0]
    with pytest.raises(CheckpointError):
        check_sees(state)
    rollout = ["rollout", "method=scout_unverified", f"task={TASK}", "episodes=1", "record=0", "world.horizon=12"]
    rollout += ["policy.target=nano-vision", f"results={demonstrated}"]
    kerv(*rollout, "policy.artifacts.scout=mine")
    missing = kerv(*rollout, code=1)
    assert "no scout in" in missing.stderr
    assert "kerv prepare policy.target=nano-vision" in missing.stderr
