"""The OpenVLA target on tiny random checkpoints: equal to transformers' own models, lossless."""

import io
import itertools
import json
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command import kerv, refusal
from examples.tiny_openvla import ROBOT, TINY, write_checkpoint
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from openvla_reference import Reference
from PIL import Image
from safetensors.torch import load_file, save_file
from scipy.ndimage import map_coordinates
from test_decoding_lossless import RandomTrees, assert_adds_up, plain_greedy
from torch import Tensor

from kerv_cli.base.errors import KervError
from kerv_cli.base.paths import artifact
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.targets.checkpoint import load_target
from kerv_cli.targets.openvla.config import TOWERS, Bounds, Shape, action_space, read_shape
from kerv_cli.targets.openvla.inputs import as_in_libero, cropped, pixels_of
from kerv_cli.targets.openvla.loading import is_unread, layout
from kerv_cli.targets.openvla.target import OpenVLATarget, import_checkpoint
from kerv_cli.targets.settings import BuildTargetSettings


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return write_checkpoint(tmp_path_factory.mktemp("openvla") / "tiny")


def imported(checkpoint: Path, results: Path, **chosen: Any) -> Path:
    options = {"prompt_tokens": 120, **chosen}
    settings = BuildTargetSettings(checkpoint=str(checkpoint), results=str(results), **options)
    folder = artifact(str(results), "target", settings.name)
    import_checkpoint(settings, folder)
    return folder


def loaded(folder: Path, dtype: torch.dtype = torch.float32) -> OpenVLATarget:
    target = load_target(folder, dtype=dtype)[0]
    assert isinstance(target, OpenVLATarget)
    return target


@pytest.fixture(scope="module")
def target(checkpoint, tmp_path_factory):
    return loaded(imported(checkpoint, tmp_path_factory.mktemp("results")))


def shown(seed: int, instruction: str = "pick up the cup") -> Observation:
    image = np.random.default_rng(seed).integers(0, 256, (40, 64, 3), dtype=np.uint8)
    return Observation(np.zeros(0), np.zeros(0), instruction, {"primary": image})


# --- the published layout


def published() -> dict[str, Any]:
    """The shape card of openvla/openvla-7b: `config`, `sizes` (its widths, layers and heads), `total_size` (bytes in
    bfloat16) and `tensors`, name -> shape; {0..23} in a name stands for all numbers from 0 to 23."""
    card: dict[str, Any] = json.loads(Path(__file__).with_name("fixtures").joinpath("openvla-7b.json").read_text())
    tensors = {}
    for pattern, sizes in card["tensors"].items():
        spans = [range(int(a), int(b) + 1) for a, b in re.findall(r"\{(\d+)\.\.(\d+)\}", pattern)]
        form = re.sub(r"\{.*?\}", "{}", pattern)
        tensors |= {form.format(*numbers): tuple(sizes) for numbers in itertools.product(*spans)}
    return {**card, "tensors": tensors}


def test_the_layout_and_the_shape_are_those_of_the_published_checkpoint(tmp_path):
    card = published()
    first, second = TOWERS.values()
    shape = Shape((first, second))
    (tmp_path / "config.json").write_text(json.dumps(card["config"]))
    assert read_shape(tmp_path) == shape
    assert layout(shape) == {name: sizes for name, sizes in card["tensors"].items() if not is_unread(name, shape)}
    assert 2 * sum(math.prod(sizes) for sizes in card["tensors"].values()) == card["total_size"]
    language = shape.language
    sizes = {"width": language.hidden_size, "layers": language.num_hidden_layers, "vocabulary": language.vocab_size}
    assert sizes.items() <= card["sizes"].items()


# --- equal to transformers' own models, composed as OpenVLA composes them


def generated_by(reference: Reference, pixels: torch.Tensor, ids: list[int], count: int) -> tuple[list[int], Tensor]:
    """Greedy over *all* ids -> `count` ids and the logits before each (count, ids)."""
    tokens: list[int] = []
    for _ in range(count):
        logits = reference.logits(pixels, ids, tokens)
        tokens.append(int(logits[-1].argmax()))
    return tokens, logits


def reference_pixels(image: np.ndarray, size: int) -> torch.Tensor:
    """The published preprocessing, spelt out: PIL's bicubic, [0, 1], two normalisations."""
    resized = np.asarray(Image.fromarray(image).resize((size, size), Image.Resampling.BICUBIC)) / 255.0
    normalised = [
        (resized - [0.484375, 0.455078125, 0.40625]) / [0.228515625, 0.2236328125, 0.224609375],
        (resized - 0.5) / 0.5,
    ]
    return torch.from_numpy(np.concatenate([x.transpose(2, 0, 1) for x in normalised]))[None].float()


def published_action(ids: list[int], vocabulary: int) -> np.ndarray:
    """Published code's way from generated ids to actions."""
    edges = np.linspace(-1, 1, 256)
    centres = (edges[:-1] + edges[1:]) / 2.0
    normalised = centres[np.clip(vocabulary - np.array(ids) - 1, 0, len(centres) - 1)]
    low, high, mask = (np.array(ROBOT[key]) for key in ("q01", "q99", "mask"))
    return np.where(mask, 0.5 * (normalised + 1) * (high - low) + low, normalised)


@pytest.mark.bits
def test_logits_and_actions_equal_transformers(checkpoint, target):
    reference, worst = Reference(checkpoint), 0.0
    for seed, words in enumerate(("pick up the cup", "Put the spoon on the towel", "open")):
        observation = shown(seed, words)
        record = Decoder(target).decode(observation)
        text = f"In: What action should the robot take to {words.lower()}?\nOut:"
        ids = [*target.prompter.tokenizer.encode(text).ids, target.prompter.boundary]
        assert target.prompter.ids(words) == ids
        generated, logits = generated_by(reference, reference_pixels(observation.images["primary"], 56), ids, 7)
        with torch.inference_mode():
            prompt = target.encode(observation)
            x = torch.cat([prompt, target.embed(torch.tensor([record.tokens[:-1]]))], 1)
            hidden = target.forward(x, torch.arange(x.shape[1]))
            own = target.head(hidden[0, prompt.shape[1] - 1 :])
        theirs = logits[:, TINY.vocabulary - 256 : TINY.vocabulary].flip(-1)
        worst = max(worst, float((own - theirs).abs().max()))
        assert [TINY.vocabulary - 1 - token for token in record.tokens] == generated
        np.testing.assert_allclose(record.actions[0], published_action(generated, TINY.vocabulary), atol=1e-6)
    assert worst < 1e-4


@given(value=st.floats(-1.2, 1.2) | st.sampled_from([-1.0, 1.0]))
def test_tokens_are_those_of_the_published_tokenizer(value):
    space = action_space(TINY, Bounds((-1.0,) * 7, (1.0,) * 7), None, 5.0)
    number = int(np.digitize(np.clip(value, -1.0, 1.0), np.linspace(-1, 1, 256)))  # published: id = vocabulary − number
    token = int(space.bins_of(np.array(np.clip(value, -1.0, 1.0))))
    assert TINY.vocabulary - 1 - token == TINY.vocabulary - number
    assert space.tokens == 256
    assert abs(space.values_of(np.array(token)) - np.clip(value, -1, 1)) <= 1 / 255 + 1e-9


def lanczos(pixels: np.ndarray, size: int) -> np.ndarray:
    """pixels (n, m, 3) -> (size, m, 3): windowed sinc of three lobes, widened when it shrinks (ScaleAndTranslate of
    TensorFlow's resize with antialias)."""
    n = len(pixels)
    scale = max(1.0, n / size)
    at = (np.arange(size) + 0.5) * n / size
    x = (np.arange(n) + 0.5 - at[:, None]) / scale
    weights = np.where(abs(x) < 3, np.sinc(x) * np.sinc(x / 3), 0.0)
    return np.tensordot(weights / weights.sum(1, keepdims=True), pixels, 1)


def test_a_frame_is_prepared_as_in_openvlas_evaluation_on_libero():
    smooth = np.linspace(40, 200, 64)[:, None, None] + np.array([0.0, 20.0, -30.0]) + np.zeros((64, 64, 3))
    image = smooth.round().astype(np.uint8)
    expected = lanczos(lanczos(smooth, 56).swapaxes(0, 1), 56).swapaxes(0, 1)
    prepared = as_in_libero(image, 56)
    assert prepared.shape == (56, 56, 3)
    assert np.abs(prepared - expected).max() < 4  # JPEG's own error on a smooth frame
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(noise).save(file, "JPEG", quality=95, subsampling=2)
    read = np.asarray(Image.open(file)).astype(float)
    assert np.abs(read - noise).mean() > 10  # colour at half resolution does not survive as noise
    expected = np.clip(lanczos(lanczos(read, 56).swapaxes(0, 1), 56).swapaxes(0, 1).round(), 0, 255)
    assert np.abs(as_in_libero(noise, 56) - expected).max() <= 1


def test_the_crop_is_tensorflows(target):
    image = np.random.default_rng(3).integers(0, 256, (90, 61, 3), dtype=np.uint8)
    rows, columns = ((n - 1) * (0.5 + math.sqrt(0.9) * np.linspace(-0.5, 0.5, 56)) for n in image.shape[:2])
    floats = map_coordinates(image / 255, np.meshgrid(rows, columns, range(3), indexing="ij"), order=1)
    expected = np.clip(np.floor(floats * 255.5), 0, 255)
    assert np.abs(cropped(image, 56).astype(float) - expected).max() <= 1  # a sum at the edge of a grey level
    assert (cropped(image, 56) == expected).mean() > 0.999
    whole, part = (pixels_of(image, TINY, target.normalisations, crop) for crop in (False, True))
    assert whole.shape == part.shape == (1, 6, 56, 56)
    assert not torch.allclose(whole, part)


# --- the engine: lossless at D = 7, N = 7


@pytest.mark.bits
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 10_000), nodes=st.integers(0, 24), inside=st.booleans(), fixed=st.booleans())
def test_strict_decoding_equals_ar(target, monkeypatch, seed, nodes, inside, fixed):
    monkeypatch.setattr(target, "new_cache", lambda batch, size: OpenVLATarget.new_cache(target, batch, size, fixed))
    with torch.inference_mode():
        prompt = target.encode(shown(seed, "move " * (1 + seed % 9)))
        truth = plain_greedy(target, prompt)
    trees = RandomTrees(truth, seed, nodes, target.actions.tokens)
    first = RandomTrees(truth, seed + 1, nodes, target.actions.tokens) if inside else None
    result = Decoder(target, Parts(prefill_draft=first, proposer=trees)).decode_prompt(prompt)
    assert result.tokens == truth
    assert result.size == 7
    assert_adds_up(result)


# --- formats of the weights


def test_bfloat16_decodes_nearly_the_same(checkpoint, tmp_path, target):
    half = loaded(imported(checkpoint, tmp_path), torch.bfloat16)
    prompt = target.encode(shown(1))
    with torch.inference_mode():
        positions = torch.arange(prompt.shape[1])
        right = target.head(target.forward(prompt, positions)[0, -1])
        got = half.head(half.forward(half.encode(shown(1)), positions)[0, -1]).float()
    assert float(torch.corrcoef(torch.stack([right, got]))[0, 1]) > 0.99


# --- bad input: one line


def edited(checkpoint: Path, tmp_path: Path, file: str, **changes: Any) -> Path:
    copy = Path(shutil.copytree(checkpoint, tmp_path / "copy"))
    value = json.loads((copy / file).read_text())
    (copy / file).write_text(json.dumps({**value, **changes}))
    return copy


def test_an_import_is_a_target_like_any_other(checkpoint, tmp_path):
    words = [f"checkpoint={checkpoint}", "name=vla", "environment=insertion", "prompt_tokens=120"]
    kerv("build", "target", "target=openvla", *words, f"results={tmp_path}")
    run = ["rollout", "method=ar", "policy.target=vla", "episodes=1", "record=0", "world.camera.size=56"]
    kerv(*run, "task=insert-peg", "world.horizon=2", f"results={tmp_path}")
    line = refusal(*run, "task=reach", f"results={tmp_path}", code=1)
    assert "action space with names dx, dy, dz, droll, dpitch, dyaw, gripper, environment metaworld one with" in line


@pytest.mark.parametrize(
    ("changes", "words", "said"),
    [
        ({}, ["checkpoint=/nowhere"], "no config.json in /nowhere"),
        ({}, ["checkpoint="], "checkpoint=DIR"),
        ({"config.json": {"model_type": "llava"}}, [], "llava"),
        ({"config.json": {"text_config": {"num_key_value_heads": 2}}}, [], "num_key_value_heads=2"),
        ({"config.json": {"pad_to_multiple_of": 0}}, [], "has 640 ids, the weights are for 704"),
        ({"dataset_statistics.json": {"b": {"action": ROBOT}}}, [], "choose with statistics=NAME"),
        ({"dataset_statistics.json": {"tiny": {"action": {**ROBOT, "q01": [0.0]}}}}, [], "another robot"),
        ({"dataset_statistics.json": {"tiny": {"action": {"q01": ["x"]}}}}, [], "damaged"),
        ({}, ["statistics=bridge"], "unknown statistics 'bridge'"),
        ({}, ["environment=metaworld"], "are of 7 DoFs, the action space has 4"),
        ({}, ["environment=libero"], "its gripper closes with 1, OpenVLA's with 0: leave it out"),
        ({}, ["family=compact"], "others are trained"),
        ({}, ["prompt_tokens=3"], "at most 3 are taken"),
        ({"preprocessor_config.json": {"image_resize_strategy": "letterbox"}}, [], "letterbox"),
    ],
)
def test_an_import_refuses_in_one_line(checkpoint, tmp_path, changes, words, said):
    for file, values in changes.items():
        checkpoint = edited(checkpoint, tmp_path, file, **values)
    words = words if "checkpoint" in "".join(words) else [f"checkpoint={checkpoint}", *words]
    assert said in refusal("build", "target", *words, f"results={tmp_path}")


NORM = "language_model.model.norm.weight"


def rewritten(change: Callable[[dict[str, Tensor]], None]) -> Callable[[Path], None]:
    """Changes the tensors of the file of a checkpoint that holds the last norm."""

    def harm(folder):
        shard = next(path for path in folder.glob("*.safetensors") if NORM in load_file(path))
        tensors = {name: tensor.clone() for name, tensor in load_file(shard).items()}
        change(tensors)
        save_file(tensors, shard)

    return harm


def truncated(folder: Path) -> None:
    shard = next(folder.glob("*.safetensors"))
    shard.write_bytes(shard.read_bytes()[:-100])


def pickled(folder: Path) -> None:
    for path in folder.glob("model*"):
        path.unlink()
    torch.save({"x": torch.zeros(1)}, folder / "pytorch_model.bin")


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (truncated, "cut short"),
        (rewritten(lambda tensors: tensors.update(norm=tensors.pop(NORM))), "2 are missing, unknown or of another"),
        (rewritten(lambda tensors: tensors[NORM].fill_(math.nan)), f"numbers in {NORM} that are not finite"),
        (pickled, "holds pickled weights (pytorch_model.bin)"),
        (lambda folder: (folder / "tokenizer.json").unlink(), "no tokenizer.json in"),
    ],
)
def test_damaged_files_are_refused_in_one_line(checkpoint, tmp_path, harm, said):
    copy = edited(checkpoint, tmp_path, "config.json")
    harm(copy)
    assert said in refusal("build", "target", f"checkpoint={copy}", f"results={tmp_path}", code=1)


def test_weights_that_changed_after_the_import_are_refused(checkpoint, tmp_path):
    copy = edited(checkpoint, tmp_path, "config.json")
    imported(copy, tmp_path)
    run = ["rollout", "method=ar", "task=insert-peg", "policy.target=openvla", f"results={tmp_path}"]
    save_file({"x": torch.zeros(1)}, copy / "model-00001-of-00002.safetensors")
    assert f"no longer in {copy}" in refusal(*run)
    shutil.rmtree(copy)
    assert f"no longer in {copy}" in refusal(*run)


def test_an_instruction_that_is_too_long_is_refused(target):
    images = {"primary": np.zeros((56, 56, 3), np.uint8)}
    with pytest.raises(KervError):
        target.encode(Observation(np.zeros(0), np.zeros(0), "turn " * 90, images))
