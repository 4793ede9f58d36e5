"""Find the shape of a policy from a number of weights, a Hugging Face `config.json` or a target of kerv.

This module needs no torch.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import read_mapping
from kerv_cli.base.paths import as_path, find_target
from kerv_cli.bench.physics import INSTRUCTION, SHAPES, Shape, encoder_of, encoder_of_weights, openvla, vla_shape
from kerv_cli.bench.settings import EstimateSettings
from kerv_cli.targets.openvla.config import TOWERS, Language, Tower, read_shape
from kerv_cli.targets.settings import prompt_tokens

PUBLISHED = {
    "SmolLM2-135M": (0.135e9, 30, 49_152),
    "SmolLM2-360M": (0.362e9, 32, 49_152),
    "TinyLlama-1.1B": (1.03e9, 22, 32_000),
    "OpenLLaMA-3B": (3.32e9, 26, 32_000),
    "Llama-2-7B": (6.61e9, 32, 32_000),
    "Llama-2-13B": (12.9e9, 40, 32_000),
    "Llama-2-70B": (68.7e9, 80, 32_000),
}
"""Published language models. For each: weights of layers and head, number of layers, size of the vocabulary."""

SMALL = 50e6
"""A policy with fewer weights is assumed to have 8 layers and only 256 action tokens, like kerv's own policies."""

_PATCHES = TOWERS["vit_so400m_patch14_siglip_224"].patches
_SHARE = 0.1  # of the weights are the vision encoder's, as in OpenVLA-7B
_UNITS = {"": 1.0, "K": 1e3, "M": 1e6, "B": 1e9, "G": 1e9}
_CONTINUOUS = ("act", "diffusion", "groot", "pi0", "pi05", "smolvla", "tdmpc", "vqbet", "xvla")


@dataclass(frozen=True)
class Described:
    """What the cost of a policy's decodes depends on.

    Attributes:
        shape: Shape of the policy. None if the policy emits no action tokens.
        tokens: N, tokens of a chunk. 0 if the policy emits no action tokens.
        assumed: Assumptions about the policy, one phrase each.
        encoder: Seconds that the vision encoder takes for one observation, if the user states them (`vision=8ms`). None
            if they are computed from the shape.
    """

    shape: Shape | None
    tokens: int
    assumed: tuple[str, ...] = ()
    encoder: float | None = None


def described(settings: EstimateSettings) -> Described:
    """Return the policy that the settings describe.

    Raises:
        UsageError: The policy is described twice or not at all, `weights` or `vision` is no number, or there is no such
            model.
        CheckpointError: The model's file is damaged.
    """
    if settings.tokens == 0:
        return Described(None, 0)
    if bool(settings.weights) == bool(settings.model):
        raise UsageError("name the policy by one of weights=7B and model=PATH, or its costs by on=PROFILE")
    policy = _of_weights(settings) if settings.weights else _of_model(settings)
    if policy.shape is None:
        return policy
    sizes = replace(policy.shape.sizes, weight=settings.bits / 8)
    shape, encoder = replace(policy.shape, sizes=sizes), None
    if settings.prompt is not None:
        shape = replace(shape, prompt=settings.prompt)
    if settings.vision.endswith("ms"):
        encoder = number_of("vision", settings.vision.removesuffix("ms")) / 1e3
    elif settings.vision and not settings.weights:
        needs = encoder_of_weights(number_of("vision", settings.vision), _PATCHES)
        shape = replace(shape, parts={**shape.parts, "encode": needs})
    tokens = policy.tokens if settings.tokens is None else settings.tokens
    return Described(shape, tokens, policy.assumed, encoder)


def number_of(name: str, text: str) -> float:
    """Return the number that a text such as `7B`, `450M` or `3.5e9` states.

    Args:
        name: Name of the setting, for the error message.
        text: The text.

    Raises:
        UsageError: The text is not a number, or the number is below 0.
    """
    match = re.fullmatch(r"(\d+(?:\.\d*)?(?:[eE]\+?\d+)?)([KMBG]?)", text.strip(), re.IGNORECASE)
    if match is None:
        raise UsageError(f"{name}={text}: write a number such as 7B, 450M or 4600000", name)
    return float(match[1]) * _UNITS[match[2].upper()]


def language_of(weights: float) -> Language:
    """Return the shape of a Llama whose layers and head have about this many weights.

    The number of layers and the vocabulary are interpolated between the next smaller and the next larger published
    model, on a logarithmic scale. Below SMALL weights they are fixed. A layer's feed-forward part is 8/3 as wide as its
    hidden states, as in Llama. The width of the hidden states follows from the number of weights.
    """
    sizes, layers, vocabularies = np.array([*PUBLISHED.values()]).T
    at = math.log(weights)
    depth = round(float(np.interp(at, np.log(sizes), layers))) if weights >= SMALL else 8
    vocabulary = round(float(np.interp(at, np.log(sizes), vocabularies))) if weights >= SMALL else 256
    # weights = depth · 12 · width² + vocabulary · width
    width = round((math.sqrt(vocabulary**2 + 48 * depth * weights) - vocabulary) / (24 * depth))
    return Language(vocabulary, max(width, 1), max(round(8 / 3 * width), 1), depth, 1)


def _of_weights(settings: EstimateSettings) -> Described:
    total = number_of("weights", settings.weights)
    given = settings.vision and not settings.vision.endswith("ms")
    vision = number_of("vision", settings.vision) if given else _SHARE * total
    if total - vision < 9e4:
        least = f"the encoder alone has {vision:.3g}" if given else "at least 100K are needed"
        raise UsageError(f"weights={settings.weights}, vision={settings.vision or 'unknown'}: {least}", "weights")
    language, prompt = language_of(total - vision), _PATCHES + INSTRUCTION
    shape = vla_shape(f"{settings.weights} weights", language, prompt, encoder_of_weights(vision, _PATCHES))
    assumed = [f"{language.num_hidden_layers} layers, {language.hidden_size} wide, {language.vocab_size} ids"]
    assumed += [] if given or settings.vision else [f"{vision / 1e6:.3g} M of the weights are the vision encoder's"]
    return Described(shape, 7, (*assumed, *_prompt(settings, prompt)))


def _prompt(settings: EstimateSettings, prompt: int) -> list[str]:
    return [f"a prompt of {prompt} tokens"] if settings.prompt is None else []


def _of_model(settings: EstimateSettings) -> Described:
    """Return the policy of `settings.model`: a shape's name, a `config.json`, its folder, or a target of kerv.

    Raises:
        UsageError: There is no such target, or its description states no width.
        CheckpointError: The file does not describe a policy.
    """
    name = settings.model
    if name in SHAPES:
        return Described(SHAPES[name], 7)
    path = as_path(name)
    file = path / "config.json" if path.is_dir() and not (path / "target.json").is_file() else path
    if not file.is_file():
        file = (path if (path / "target.json").is_file() else find_target(settings.results, name)) / "target.json"
    value = read_mapping(file)
    try:
        return _of_target(value, file.parent) if file.name == "target.json" else _of_config(settings, value, file)
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{file} does not describe a policy ({error}): give weights= instead") from error


def _of_config(settings: EstimateSettings, config: Mapping[str, Any], file: Path) -> Described:
    """Return the policy of a Hugging Face `config.json`."""
    if config.get("model_type") == "openvla":
        read = read_shape(file.parent)
        return Described(openvla("openvla", read.language, read.towers), 7)
    texts = config.get("language_config"), config.get("llm_config"), config.get("text_config"), config
    text = next((one for one in texts if one and "vocab_size" in one and "hidden_size" in one), None)
    if text is None or config.get("type") in _CONTINUOUS:
        return Described(None, 0)
    width, heads = _size(text, "hidden_size"), _size(text, "num_attention_heads", 1)
    language = Language(
        _size(text, "vocab_size"),
        width,
        _size(text, "intermediate_size", 8 * width // 3),
        _size(text, "num_hidden_layers", 32),
        heads,
        _size(text, "num_key_value_heads", heads),
    )
    vision, assumed, prompt = config.get("vision_config") or {}, [], _PATCHES + INSTRUCTION
    if {"hidden_size", "num_hidden_layers"} <= set(vision):
        wide = _size(vision, "hidden_size")
        blocks, heads = _size(vision, "num_hidden_layers"), _size(vision, "num_attention_heads", 1)
        sides = _size(vision, "image_size", 224), _size(vision, "patch_size", 14)
        # one block more, because OpenVLA's towers do not use their last
        tower = Tower(wide, blocks + 1, heads, _size(vision, "intermediate_size", 4 * wide), 0, False, *sides)
        encoder, prompt = encoder_of([tower], language.hidden_size), tower.patches + INSTRUCTION
    else:
        encoder = SHAPES["openvla-7b"].parts["encode"]
        assumed = [] if settings.vision else ["the vision encoder of OpenVLA-7B"]
    shape = vla_shape(file.parent.name, language, prompt, encoder)
    return Described(shape, 7, (*assumed, *_prompt(settings, prompt)))


def _size(fields: Mapping[str, Any], key: str, default: int | None = None) -> int:
    """Return the size `key` of a `config.json`, or `default` if the file does not state the size.

    Raises:
        TypeError: The size is missing and has no default, or is a list or mapping.
        ValueError: The size is below 1, or a text that is not a whole number.
    """
    size = int(fields.get(key, default))
    if size < 1:
        raise ValueError(f"{key}={size}")
    return size


def _of_target(target: Mapping[str, Any], folder: Path) -> Described:
    """Return the policy that a target's description describes.

    Args:
        target: Content of the `target.json`.
        folder: Folder of the target.

    Raises:
        UsageError: The description states no width.
    """
    if target.get("family") == "openvla":
        read = read_shape(Path(target["settings"]["checkpoint"]))
        return Described(openvla(folder.name, read.language, read.towers), 7)
    own = target.get("settings", {})
    if not {"width", "layers", "feed_forward", "chunk"} <= set(own):
        raise UsageError(f"model={folder}: the family '{target.get('family')}' states no width: give weights=", "model")
    trunk = {**own, **own.get("grown", {})}
    actions, size = target["actions"], int(own["image_size"]) if own.get("observation") != "state" else 0
    tokens = int(own["chunk"]) * len(actions["names"])
    views = len(target["cameras"]) if size else 0
    width, wide, layers, heads = map(int, itemgetter("width", "feed_forward", "layers", "heads")(trunk))
    language = Language(int(actions["bins"]), width, wide, layers, heads)
    stored = (folder / "model.safetensors").stat().st_size / 2 if (folder / "model.safetensors").is_file() else 0
    small = own["layers"] * (4 * own["width"] ** 2 + 3 * own["width"] * own["feed_forward"])
    encoder = encoder_of_weights(max(stored - small, 1e6 * views), max(own["grid"] ** 2 * views, 1))
    name = folder.parent.name if folder.name == "target" else folder.name
    return Described(vla_shape(name, language, prompt_tokens(target) or 1, encoder), tokens)
