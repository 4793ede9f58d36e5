"""A tiny random checkpoint in exactly the published layout: names, files, tokenizer, statistics. For tests and for a
first look without 15 GB:

    PYTHONPATH=tests python -m examples.tiny_openvla DIR
    kerv build target target=openvla checkpoint=DIR
"""

from __future__ import annotations

import sys
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kerv_cli.base.errors import KervError
from kerv_cli.base.files import write_json
from kerv_cli.targets.checkpoint import save_tensors
from kerv_cli.targets.openvla.config import CONFIG, SHAPES, STATISTICS, Language, Shape, Tower
from kerv_cli.targets.openvla.inputs import BEGIN, BOUNDARY, DEFAULTS, PREPROCESSOR, TOKENIZER
from kerv_cli.targets.openvla.loading import Sizes, layout

TINY = Shape(
    towers=(Tower(32, 4, 2, 64, registers=4, scaled=True, image=56), Tower(48, 3, 3, 80, image=56)),
    language=Language(704, 64, 96, 3, 4),
)
"""16 patches; a trunk of 3 layers and 64 channels."""

WORDS = tuple(f"{BOUNDARY}{word}" for word in ["What", "action", "should", "robot", "take"])
"""Words with a token of their own, so that a prompt is not one token per letter."""

ROBOT: dict[str, Any] = {
    "q01": [-0.03, -0.04, -0.04, -0.08, -0.09, -0.2, 0.0],
    "q99": [0.03, 0.04, 0.04, 0.08, 0.09, 0.2, 1.0],
    "mask": [True] * 6 + [False],
}


def write_checkpoint(folder: Path, shape: Shape = TINY, seed: int = 0) -> Path:
    """Write the checkpoint in two files, and return `folder`.

    Raises:
        StorageError: If writing failed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / CONFIG, config_of(shape))
    write_json(folder / STATISTICS, {"tiny": {"action": ROBOT}})
    normalise = [{"inplace": False, "mean": list(n.mean), "std": list(n.std)} for n in DEFAULTS]
    write_json(folder / PREPROCESSOR, {"image_resize_strategy": "resize-naive", "tvf_normalize_params": normalise})
    (folder / TOKENIZER).write_text(tokenizer_json(shape.vocabulary), encoding="utf-8")
    tensors = random_tensors(shape, seed)
    names = list(tensors)
    for number in range(2):
        file = f"model-{number + 1:05d}-of-00002.safetensors"
        save_tensors(folder / file, {name: tensors[name] for name in names[number::2]}, {"format": "pt"})
    return folder


def config_of(shape: Shape) -> dict[str, Any]:
    """The contents of config.json."""
    return {
        "model_type": "openvla",
        "architectures": ["OpenVLAForActionPrediction"],
        "use_fused_vision_backbone": True,
        "image_resize_strategy": "resize-naive",
        "image_sizes": [tower.image for tower in shape.towers],
        "n_action_bins": shape.bins,
        "pad_to_multiple_of": shape.padding,
        "text_config": {"model_type": "llama", **asdict(shape.language)},
        SHAPES: [asdict(tower) for tower in shape.towers],
    }


def random_tensors(shape: Shape, seed: int) -> dict[str, Tensor]:
    """Seeded weights that keep activations of order one, so that tokens depend on image and instruction; a tensor's
    follow from its name, in whatever order names are listed. The head's rows of the action tokens are the longest: the
    greedy token over all ids is an action."""
    tensors = {name: _random(name, sizes, seed) for name, sizes in layout(shape).items()}
    head = tensors["language_model.lm_head.weight"]
    head[: shape.vocabulary - shape.bins] *= 0.1
    head[shape.vocabulary :] *= 0.1
    return tensors


def _random(name: str, sizes: Sizes, seed: int) -> Tensor:
    drawn = torch.randn(sizes, generator=torch.Generator().manual_seed(zlib.crc32(f"{seed} {name}".encode())))
    if "norm" in name and name.endswith("weight"):
        return 1 + 0.1 * drawn
    if name.endswith(("bias", "scale_factor")):
        return 0.1 * drawn + (0.5 if name.endswith("scale_factor") else 0.0)
    if len(sizes) == 2 and "embed" not in name:
        return 2.0 * drawn / sizes[1] ** 0.5
    return drawn / (drawn[0].numel() ** 0.5) if len(sizes) == 4 else drawn


def tokenizer_json(size: int) -> str:
    """A tokenizer.json of `size` ids built like Llama's: bytes, characters, word boundaries as tokens of their own."""
    try:
        from tokenizers import Tokenizer, decoders, models, normalizers, processors
    except ImportError as error:
        raise KervError("the tokenizer is written by the package tokenizers: pip install 'kerv[openvla]'") from error
    pieces = ["<unk>", BEGIN, "</s>", *(f"<0x{byte:02X}>" for byte in range(256)), BOUNDARY]
    pieces += [chr(code) for code in range(33, 127)]
    merges = [(word[:end], word[end]) for word in WORDS for end in range(1, len(word))]
    pieces += [first + second for first, second in merges]
    pieces += [f"{BOUNDARY}unused{number}" for number in range(size - len(pieces))]
    vocabulary = {piece: number for number, piece in enumerate(pieces)}
    tokenizer = Tokenizer(models.BPE(vocab=vocabulary, merges=merges, unk_token="<unk>", byte_fallback=True))
    tokenizer.normalizer = normalizers.Sequence([normalizers.Prepend(BOUNDARY), normalizers.Replace(" ", BOUNDARY)])
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{BEGIN} $A", special_tokens=[(BEGIN, vocabulary[BEGIN])]
    )
    tokenizer.decoder = decoders.ByteFallback()
    text: str = tokenizer.to_str()
    return text


if __name__ == "__main__":
    print(write_checkpoint(Path(sys.argv[1])))
