"""A frozen policy that is compiled computes on a CPU what its modules do; training and other devices never do."""

import copy
import pickle

import numpy as np
import plain_decoder
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kerv_cli.base.files import own_folder
from kerv_cli.base.spaces import Observation, ObservationSpace, Place
from kerv_cli.engine.decisions import ROOT, TokenTree
from kerv_cli.engine.draft import HOST, Draft
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.drafter import EagleDrafter
from kerv_cli.methods.eagle.network import DrafterProposer
from kerv_cli.methods.early.network import choose
from kerv_cli.targets.checkpoint import compact, expanded
from kerv_cli.targets.compact import program
from kerv_cli.targets.compact.features import WordTokenizer
from kerv_cli.targets.compact.program import Program, compile_parts, kernels, multiplies_bfloat16
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.compact.trunk import Trunk
from kerv_cli.targets.settings import TargetSettings
from kerv_cli.worlds.metaworld.spec import SPEC

pytestmark = pytest.mark.bits

ACTIONS, OBSERVATION = SPEC.actions, SPEC.observation

ALONE = ObservationSpace(("x", "y", "z"), 3, (Place("hole", 0),), (0.1, 0.2, 0.3))  # the least there can be
THREE = ObservationSpace(
    ("x", "y", "z", "roll", "open"), 20, tuple(Place(n, 3 * i) for i, n in enumerate("abc")), (0.0, 0.0, 0.1)
)


def test_compiled_code_is_kept_where_only_this_user_can_write(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder = own_folder()
    assert folder == own_folder()
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    assert own_folder() != folder, "anybody may have written into it"
    folder.rmdir()
    (tmp_path / "theirs").mkdir()
    folder.symlink_to(tmp_path / "theirs")
    assert own_folder() != folder
    assert own_folder().stat().st_mode & 0o777 == 0o700


def shaken(module: torch.nn.Module, seed: int) -> torch.nn.Module:
    """Gains, biases and temperatures away from their initial ones and zeros, so that forgetting one shows."""
    generator = torch.Generator().manual_seed(seed)
    for name, parameter in module.named_parameters():
        if parameter.dim() == 1:
            noise = torch.rand(parameter.shape, generator=generator)
            parameter.data += 0.5 * noise if "norm" in name or "temperature" in name else 0.2 * (noise - 0.5)
    return module.eval().requires_grad_(False)


def both_trunks(seed: int, layers: int, heads: int, channels: int) -> tuple[Trunk, Trunk]:
    torch.manual_seed(seed)
    plain = Trunk(heads * channels, layers, heads, 48)
    for parameter in plain.parameters():
        if parameter.dim() == 2:
            torch.nn.init.normal_(parameter, std=0.1)
    shaken(plain, seed)
    compiled = copy.deepcopy(plain)
    compile_parts(compiled)
    assert compiled.compiled is not None
    return plain, compiled


def both_targets(
    observation: str, seed: int, space: ObservationSpace = OBSERVATION, camera: str = "corner4", **changes: int
) -> tuple[CompactTarget, CompactTarget]:
    torch.manual_seed(seed)
    small = {"image_size": 48, "grid": 2, "keypoints": 5, "channels": 16, "scene_tokens": 3, **changes}
    shape = TargetSettings(observation=observation, width=32, layers=2, heads=2, feed_forward=48, **small)
    words = WordTokenizer.build(["open the drawer"])
    plain = CompactTarget(shape, ACTIONS, space, words, camera)
    shaken(plain, seed)
    compiled = copy.deepcopy(plain)
    compile_parts(compiled)
    return plain, compiled


def random_tree(random: np.random.Generator, nodes: int) -> Draft:
    parents = [int(random.integers(ROOT, i)) for i in range(nodes)]
    return Draft.of(random.integers(0, ACTIONS.tokens, nodes).tolist(), parents)


def close(a: torch.Tensor, b: torch.Tensor) -> bool:
    return a.shape == b.shape and torch.allclose(a, b, atol=1e-5, rtol=1e-5)


def passes(trunk: Trunk, x: torch.Tensor, prompt: int, tree: Draft) -> list[torch.Tensor]:
    """Outputs of a prefill, of a tree after it, of two single tokens after its commit, of which the second does not see
    the first of all; of the tree inside the prefill; and without a cache."""
    nodes = len(tree)
    cache = trunk.new_cache(len(x), prompt + nodes + 3)
    found = [trunk(x[:, :prompt], torch.arange(prompt), cache)]
    positions = tree.positions(prompt, 1, x.device)
    found.append(trunk(x[:, prompt : prompt + 1 + nodes], positions, cache, tree.visible(1)))
    path = tree.tree.path_to(nodes - 1) if nodes else []
    cache.compact(prompt, torch.tensor([prompt, *(prompt + 1 + i for i in path)]))
    for i in range(2):
        at = prompt + 1 + len(path) + i
        visible = np.arange(at + 1)[None] > 0 if i else None
        found.append(trunk(x[:, -1 - i][:, None], torch.tensor([at]), cache, visible))
    whole = tree.positions(0, prompt, x.device)
    cache.length = 0
    found.append(trunk(x[:, : prompt + nodes], whole, cache, tree.visible(prompt)))
    found.append(trunk(x[:, :prompt], torch.arange(prompt)))
    return found


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    layers=st.integers(1, 2),
    heads=st.integers(1, 3),
    channels=st.sampled_from([2, 8, 32]),
    prompt=st.integers(1, 40),
    nodes=st.integers(0, 40),
    batch=st.integers(1, 3),
)
def test_the_packed_trunk_is_the_trunk(seed, layers, heads, channels, prompt, nodes, batch):
    plain, compiled = both_trunks(seed, layers, heads, channels)
    tree = random_tree(np.random.default_rng(seed), nodes)
    x = torch.randn(batch, prompt + nodes + 3, heads * channels)
    before = x.clone()
    with torch.inference_mode():
        outputs = [passes(trunk, x, prompt, tree) for trunk in (plain, compiled)]
    assert all(close(a, b) for a, b in zip(*outputs, strict=True))
    assert torch.equal(x, before)  # the caller's tensor is left alone


@settings(max_examples=4)
@given(
    seed=st.integers(0, 10_000),
    grid=st.sampled_from([1, 2, 3]),
    keypoints=st.integers(1, 9),
    channels=st.sampled_from([8, 24]),
    norm=st.sampled_from(["group", "instance"]),
    space=st.sampled_from([OBSERVATION, ALONE, THREE]),
    views=st.integers(1, 3),
)
def test_the_packed_prompt_is_the_prompt(seed, grid, keypoints, channels, norm, space, views):
    camera, sizes = "+".join(["corner4", "gripperPOV:75", "corner4:25"][:views]), {"grid": grid, "keypoints": keypoints}
    plain, compiled = both_targets("vision", seed, space, camera, **sizes, channels=channels, norm=norm)
    assert compiled.vision.compiled is not None
    random = np.random.default_rng(seed)
    frame = random.integers(0, 256, (48, 48 * views, 3), dtype=np.uint8)
    felt = random.normal(0, 0.2, len(space.proprioception))
    shown = Observation(felt, np.zeros(space.state), "open the drawer", {camera: frame})
    with torch.inference_mode():
        a, b = (t.encode_batch(t.inputs(shown)) for t in (plain, compiled))
    assert close(a[0], b[0])
    assert close(a[1], b[1])


@pytest.mark.parametrize("final_norm", [True, False])
def test_the_drafter_is_packed_too(final_norm):
    target, _ = both_targets("state", 1)
    plain = shaken(EagleDrafter().network(DrafterSettings(final_norm=final_norm), target), 1)
    assert any(name.startswith("norm.") for name in plain.state_dict()) == final_norm
    compiled = copy.deepcopy(plain)
    compile_parts(compiled)
    assert compiled.compiled is not None
    following, hidden = torch.randn(1, 9, 32), torch.randn(1, 9, 32)
    with torch.inference_mode():
        outputs = []
        for drafter in (plain, compiled):
            cache = drafter.new_cache(1, 9)
            first = drafter(following[:, :8], hidden[:, :8], torch.arange(8), cache)
            outputs.append(torch.cat([first, drafter(following[:, 8:], hidden[:, 8:], torch.tensor([8]), cache)], 1))
    assert close(*outputs)
    gain, plain.norm = plain.norm, torch.nn.Identity()
    states = plain.forwarded(plain.enter(following, hidden), torch.arange(9), None, None, None)
    if final_norm:
        states = states / (states.square().mean(-1, keepdim=True) + 1e-5).sqrt() * gain.weight
    assert close(outputs[0], states)


def kinds_of_paths(tree: TokenTree, equal: int) -> list[tuple[int, ...]]:
    """The path to every node, sorted, with one number for tokens that are equally probable."""
    paths: list[tuple[int, ...]] = []
    for token, parent in zip(tree.tokens, tree.parents, strict=True):
        before = () if parent == ROOT else paths[parent]
        paths.append((*before, token // equal))
    return sorted(paths)


@settings(max_examples=20)
@example(seed=1, depth=5, top_k=4, nodes=53, equal=2)
@given(
    seed=st.integers(0, 10_000),
    depth=st.integers(1, 5),
    top_k=st.integers(2, 9),
    nodes=st.integers(1, 70),
    equal=st.sampled_from([1, 2, 3, 255]),
)
def test_the_compiled_tree_is_the_tree(seed, depth, top_k, nodes, equal):
    """Also where `equal` tokens at a time are equally probable and have the same children: the first ones count."""
    target = both_targets("state", seed)[1]
    for part in (target.head, target.embedding):
        rows = torch.randn(255, 32, generator=torch.Generator().manual_seed(seed)) * 0.3
        part.weight.data.copy_(rows[torch.arange(255) // equal * equal])
    drafter = shaken(EagleDrafter().network(DrafterSettings(), target), seed)
    compile_parts(target)
    compile_parts(drafter)
    proposer = DrafterProposer(drafter, target, depth, top_k, nodes)
    drafts = []
    with torch.inference_mode():
        for compiled in (proposer.compiled, None):
            proposer.compiled = compiled
            proposer.observe(*torch.randn(2, 1, 6, 32, generator=torch.Generator().manual_seed(seed)), 0)
            drafts.append(proposer.tree(depth))
        assert proposer.cache.length == 6
    compiled, plain = drafts
    assert compiled.paths is not None
    if compiled.tree != plain.tree:  # equal parents, of which rounding made one more probable
        assert equal > 1
        assert compiled.tree.tokens[:top_k] == plain.tree.tokens[:top_k], "the root has no equals"
        assert kinds_of_paths(compiled.tree, equal) == kinds_of_paths(plain.tree, equal)
        return
    assert np.array_equal(compiled.ancestors, plain.ancestors) or plain.ancestors is None
    assert torch.equal(compiled.positions(6, 1, HOST), plain.positions(6, 1, HOST))


@settings(max_examples=30)
@given(
    seed=st.integers(0, 10_000), radius=st.sampled_from([0, 1, 3, 9, 40]), rows=st.integers(1, 5), even=st.booleans()
)
def test_the_compiled_choice_is_the_choice(seed, radius, rows, even):
    """Of equal logits the first counts, for a strict token and at radius 0."""
    generator = torch.Generator().manual_seed(seed)
    logits = torch.randn(rows, 7, 255, generator=generator) * 4
    logits = logits.round() if even and not radius else logits
    strict = torch.rand(7, generator=generator) < 0.3
    choice = Program(lambda logits, radius: logits.choose(radius, strict), (1, 7, 255), (1, 1))
    found = choice(logits, torch.full((rows, 1), radius))[0]
    tokens, odds = choose(logits, radius, strict)
    assert torch.equal(found[:, :-1].long(), tokens)
    assert torch.allclose(found[:, -1], odds, rtol=1e-3, atol=1e-12)


def test_packed_weights_never_outlive_their_weights():
    for change in (
        lambda m: m.load_state_dict(m.state_dict()),
        lambda m: m.to(torch.float64),
        lambda m: m.requires_grad_(True),
    ):
        _, compiled = both_targets("vision", 4)
        change(compiled)
        assert all(getattr(part, "compiled", None) is None for part in compiled.modules())
    plain, compiled = both_targets("vision", 4)
    for twin in (copy.deepcopy(compiled), pickle.loads(pickle.dumps(compiled.trunk))):
        assert all(getattr(part, "compiled", None) is None for part in twin.modules())
    assert compiled.state_dict().keys() == plain.state_dict().keys()


def test_what_trains_is_not_packed_and_gets_its_gradients():
    _, frozen = both_trunks(6, 1, 2, 8)
    learning = copy.deepcopy(frozen).requires_grad_(True)
    compile_parts(learning)
    assert learning.compiled is None
    learning(torch.randn(1, 4, 16), torch.arange(4)).sum().backward()
    assert learning.layers[0].qkv.weight.grad is not None
    x = torch.randn(1, 4, 16, requires_grad=True)
    frozen(x, torch.arange(4)).sum().backward()
    twin = x.detach().clone().requires_grad_(True)
    copy.deepcopy(frozen)(twin, torch.arange(4)).sum().backward()
    assert close(x.grad, twin.grad)


def test_plain_decoders_in_numpy_and_c_give_the_shipped_policys_tokens(tmp_path):
    assert plain_decoder.main("mt10-h1", 20, tmp_path)


@pytest.mark.parametrize("seed", range(4))
def test_a_row_has_the_same_bits_alone_and_among_many(seed):
    """So a verification equals single forwards even where two logits tie but for the last bit."""
    target = both_targets("vision", seed)[1]
    x, positions, caches = torch.randn(1, 40, 32), torch.arange(40), [target.new_cache(1, 48) for _ in range(3)]
    with torch.inference_mode():
        together = target.head(target(x, positions, caches[0]))
        singly = [target.head(target(x[:, i : i + 1], positions[i : i + 1], caches[1])) for i in range(40)]
        begun = target.head(target(x[:, :20], positions[:20], caches[2]))
        visible = np.tri(20, dtype=bool)
        verified = target.head(target(x[:, 20:], positions[20:], caches[2], visible))
        batch = target.head(target(torch.cat([x, x.flip(1)]), positions))
    assert torch.equal(together, torch.cat(singly, 1))
    assert torch.equal(together, torch.cat([begun, verified], 1))
    assert torch.equal(together, batch[:1])
    assert torch.equal(caches[0].buffer, caches[1].buffer)


@pytest.mark.parametrize("stored", ["float16", "int8"])
def test_weights_stay_as_they_are_stored(stored):
    plain, _ = both_trunks(2, 1, 2, 32)
    plain.load_state_dict(expanded(compact(plain.state_dict(), stored)))
    compiled = copy.deepcopy(plain)
    compile_parts(compiled)
    x, positions = torch.randn(1, 5, 64), torch.arange(5)
    sizes = {matrix.values.dtype.itemsize for matrix in compiled.compiled.matrices}
    assert sizes == ({1} if stored == "int8" else {2 if kernels().EXPANDS_HALF else 4})
    with torch.inference_mode():
        assert close(plain(x, positions), compiled(x, positions))


def test_a_join_of_two_values_is_copied_together():
    x = torch.randn(2, 1, 4)
    program = Program(lambda x: torch.cat([x, x[..., :1].expand(1, 1, 3) * 3.0], -1), (1, 1, 4))
    assert torch.equal(program(x)[0], torch.cat([x, 3.0 * x[..., :1].expand(2, 1, 3)], -1))


# --- bfloat16

needs_bfloat16 = pytest.mark.skipif(not multiplies_bfloat16(), reason="this CPU does not multiply bfloat16")


@pytest.fixture(scope="module", params=["in the program", "by oneDNN"])
def trunks(request):
    """The exact trunk of bfloat16 weights, in float32, and the compiled one."""
    torch.manual_seed(3)
    trunk = Trunk(128, 3, 4, 320).eval().requires_grad_(False)
    for parameter in trunk.parameters():
        parameter.data = 0.1 * torch.randn_like(parameter) if parameter.dim() == 2 else 1 + 0.3 * torch.rand(128)
    compiled = trunk.bfloat16()
    exact = copy.deepcopy(compiled).float()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(program, "LARGE", 0 if request.param == "by oneDNN" else 2**30)
        compile_parts(compiled)
    assert bool(compiled.compiled.blocked) == (request.param == "by oneDNN")
    return exact, compiled


@needs_bfloat16
@pytest.mark.parametrize("prompt", [1, 20])
def test_the_packed_trunk_of_bfloat16_weights_is_the_trunk_up_to_its_rounding(trunks, prompt):
    tree, x = Draft.of(range(6), [-1, -1, 0, 1, 3, 2]), torch.randn(1, 32, 128).bfloat16()
    with torch.inference_mode():
        outputs = (passes(trunk, x.to(trunk.norm.weight.dtype), prompt, tree) for trunk in trunks)
        for exact, compiled in zip(*outputs, strict=True):
            assert compiled.dtype == torch.bfloat16
            assert (compiled.float() - exact).abs().mean() < 0.02 * exact.abs().mean()
        batch = x[:, :10].view(2, 5, -1)
        exact, compiled = (trunk(batch.to(trunk.norm.weight.dtype), torch.arange(5)).float() for trunk in trunks)
        assert (compiled - exact).abs().mean() < 0.02 * exact.abs().mean()
    assert copy.deepcopy(trunks[1]).compiled is None, "oneDNN's layouts cannot be copied"


@needs_bfloat16
def test_one_verification_and_single_tokens_agree_but_for_ties(trunks):
    """Where their argmax differs, the two best logits lie within bfloat16's rounding: no other cause is allowed."""
    compiled, head = trunks[1], torch.randn(50, 128)
    x, differ = torch.randn(1, 36, 128).bfloat16(), 0
    with torch.inference_mode():
        caches = [compiled.new_cache(1, 40) for _ in range(2)]
        for cache in caches:
            compiled(x[:, :20], torch.arange(20), cache)
        together = compiled(x[:, 20:], torch.arange(20, 36), caches[0]).float()[0] @ head.T
        for i in range(16):
            alone = compiled(x[:, 20 + i][:, None], torch.tensor([20 + i]), caches[1]).float()[0, 0] @ head.T
            best = np.sort(alone.numpy())[-2:]
            if alone.argmax() != together[i].argmax():
                differ += 1
                assert best[1] - best[0] < 0.05 * alone.abs().max()
            assert (alone - together[i]).abs().max() < 0.05 * alone.abs().max()
    assert differ <= 2


@needs_bfloat16
def test_tokens_are_the_same_in_one_call_and_in_many_if_onednn_multiplies(monkeypatch):
    monkeypatch.setattr(program, "LARGE", 0)
    target = both_targets("state", 7)[1].bfloat16()
    compile_parts(target)
    assert target.compiled.step.blocked
    caches, prompt = [target.new_cache(1, 20) for _ in range(2)], torch.randn(1, 6, 32).bfloat16()
    with torch.inference_mode():
        for cache in caches:
            target(prompt, torch.arange(6), cache)
        singly = [5]
        for i in range(6, 14):
            token, hidden = target.predict(torch.tensor(singly[-1:]), torch.tensor([i]), caches[0], None)
            assert torch.equal(token, target.head(hidden)[0].argmax(-1))
            singly += token.tolist()
        assert target.continue_greedily(5, 8, caches[1]) == singly[1:]
    assert torch.equal(caches[0].buffer, caches[1].buffer)
