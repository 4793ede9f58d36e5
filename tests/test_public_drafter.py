"""Drafters of the public EAGLE and Spec-VLA layout: what they compute, and their conventions."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from examples.tiny_openvla import write_checkpoint
from loaded import of_target
from safetensors.torch import load_file, save_file
from test_decoding_lossless import decode, plain_greedy
from test_openvla import imported, kerv, loaded, shown
from torch import Tensor

from kerv_cli.methods.eagle.drafter import DrafterProposer, EagleDrafter
from kerv_cli.methods.eagle.public import Convention, PublicDrafter, PublicShape
from kerv_cli.targets.checkpoint import read_target
from kerv_cli.targets.openvla.config import Language

LANGUAGE = Language(704, 64, 96, 1, 4)
KERV, TEXT, PROMPT = Convention(), Convention("text"), Convention(mask="prompt")
PATCHES = 16


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("public")
    imported(write_checkpoint(folder / "tiny"), folder)
    return folder


@pytest.fixture(scope="module")
def target(results):
    return loaded(results / "artifacts/target/openvla")


@pytest.fixture(scope="module")
def drafter():
    """Untrained: what is drafted does not matter to what these tests say."""
    torch.manual_seed(1)
    return PublicDrafter(PublicShape(LANGUAGE, True, KERV, PATCHES)).eval().requires_grad_(False)


def with_convention(drafter: PublicDrafter, convention: Convention) -> PublicDrafter:
    other = PublicDrafter(replace(drafter.shape, convention=convention))
    other.load_state_dict(drafter.state_dict())
    return other.eval().requires_grad_(False)


def written(folder: Path, drafter: PublicDrafter, embedding: Tensor) -> Path:
    """As the public codes save it, with a copy of the embeddings."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({**asdict(LANGUAGE), "model_type": "llama", "pad_token_id": 0}))
    save_file({**drafter.state_dict(), "embed_tokens.weight": embedding.clone()}, folder / "model.safetensors")
    return folder


@pytest.mark.bits
def test_it_computes_what_the_public_layer_does(target):
    """EAGLE's forward, spelt out with transformers' layer: fc over (embedding, state), no norm in front or behind."""
    from transformers import LlamaConfig
    from transformers.models.llama.modeling_llama import LlamaDecoderLayer, LlamaRotaryEmbedding

    torch.manual_seed(3)
    drafter = PublicDrafter(PublicShape(LANGUAGE, True, KERV, PATCHES)).eval().requires_grad_(False)
    numbers = {k: v for k, v in asdict(LANGUAGE).items() if k != "rope_theta"}
    config = LlamaConfig(**numbers, attn_implementation="eager")
    layer = LlamaDecoderLayer(config, 0).eval()
    own = {k.removeprefix("layers.0."): v for k, v in drafter.state_dict().items() if k.startswith("layers.0.")}
    layer.load_state_dict(own, strict=False)
    layer.input_layernorm = torch.nn.Identity()
    following, hidden = torch.randn(2, 1, 9, 64)
    positions = torch.arange(9)
    x = drafter.fc(torch.cat([following, hidden], -1))
    mask = torch.full((9, 9), -torch.inf).triu(1)[None, None]
    turned = LlamaRotaryEmbedding(config)(x, positions[None])
    out = layer(x, attention_mask=mask, position_ids=positions[None], position_embeddings=turned)
    reference = out[0] if isinstance(out, tuple) else out
    torch.testing.assert_close(drafter(following, hidden, positions), reference.view(1, 9, 64), atol=1e-5, rtol=1e-5)


@pytest.mark.bits
@pytest.mark.parametrize("convention", [KERV, TEXT, PROMPT, Convention("text", "prompt")])
@pytest.mark.parametrize("top_k", [1, 3])
def test_decoding_with_it_is_lossless_under_every_convention(target, drafter, convention, top_k):
    own = with_convention(drafter, convention)
    for seed in (100, 101):
        with torch.inference_mode():
            prompt = target.encode(shown(seed))
            truth = plain_greedy(target, prompt)
        assert decode(target, DrafterProposer(own, target, 5, top_k, 16), prompt).tokens == truth


def test_the_prompt_mask_hides_every_key_behind_the_prompt(drafter):
    own = with_convention(drafter, PROMPT)
    following, hidden = torch.randn(2, 1, 12, 64)
    outputs = []
    for _ in range(2):
        cache = own.new_cache(1, 20)
        own(following[:, :10], hidden[:, :10], torch.arange(10), cache)
        outputs.append(own(following[:, 11:], hidden[:, 11:], torch.tensor([11]), cache))
        hidden[:, 9] += 1  # the last prompt position: its key is the first that is hidden
    torch.testing.assert_close(outputs[0], outputs[1])


def test_it_is_imported_beside_its_target(results, target, drafter, tmp_path):
    folder = written(tmp_path / "eagle", drafter, target.model.language_model.model.embed_tokens.weight)
    words = [f"checkpoint={folder}", "policy.target=openvla", f"results={results}"]
    assert kerv("build", "drafter", *words, "positions=text")[0] == 0
    description = json.loads((results / "artifacts/drafter/openvla/drafter.json").read_text())
    assert description["public"]["convention"] == {"positions": "text", "mask": "causal"}
    described = read_target(results / "artifacts/target/openvla")
    described_target = of_target(described, target)
    own: Any = EagleDrafter().load(results / "artifacts/drafter/openvla", described_target)
    assert (own.draft_position(40), drafter.draft_position(40)) == (24, 40)
    for name, tensor in own.state_dict().items():
        torch.testing.assert_close(tensor, drafter.state_dict()[name])


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        ("rename", "1 missing: fc.weight; 1 unknown: fx.weight"),
        ("width", "the drafter in"),
        ("pickle", "is pickled and can run code when it is opened: convert it"),
        ("convention", "unknown positions 'whole': known: sequence, text"),
        ("nothing", "checkpoint=DIR"),
    ],
)
def test_a_drafter_that_does_not_fit_is_refused_in_one_line(results, target, drafter, tmp_path, harm, said):
    folder = written(tmp_path / "eagle", drafter, torch.zeros(704, 64))
    words = [f"checkpoint={folder}"]
    if harm == "rename":
        tensors = load_file(folder / "model.safetensors")
        renamed = {k.replace("fc.weight", "fx.weight"): v.clone() for k, v in tensors.items()}
        save_file(renamed, folder / "model.safetensors")
    elif harm == "width":
        (folder / "config.json").write_text(json.dumps({**asdict(LANGUAGE), "hidden_size": 128}))
    elif harm == "pickle":
        (folder / "model.safetensors").unlink()
        torch.save({}, folder / "pytorch_model.bin")
    elif harm == "convention":
        words.append("positions=whole")
    else:
        words = []
    code, line = kerv("build", "drafter", *words, "policy.target=openvla", f"results={results}")
    assert code in (1, 2)
    assert said in line
