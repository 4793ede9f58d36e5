"""The tensors of a Hugging Face OpenVLA checkpoint: every name and shape, from the numbers of its config.

`openvla-7b.json` holds the published names and shapes of openvla/openvla-7b as they are, for comparison; the tests
check that both agree, and that their bytes add up to the `total_size` of the published index (15 082 474 368).
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator, Mapping
from importlib.resources import files
from typing import Any

from kerv_cli.targets.openvla.config import Language, Shape, Tower

Sizes = tuple[int, ...]
_RANGE = re.compile(r"\{(\d+)\.\.(\d+)\}")  # {0..23}: all numbers from 0 to 23


def layout(shape: Shape) -> dict[str, Sizes]:
    """Name -> shape of every tensor of a checkpoint."""
    first, second = shape.towers
    width, hidden = shape.vision_width, shape.language.hidden_size
    tensors = dict(_tower("vision_backbone.featurizer", first))
    tensors |= _tower("vision_backbone.fused_featurizer", second)
    tensors |= _linear("projector.fc1", width, 4 * width) | _linear("projector.fc2", 4 * width, hidden)
    return {**tensors, **_linear("projector.fc3", hidden, hidden), **_language("language_model", shape.language)}


def unread(name: str, shape: Shape) -> bool:
    """Whether a tensor is part of a checkpoint but of no output: the last block of each vision tower, the norm behind
    it and SigLIP's pooling head."""
    for prefix, tower in zip(("featurizer", "fused_featurizer"), shape.towers, strict=True):
        heads = (f"blocks.{tower.depth - 1}.", "norm.", "attn_pool.")
        if name.startswith(tuple(f"vision_backbone.{prefix}.{head}" for head in heads)):
            return True
    return False


def published() -> dict[str, Any]:
    """The shape card of openvla/openvla-7b: `config`, `sizes` (its widths, layers and heads), `total_size` (bytes in
    bfloat16) and `tensors`, name -> shape."""
    text = files(__package__).joinpath("openvla-7b.json").read_text(encoding="utf-8")
    card: dict[str, Any] = json.loads(text)
    card["tensors"] = dict(_expanded(card["tensors"]))
    return card


def _expanded(patterns: Mapping[str, list[int]]) -> Iterator[tuple[str, Sizes]]:
    for pattern, sizes in patterns.items():
        spans = [range(int(a), int(b) + 1) for a, b in _RANGE.findall(pattern)]
        form = _RANGE.sub("{}", pattern)
        for numbers in itertools.product(*spans):
            yield form.format(*numbers), tuple(sizes)


def _linear(name: str, inputs: int, outputs: int) -> dict[str, Sizes]:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def _norm(name: str, width: int) -> dict[str, Sizes]:
    return {f"{name}.weight": (width,), f"{name}.bias": (width,)}


def _tower(prefix: str, tower: Tower) -> Iterator[tuple[str, Sizes]]:
    width = tower.width
    if tower.scaled:
        yield f"{prefix}.cls_token", (1, 1, width)
        yield f"{prefix}.reg_token", (1, tower.registers, width)
    yield f"{prefix}.pos_embed", (1, tower.patches, width)
    yield f"{prefix}.patch_embed.proj.weight", (width, 3, tower.patch, tower.patch)
    yield f"{prefix}.patch_embed.proj.bias", (width,)
    for number in range(tower.depth):
        block = f"{prefix}.blocks.{number}"
        yield from (_norm(f"{block}.norm1", width) | _norm(f"{block}.norm2", width)).items()
        yield from _linear(f"{block}.attn.qkv", width, 3 * width).items()
        yield from _linear(f"{block}.attn.proj", width, width).items()
        yield from _linear(f"{block}.mlp.fc1", width, tower.feed_forward).items()
        yield from _linear(f"{block}.mlp.fc2", tower.feed_forward, width).items()
        if tower.scaled:
            yield from ((f"{block}.{scale}.scale_factor", (width,)) for scale in ("ls1", "ls2"))
    yield from _norm(f"{prefix}.norm", width).items()
    if tower.pooled:
        yield from _pooling(f"{prefix}.attn_pool", tower)


def _pooling(prefix: str, tower: Tower) -> Iterator[tuple[str, Sizes]]:
    width = tower.width
    yield f"{prefix}.latent", (1, 1, width)
    for name, outputs in (("q", width), ("kv", 2 * width), ("proj", width)):
        yield from _linear(f"{prefix}.{name}", width, outputs).items()
    yield from _norm(f"{prefix}.norm", width).items()
    yield from _linear(f"{prefix}.mlp.fc1", width, tower.feed_forward).items()
    yield from _linear(f"{prefix}.mlp.fc2", tower.feed_forward, width).items()


def _language(prefix: str, language: Language) -> dict[str, Sizes]:
    width, hidden = language.hidden_size, language.intermediate_size
    inner = language.key_value_heads * language.channels
    rows = (language.vocab_size, width)
    tensors: dict[str, Sizes] = {f"{prefix}.model.embed_tokens.weight": rows}
    for number in range(language.num_hidden_layers):
        layer = f"{prefix}.model.layers.{number}"
        tensors |= layer_tensors(layer, width, inner, hidden)
    return {**tensors, f"{prefix}.model.norm.weight": (width,), f"{prefix}.lm_head.weight": rows}


def layer_tensors(prefix: str, width: int, inner: int, hidden: int) -> dict[str, Sizes]:
    """Name -> shape of a Llama layer. inner: channels of all heads of keys or values."""
    return {
        f"{prefix}.input_layernorm.weight": (width,),
        f"{prefix}.self_attn.q_proj.weight": (width, width),
        f"{prefix}.self_attn.k_proj.weight": (inner, width),
        f"{prefix}.self_attn.v_proj.weight": (inner, width),
        f"{prefix}.self_attn.o_proj.weight": (width, width),
        f"{prefix}.post_attention_layernorm.weight": (width,),
        f"{prefix}.mlp.gate_proj.weight": (hidden, width),
        f"{prefix}.mlp.up_proj.weight": (hidden, width),
        f"{prefix}.mlp.down_proj.weight": (width, hidden),
    }
