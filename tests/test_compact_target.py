"""The compact target reads its spaces, its checkpoints, grows without changing a token, and decodes all at once."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command import kerv
from conftest import refused
from hypothesis import given
from hypothesis import strategies as st
from loaded import of_target
from mock_target import SEVEN

from kerv_cli.base.config import compose
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.paths import find_target, shipped_dir
from kerv_cli.base.spaces import Observation, ObservationSpace, Place
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.eagle.drafter import EagleDrafter
from kerv_cli.methods.eagle.network import DrafterProposer
from kerv_cli.methods.early.drafter import EarlyDrafter
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.methods.unverified import ParallelPass
from kerv_cli.targets.attention import SIZES, CapturedCache
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.targets.compact.features import WordTokenizer, places_of, privileged_features, scene_features, scene_width
from kerv_cli.targets.compact.growth import grow_stack
from kerv_cli.targets.compact.program import compile_parts
from kerv_cli.targets.compact.target import CompactTarget, Inputs, save_target
from kerv_cli.targets.compact.trunk import Trunk
from kerv_cli.targets.settings import GrowSettings, TargetSettings
from kerv_cli.training.settings import TrainTargetSettings
from kerv_cli.training.target import check_init, continued_target
from kerv_cli.worlds.metaworld.spec import SPEC

ARM = ObservationSpace(
    proprioception=("x", "y", "z", "qw", "qx", "qy", "qz", "open"),
    state=14,
    places=(Place("peg", 8), Place("hole", 11)),
    centre=(0.3, 0.0, 0.2),
)
"""Neither extras nor a step before."""

# what Meta-World's features are, column by column


def relative(vector: torch.Tensor) -> list[torch.Tensor]:
    return [vector / 0.1, torch.tanh(vector / 0.02)]


def test_metaworlds_columns_are_what_the_shipped_weights_were_trained_on():
    states = torch.randn(5, 39, generator=torch.Generator().manual_seed(0)) * 0.2
    hand, gripper, thing, second, goal = (states[:, a:b] for a, b in ((0, 3), (3, 4), (4, 7), (11, 14), (36, 39)))
    centre = torch.tensor([0.0, 0.7, 0.15])
    absolute = [(hand - centre) / 0.1, gripper, (thing - centre) / 0.1, (goal - centre) / 0.1]
    vectors = [*relative(thing - hand), *relative(goal - hand), *relative(goal - thing)]
    velocity = ((states[:, :18] - states[:, 18:36]) / 0.01).clamp(-3, 3)
    beyond = [states[:, 7:18], velocity, *relative(second - hand), *relative(goal - second)]
    space = SPEC.observation
    features = scene_features(states[:, :4], places_of(states, space), torch.tensor(space.centre))
    assert torch.equal(features, torch.cat([*absolute, *vectors], 1))
    assert torch.equal(privileged_features(states[:, :4], states, space), torch.cat(beyond, 1))
    assert features.shape[1] + torch.cat(beyond, 1).shape[1] == 69


@given(felt=st.integers(3, 9), places=st.integers(1, 5), seed=st.integers(0, 1000))
def test_features_of_any_space_depend_on_every_number(felt, places, seed):
    space = ObservationSpace(
        tuple(f"p{i}" for i in range(felt)), 3 * places, tuple(Place(f"o{i}", 3 * i) for i in range(places)), (0, 0, 0)
    )
    random = torch.Generator().manual_seed(seed)
    hand, states = torch.randn(1, felt, generator=random) * 0.05, torch.randn(1, 3 * places, generator=random) * 0.05
    plain = scene_features(hand, places_of(states, space), torch.zeros(3))
    assert plain.shape == (1, scene_width(space))
    for tensor in (hand, states):
        for column in range(tensor.shape[1]):
            moved = tensor.clone()
            moved[0, column] += 0.01
            other = (moved, states) if tensor is hand else (hand, moved)
            assert not torch.equal(scene_features(other[0], places_of(other[1], space), torch.zeros(3)), plain)


# checkpoints


@pytest.mark.parametrize(
    ("name", "cameras", "prompt"),
    [("mt10-h1", ("corner4",), 31), ("mt10-state", (), 15), ("mt50-plain", ("corner4+gripperPOV:75",), 23)],
)
def test_the_shipped_targets_load_with_metaworlds_spaces(name, cameras, prompt):
    target, description = load_target(shipped_dir() / name / "target")
    assert isinstance(target, CompactTarget)
    assert (description.family, description.environment) == ("compact", SPEC.name)
    target.actions.check_same(SPEC.actions, "the target", "Meta-World")
    assert target.observation == SPEC.observation
    assert (target.cameras, target.max_prompt) == (cameras, prompt)
    if name != "mt50-plain":
        request = of_target(description, target)
        assert EagleDrafter().load(shipped_dir() / name / "drafter", request).width == target.width
        assert EarlyDrafter().load(shipped_dir() / name / "early", request).tokens == target.chunk * 4


def nano(observation: str = "state") -> CompactTarget:
    settings = TargetSettings("nano", observation, 16, 1, 2, 24, chunk=2, keypoints=4, channels=8, scene_tokens=2)
    return CompactTarget(settings, SEVEN, ARM, WordTokenizer.build(["insert the peg"]), "front")


def damaged(folder: Path, **changes: object) -> Path:
    save_target(folder, nano(), "insertion", {})
    value = json.loads((folder / "target.json").read_text()) | changes
    (folder / "target.json").write_text(json.dumps(value))
    return folder


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"actions": {"names": []}}, "target.json is damaged: actions"),
        ({"settings": {"chunk": 2, "colour": 1}}, "damaged: colour"),
        ({"settings": {"chunk": 2, "observation": "state", "width": 32, "heads": 2}}, "does not fit its own settings"),
        ({"settings": {"chunk": 2, "width": 32, "heads": 6}}, "width=32 must be a multiple of 2 x heads=6"),
        ({"format": 9}, "written by another version"),
        ({"family": "compct"}, "did you mean compact"),
    ],
)
def test_a_damaged_description_is_one_line(tmp_path, changes, says):
    with refused(says):
        load_target(damaged(tmp_path, **changes))


def test_a_field_of_a_newer_kerv_is_no_damage(tmp_path):
    target, description = load_target(damaged(tmp_path, surplus=1))
    assert (target.chunk, description.family) == (description.chunk, "compact")


def test_weights_that_are_not_finite_are_refused(tmp_path):
    target = nano()
    target.head.weight.data[0, 0] = torch.nan
    save_target(tmp_path, target, "insertion", {})
    with pytest.raises(CheckpointError, match=r"head\.weight that are not finite"):
        load_target(tmp_path)


def test_an_observation_of_another_environment_is_refused():
    target = nano()
    with pytest.raises(CheckpointError, match="8 numbers of proprioception and 14 of state, the environment gives 4"):
        target.encode(Observation(np.zeros(4), np.zeros(39), "insert"))


@pytest.mark.parametrize("tokens", [1, 3, 16, 17, 33, 65, 129])
def test_a_padded_bucket_computes_its_tokens(tokens):
    """What a captured graph would run, call by call: the rows behind the tokens change nothing."""
    torch.manual_seed(0)
    trunk = Trunk(32, 2, 2, 48).eval()
    x, positions = torch.randn(1, 20 + tokens, 32), torch.arange(20 + tokens)
    with torch.inference_mode():
        uncached = trunk.forwarded(x, positions, None, None, None)[:, 20:]
        cache = trunk.new_cache(1, 150, fixed=True)
        assert isinstance(cache, CapturedCache)
        for first, last in ((0, 20), (20, 20 + tokens)):
            in_buckets = cache.run(trunk.forwarded, x[:, first:last], positions[first:last], None)
            cache.length = last
    assert cache.steps.keys() == set(SIZES)
    assert torch.allclose(in_buckets, uncached, atol=1e-5)


# --- grown


def observation(seed: int) -> Observation:
    random = np.random.default_rng(seed)
    return Observation(
        images={"": random.integers(0, 255, (96, 96, 3), dtype=np.uint8)},
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
        compile_parts(target)
        torch.testing.assert_close(target.trunk(x, positions), expected, rtol=1e-3, atol=1e-5)


@given(st.integers(0, 9999), st.integers(1, 20), st.integers(0, 6), st.integers(1, 80), st.booleans())
def test_a_padded_prompt_changes_no_output(seed, prompt, draft, padding, fixed):
    torch.manual_seed(seed)
    trunk, tokens = Trunk(32, 2, 2, 48).eval().requires_grad_(False), prompt + draft
    seen = np.tri(tokens, dtype=bool)
    seen[prompt:, prompt:] &= np.random.default_rng(seed).random((draft, draft)) < 0.5
    seen[np.diag_indices(tokens)] = True
    x, batch = torch.randn(2, tokens + 3, 32), 1 if fixed else 2
    x, positions, outputs = x[:batch], torch.arange(tokens + 3), []
    for trunk.padding in (0, padding):
        for compiled in (False, True):
            trunk.compiled = trunk.new_program() if compiled else None
            cache = trunk.new_cache(batch, tokens + 3, fixed)
            with torch.inference_mode():
                first = trunk(x[:, :tokens], positions[:tokens], cache, seen if draft else None)
                rest = trunk(x[:, tokens:], positions[tokens:], cache)
            assert cache.length == tokens + 3
            outputs.append(torch.cat([first, rest], 1))
    for output in outputs[1:]:
        torch.testing.assert_close(output, outputs[0], rtol=1e-4, atol=1e-5)


def test_a_shape_that_is_too_small_is_refused(policies):
    target, _ = load_target(find_target(str(policies), "nano-vision"))
    for shape in (GrowSettings(width=16, heads=2, feed_forward=64), GrowSettings(width=72, heads=3, feed_forward=64)):
        with pytest.raises(UsageError, match=r"grow\.width"):
            grow_stack(target.trunk, shape, 2)


def test_a_policy_grows_by_command_and_keeps_its_drafter(policies, tmp_path):
    shape = ["grow.width=128", "grow.heads=2", "grow.feed_forward=160", "grow.layers=3", "grow.drafter=true"]
    shape.append("grow.prompt=70")
    base = policies / "artifacts/target/nano-vision"
    command = ["build", "target", *shape, f"policy.target={base}", "name=large"]
    kerv(*command, f"results={tmp_path}", "--json")
    folder = tmp_path / "artifacts/target/large"
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
    half = Artifacts(str(policies), PolicySettings(target=str(folder)), dtype="bfloat16")
    decoder = Decoder(half.target, Parts(proposer=DrafterProposer(half.load("drafter"), half.target, 5, 1, 5)))
    decoder.reset("reach-v3", 0, np.zeros(3))
    assert len(decoder.decode(observation(0)).tokens) == len(chunks[0][0])


def test_a_grown_target_whose_policy_changed_is_refused(policies, tmp_path):
    base = policies / "artifacts/target/nano-vision"
    command = ["build", "target", "grow=60m", f"policy.target={base}", "name=large"]
    kerv(*command, f"results={tmp_path}")
    path = tmp_path / "artifacts/target/large/target.json"
    content = json.loads(path.read_text())
    content["settings"]["grown"]["sha256"] = "0" * 64
    path.write_text(json.dumps(content))
    run = kerv("doctor", "policy.target=large", f"results={tmp_path}", code=1)
    assert "build it again" in run.output


# --- all tokens at once (docs/methods.md §6)


def shape_of(*overrides: str) -> TargetSettings:
    words = ["target=nano", "target.observation=state", "target.chunk=4", *overrides]
    return compose("train_target", words, TrainTargetSettings).target


def small(*overrides: str) -> CompactTarget:
    torch.manual_seed(1)
    words = WordTokenizer.build([SPEC.task("reach-v3").instruction])
    made = CompactTarget(shape_of(*overrides), SPEC.actions, SPEC.observation, words)
    torch.nn.init.normal_(made.head.weight, std=1.0)
    return made.eval()


def in_parallel(policy: CompactTarget, prompt: torch.Tensor) -> list[int]:
    """The tokens by explicit loops over rows: the prompt is causal, every query sees everything."""
    x = torch.cat([prompt, policy.queries[None]], 1)
    length, size = x.shape[1], prompt.shape[1]
    mask = torch.full((length, length), -torch.inf)
    for row in range(length):
        mask[row, : row + 1 if row < size else length] = 0
    rotary = policy.trunk.rotary(torch.arange(length))
    for layer in policy.trunk.layers:
        x = layer(x, rotary, mask=mask)
    return policy.head(policy.trunk.norm(x))[0, size:].argmax(-1).tolist()


@pytest.mark.bits
@torch.inference_mode()
@pytest.mark.parametrize("chunk", [0, 1])
@pytest.mark.parametrize("compiled", [False, True])
def test_all_tokens_come_from_one_forward_in_which_they_see_each_other(compiled, chunk):
    policy = small("target.parallel=true")
    wanted = in_parallel(policy, policy.encode(observation(0)))
    if compiled:
        compile_parts(policy)
    decoder = Decoder(policy, Parts(skip=ParallelPass(policy)), chunk)
    decoder.reset("", 0, np.zeros(3))
    record = decoder.decode(observation(0))
    steps = chunk or policy.chunk
    assert list(record.tokens) == wanted[: steps * policy.actions.dofs]
    assert len(set(wanted)) > 1
    unverified = record.unverified_among(0, len(record.actions))
    assert (record.forwards, record.mode, unverified) == (1, "parallel", steps * policy.actions.dofs)
    assert record.phases["prefill"] > 0


@pytest.mark.bits
def test_training_shows_it_no_action_token():
    policy = small("target.parallel=true")
    one = observation(0)
    inputs: Inputs = policy.inputs(one)
    first = torch.zeros(1, 8, dtype=torch.long)
    logits = [policy.teacher_forced(inputs, tokens)[0] for tokens in (first, first + 5)]
    assert torch.equal(*logits)


def test_it_continues_an_autoregressive_target_with_fresh_queries():
    plain = small()
    made = continued_target(shape_of("target.parallel=true"), plain, "")
    assert torch.equal(made.head.weight, plain.head.weight)
    assert made.queries.shape == (16, plain.width)
    longer = continued_target(replace(shape_of("target.parallel=true"), chunk=8), made, "")
    assert longer.queries.shape == (32, plain.width)
    described = type("D", (), {"settings": vars(plain.settings), "cameras": plain.cameras})()
    check_init(shape_of("target.parallel=true"), "", described, Path("x"))
    with pytest.raises(UsageError):
        check_init(shape_of("target.parallel=true", "target.width=64"), "", described, Path("x"))
