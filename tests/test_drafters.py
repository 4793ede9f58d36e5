"""Drafters: the dynamic tree against one that walks every path alone, and the early drafter's training."""

import dataclasses
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from loaded import of_target
from test_decoding_lossless import random_prompt, random_target

from kerv_cli.base.config import compose
from kerv_cli.base.errors import CheckpointError
from kerv_cli.engine.decisions import ROOT, TokenTree
from kerv_cli.methods.artifacts import MadeFor
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.drafter import EagleDrafter
from kerv_cli.methods.eagle.network import DrafterProposer
from kerv_cli.methods.early import EarlySettings
from kerv_cli.methods.early.drafter import EarlyDrafter, EarlyExamples, measure
from kerv_cli.methods.early.network import EarlyNetwork, choose
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.targets.compact.features import WordTokenizer
from kerv_cli.targets.compact.program import compile_parts
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.losses import soft_labels, token_loss, within_chunk
from kerv_cli.targets.samples import split
from kerv_cli.targets.settings import TargetSettings
from kerv_cli.training.settings import TrainDrafterSettings
from kerv_cli.training.target import load_samples
from kerv_cli.worlds.demos.dataset import DemoDataset
from kerv_cli.worlds.metaworld.spec import SPEC


def drafted(seed: int, depth: int, top_k: int, nodes: int) -> tuple[DrafterProposer, CompactTarget, TokenTree]:
    target = random_target(seed, 2, 2, 4)
    torch.manual_seed(seed)
    drafter = EagleDrafter().network(DrafterSettings(), target).eval().requires_grad_(False)
    for parameter in drafter.parameters():
        if parameter.dim() == 2:
            torch.nn.init.normal_(parameter, std=0.3)
    prompt = random_prompt(target, seed)
    hidden = torch.randn(prompt.shape, generator=torch.Generator().manual_seed(seed))
    proposer = DrafterProposer(drafter, target, depth, top_k, nodes)
    following = torch.cat([prompt[:, 1:], target.embed(torch.tensor([[7]]))], 1)
    proposer.observe(following, hidden, 0)
    return proposer, target, proposer.tree(depth).tree


def along(state: DrafterProposer, target: CompactTarget, tokens: list[int]) -> torch.Tensor:
    """Log-probabilities (V,) behind a path that is walked token by token, without tree or mask."""
    base, hidden = state.cache.length, state.hidden[None, None]
    for i, token in enumerate(tokens):
        following = target.embed(torch.tensor([[token]]))
        hidden = state.drafter(following, hidden, torch.tensor([base + i]), state.cache)
    state.cache.length = base
    return torch.log_softmax(target.head(hidden[0, 0]), -1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("depth", "top_k", "nodes"), [(4, 3, 12), (3, 8, 50), (5, 2, 7), (5, 1, 5)])
def test_every_child_is_among_its_own_paths_best(seed, depth, top_k, nodes):
    state, target, tree = drafted(seed, depth, top_k, nodes)
    assert 0 < len(tree) <= nodes
    assert max(tree.depths) < depth
    for parent in {*tree.parents}:
        path = [tree.tokens[i] for i in tree.path_to(parent)] if parent != ROOT else []
        best = along(state, target, path).topk(top_k).indices.tolist()
        children = [tree.tokens[i] for i, p in enumerate(tree.parents) if p == parent]
        assert set(children) <= set(best)
        assert len(set(children)) == len(children)


@pytest.mark.parametrize("seed", range(3))
def test_the_kept_nodes_are_the_most_probable_ones(seed):
    """With every child expanded (top_k wide enough for two levels) the ranking can be done by brute force."""
    state, target, tree = drafted(seed, 2, 4, 9)
    scores: dict[tuple[int, ...], float] = {}
    first = along(state, target, []).topk(4)
    for value, token in zip(first.values.tolist(), first.indices.tolist(), strict=True):
        scores[(token,)] = value
        second = along(state, target, [token]).topk(4)
        for more, child in zip(second.values.tolist(), second.indices.tolist(), strict=True):
            scores[(token, child)] = value + more
    expected = sorted(sorted(scores, key=lambda path: -scores[path])[:9])
    assert sorted(tuple(tree.tokens[i] for i in tree.path_to(n)) for n in range(len(tree))) == expected


def test_true_states_replace_what_was_drafted():
    """After a round the cache holds what a drafter that never drafted would hold."""
    state, _, _ = drafted(1, 4, 3, 12)
    length = state.cache.length
    following, hidden = torch.randn(2, 1, 3, 32).unbind(0)
    state.observe(following, hidden, length)
    fresh = drafted(1, 1, 1, 1)[0]
    fresh.observe(following, hidden, length)
    assert state.cache.length == fresh.cache.length == length + 3
    assert torch.allclose(state.hidden, fresh.hidden, atol=1e-6)
    kept = state.cache.buffer[..., : length + 3, :]
    assert torch.allclose(kept, fresh.cache.buffer[..., : length + 3, :], atol=1e-6)


# --- early

ACTIONS, OBSERVATION = SPEC.actions, SPEC.observation

SMALL = EarlySettings(layers=2, width=32, rank=8, samples=1000)
SHAPE = TargetSettings(width=16, chunk=2, grid=2, instruction_tokens=3, scene_tokens=2)  # 4 vision tokens, P = 10
STRICT = torch.from_numpy(ACTIONS.strict_tokens(8))


def shaped() -> CompactTarget:
    return CompactTarget(SHAPE, ACTIONS, OBSERVATION, WordTokenizer.build(["open"]), "corner4")


def drafter(settings: EarlySettings = SMALL, target: CompactTarget | None = None) -> EarlyNetwork:
    torch.manual_seed(0)
    early = EarlyDrafter().network(settings, target or shaped()).eval()
    for parameter in early.parameters():
        if parameter.dim() == 2:
            torch.nn.init.normal_(parameter, std=0.3)
    return early


def tokens_of(early: EarlyNetwork, features: torch.Tensor, radius: int) -> list[int]:
    """The drafted tokens of one observation."""
    return early.draft(features, radius)[0, :-1].long().tolist()


def test_a_draft_is_the_argmax_of_the_forward_and_depends_on_all_it_is_shown():
    early, target = drafter(), shaped()
    prompt = torch.randn(1, 10, 16, generator=torch.Generator().manual_seed(1))

    def drafted(prompt, radius=0):
        return tokens_of(early, target.pooled(prompt), radius)

    logits = early(target.pooled(prompt))
    assert logits.shape == (1, 8, 255)
    plain = drafted(prompt)
    assert plain == logits[0].argmax(-1).tolist()
    assert drafted(prompt, 9) == choose(logits, 9, STRICT)[0][0].tolist()
    for token in range(10):
        moved = prompt.clone()
        moved[:, token] += 3.0
        assert drafted(moved) != plain


@pytest.mark.bits
def test_packed_weights_give_the_same_logits():
    torch.manual_seed(0)
    early = drafter(EarlySettings(layers=2, width=24, rank=6))
    for parameter in early.parameters():  # fresh blocks begin as the identity, with gains of one
        parameter.data += 0.3 * torch.randn_like(parameter)
    features = torch.randn(9, early.mean.numel())
    early.standardise(5.0 * features + 2.0)
    early.eval().requires_grad_(False)
    plain = early(features[:1])
    compile_parts(early)
    assert early.compiled is not None
    assert torch.allclose(early(features[:1]), plain, rtol=1e-4, atol=1e-4)
    assert not torch.allclose(early(torch.zeros_like(features[:1])), plain, rtol=1e-2)
    assert len(early(features[:2])) == 2
    early.requires_grad_(True)
    assert early.compiled is None, "weights that can change are not compiled"


def test_the_chosen_bin_is_the_one_most_likely_to_be_accepted():
    """Against brute force: among all 255 bins, the chosen one's probability within the radius is the greatest (up to
    the small weight of closeness)."""
    generator = torch.Generator().manual_seed(3)
    logits = torch.randn(2, 8, 255, generator=generator) * 2
    logits[0, 0, 17], logits[0, 0, 100:104] = 9.0, 8.5  # one likely bin against four neighbours
    assert choose(logits, 0, STRICT)[0][0, 0] == 17
    assert 100 <= choose(logits, 3, STRICT)[0][0, 0] <= 103
    probability = logits.softmax(-1)
    for radius in (1, 4, 9):
        tokens, _ = choose(logits, radius, STRICT)
        assert torch.equal(tokens[:, 3::4], logits.argmax(-1)[:, 3::4])
        for b in range(2):
            for j in (0, 1, 2, 4, 5, 6):
                sums = [probability[b, j, max(0, t - radius) : t + radius + 1].sum() for t in range(255)]
                assert sums[int(tokens[b, j])] > max(sums) - 0.15 * max(sums) - 1e-6
    assert choose(torch.eye(255)[None, [254] * 4] * 30, 9, STRICT[:4])[0].tolist() == [
        [254] * 4
    ]  # not nine bins inside


@given(st.integers(0, 10_000), st.integers(0, 20))
def test_the_odds_are_those_of_independent_tokens(seed, radius):
    logits = 3 * torch.randn(2, 8, 255, generator=torch.Generator().manual_seed(seed))
    tokens, found = choose(logits, radius, STRICT)
    for row in range(2):
        odds = 1.0
        for i, token in enumerate(tokens[row].tolist()):
            r = 0 if i % 4 == 3 else radius
            window = slice(max(0, token - r), token + r + 1)
            odds *= float(logits[row, i].double().softmax(-1)[window].sum())
        assert float(found[row]) == pytest.approx(odds, rel=1e-3)


# what it is trained on


def examples_of(
    target: CompactTarget, dataset: DemoDataset, settings: EarlySettings
) -> tuple[EarlyExamples, EarlyExamples]:
    made: Any = EarlyDrafter().examples(target, dataset, settings, 0.34, lambda done, total: None)
    return made


@pytest.mark.bits
@pytest.mark.parametrize("name", ["nano-vision", "nano-state"])
def test_the_teachers_tokens_are_the_targets_own_decodes(demonstrated, name):
    """Batched over episodes, yet sample by sample what the decoder gives for that observation."""
    from kerv_cli.engine.decoder import Decoder

    target = load_target(demonstrated / "artifacts/target" / name)[0]
    dataset = DemoDataset.open(demonstrated / "artifacts/demos/few")
    taught, held = examples_of(target, dataset, SMALL)
    every = load_samples(dataset, target.settings, target.words, ("drawer-close-v3",))
    samples, unseen = split(every, 0.34)
    assert torch.equal(taught.episodes, samples.episodes)
    assert [bool(x) for x in taught.perturbed] == [dataset.episodes[e].perturbed for e in taught.episodes]
    decoder = Decoder(target)
    for i in range(0, len(samples), 7):
        prompt, _ = target.encode_batch(samples.where(torch.tensor([i])).inputs(target.device))
        assert taught.tokens[i].tolist() == decoder.decode_prompt(prompt).tokens
        assert torch.allclose(taught.features[i].float(), target.pooled(prompt)[0], atol=1e-2)
    assert torch.equal(held.episodes, unseen.episodes)
    calm = load_samples(dataset, target.settings, target.words, ("drawer-close-v3",), undisturbed_only=True)
    clean = torch.tensor([not one.perturbed for one in dataset.episodes])
    # numbered without gaps, so that some are held out
    assert torch.equal(torch.bincount(calm.episodes), torch.bincount(every.episodes)[clean])
    assert len(split(calm, 0.5)[1]) > 0
    few = examples_of(target, dataset, dataclasses.replace(SMALL, samples=12))
    assert 12 <= sum(map(len, few)) <= 18


def test_tokens_after_the_end_of_a_chunk_are_not_counted():
    """Chunks of a code differ in length: in training and in its figures, what is drafted after the end is nothing."""
    end, zeros = 6, torch.zeros(3, dtype=torch.long)
    tokens = torch.tensor([[1, 2, end, end, end], [end] * 5, [1, 2, 3, 4, end]])
    few = EarlyExamples(tokens, zeros, zeros.bool(), torch.zeros(3, 1))
    logits = torch.randn(3, 5, end + 1, generator=torch.Generator().manual_seed(0)).requires_grad_()
    within = within_chunk(tokens, end)
    assert within.sum(1).tolist() == [3, 1, 5]
    token_loss(logits, tokens, soft_labels(end + 1, 0.0), within).backward()
    assert torch.equal(logits.grad.abs().sum(-1) > 0, within)
    drafts = torch.tensor([[1, 2, end, 0, 0], [end, 1, 1, 1, 1], [1, 2, 0, 4, end]])
    found = measure(torch.nn.functional.one_hot(drafts, end + 1) * 9.0, few, torch.ones(5).bool(), end)
    assert found["accepted_strict"] == pytest.approx((3 + 1 + 2) / 3)
    assert found["whole_strict"] == pytest.approx(2 / 3)
    assert found["token_accuracy"] == pytest.approx((1 + 1 + 4 / 5) / 3)


@pytest.mark.bits
def test_a_saved_drafter_drafts_the_same_and_a_missing_one_says_what_to_run(tmp_path, policies):
    target, description = load_target(policies / "artifacts/target/nano-state")
    early = drafter(SMALL, target)
    early.standardise(torch.randn(20, target.pooled_width))
    with pytest.raises(CheckpointError, match="kerv train drafter drafter=early"):
        EarlyDrafter().load(tmp_path, of_target(description, target))
    EarlyDrafter().save(tmp_path, early, MadeFor.of(description), {}, settings=dataclasses.asdict(early.settings))
    loaded = EarlyDrafter().load(tmp_path, of_target(description, target))
    features = torch.randn(1, target.pooled_width)
    assert tokens_of(loaded, features, 0) == tokens_of(early, features, 0)
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"x")
    with pytest.raises(CheckpointError):
        EarlyDrafter().load(tmp_path, of_target(description, target))


def test_the_config_brings_its_own_optimisation_and_yields_to_the_command_line():
    assert compose("train_drafter", ["drafter=early"], TrainDrafterSettings).train.batch == 256
    assert compose("train_drafter", ["drafter=early", "train.batch=9"], TrainDrafterSettings).train.batch == 9
