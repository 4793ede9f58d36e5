"""Files and demonstrations that were made for other actions: every command refuses them in one line."""

import shutil

import numpy as np
import pytest
from command import kerv, refusal
from loaded import of_target

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.methods.eagle.drafter import DrafterProposer, EagleDrafter
from kerv_cli.methods.early.drafter import EarlyDrafter, EarlyProposer
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.worlds.demos.recording import DemoConfig, record

TARGET = "policy.target=nano-state"


@pytest.fixture(scope="module")
def results(policies, tmp_path_factory):
    """A policy of Meta-World, and demonstrations of another environment."""
    results = tmp_path_factory.mktemp("spaces") / "results"
    shutil.copytree(policies, results)
    record(DemoConfig(("insert-peg",), 4, frame_stride=16, workers=1), results / "artifacts/demos/pegs")
    return results


def test_a_rollout_refuses_a_target_of_other_actions(results):
    words = ["rollout", "policy=state", TARGET, "episodes=1", "record=0", f"results={results}", "task=insert-peg"]
    said = "target 'nano-state' has an action space with names dx, dy, dz, gripper, environment insertion one with"
    assert said in refusal(*words)


@pytest.mark.parametrize(
    ("command", "owner"),
    [
        (["train", "target", "task=drawer-close", "name=new", "target.observation=state"], "environment metaworld"),
        (["train", "drafter", TARGET], "the target"),
        (["train", "drafter", "drafter=early", TARGET], "the target"),
        (["build", "datastore", "task=drawer-close", TARGET], "the target"),
        (["calibrate", "task=drawer-close", TARGET], "the target"),
    ],
)
def test_demonstrations_of_another_environment_are_refused_at_once(results, command, owner):
    line = refusal(*command, "demos=pegs", f"results={results}", "--plan")
    assert "artifacts/demos/pegs has an action space with names dx, dy, dz, droll" in line
    assert f"{owner} one with dx, dy, dz, gripper" in line


def test_a_fine_tuned_target_must_be_of_the_demonstrations_environment(results):
    words = ["train", "target", "task=insert-peg", "name=new", "target=nano", "target.observation=state"]
    words += ["train.init=nano-state", "demos=pegs", "world.camera.name=front", f"results={results}"]
    assert "the target in" in refusal(*words)


@pytest.mark.bits
@pytest.mark.usefixtures("quick_training")
def test_a_policy_of_seven_dofs_is_trained_and_decodes_with_its_drafters(results):
    common = ["demos=pegs", "train.steps=4", "train.batch=4", "train.validate_every=2", "train.held_out=0.34"]
    common.append(f"results={results}")
    words = ["task=insert-peg", "name=arm", "target=nano", "target.observation=state", "world.camera.name=front"]
    kerv("train", "target", *words, *common)
    for kind in ("drafter", "early"):
        words = [f"drafter={kind}", "policy.target=arm", "drafter.samples=12"]
        kerv("train", "drafter", *words, *common)
    target, description = load_target(results / "artifacts/target/arm")
    loaded = of_target(description, target)
    drafter = EagleDrafter().load(results / "artifacts/drafter/arm", loaded)
    early = EarlyDrafter().load(results / "artifacts/early/arm", loaded)
    assert early.scale.min() > 0
    assert early.scale.std() > 0  # it knows the spread of what it was shown
    assert early.strict.tolist() == [dof == 6 for dof in range(7)] * target.chunk
    shown = Observation(np.full(7, 0.1), np.full(19, 0.1), "turn the peg and push it into the tilted slot")
    plain = Decoder(target).decode(shown)
    assert plain.actions.shape == (target.chunk, 7)
    tree = Parts(proposer=DrafterProposer(drafter, target, 5, 3, 12))
    for parts in (tree, Parts(prefill_draft=EarlyProposer(early, target))):
        assert Decoder(target, parts).decode(shown).tokens == plain.tokens
