"""Drafters in the file layout of the published EAGLE and Spec-VLA code (docs/methods.md §2.2).

Such a drafter is a linear layer `fc` and one Llama layer, without a norm before or after it. It uses the target's
embeddings and head, and has the same inputs as our own drafter. `Convention` describes two further differences.

Shapes: B sequences, T new tokens, S cached tokens, P prompt tokens, E width of the target.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_json
from kerv_cli.base.manifests import read
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.targets.attention import Cache, attention_mask
from kerv_cli.targets.checkpoint import WEIGHTS
from kerv_cli.targets.openvla.config import CONFIG, Language
from kerv_cli.targets.openvla.loading import check_layout, open_shards, sizes_of
from kerv_cli.targets.openvla.network import LlamaLayer, run_layers

EMBEDDING = "embed_tokens.weight"


@dataclass(frozen=True)
class Convention:
    """Two ways in which a published drafter may differ from our own.

    Attributes:
        positions: How the rotary positions of drafted tokens are counted. With `sequence`, all earlier tokens count.
            With `text`, vision tokens do not count, because the published code counts token ids, and vision tokens
            have no ids.
        mask: With `causal`, every token sees all tokens before it. With `prompt`, every token sees only the prompt
            without the prompt's last token. Spec-VLA's drafter was trained with the mask `prompt`.
    """

    positions: str = "sequence"
    mask: str = "causal"


@dataclass(frozen=True)
class PublicShape:
    """Shape of a published drafter.

    Attributes:
        language: Sizes of the drafter's Llama layer.
        bias: Whether `fc` has a bias.
        skipped: Number of vision tokens in the target's prompt. With `positions=text`, positions do not count them.
    """

    language: Language
    bias: bool
    convention: Convention
    skipped: int


class DraftCache(Cache):
    """Keys and values of a drafter. `prompt` is the number of prompt tokens."""

    prompt = 0


class DraftNetwork(nn.Module):
    """Base of the networks of EAGLE-style drafters.

    Attributes:
        skipped: Number of prompt tokens that do not count in the rotary positions of drafted tokens.
    """

    skipped = 0
    run: Callable[..., Tensor]

    def forward(
        self,
        following: Tensor,
        hidden: Tensor,
        positions: Tensor,
        cache: Cache | None = None,
        seen: np.ndarray | Tensor | None = None,
    ) -> Tensor:
        """Return the predicted hidden states (B, T, E) at the next positions.

        Args:
            following: (B, T, E) embedding of the token after each position.
            hidden: (B, T, E) hidden states at the positions.
            positions: (T,) rotary positions.
            seen: Attention mask (T, M) bool over the last M tokens. If None, attention is causal.
        """
        return self.run((following, hidden), positions, cache, seen)


class PublicDrafter(DraftNetwork):
    """The network of a published drafter."""

    def __init__(self, shape: PublicShape) -> None:
        super().__init__()
        self.shape, language = shape, shape.language
        self.skipped = shape.skipped if shape.convention.positions == "text" else 0
        self.fc = nn.Linear(2 * language.hidden_size, language.hidden_size, bias=shape.bias)
        self.layers = nn.ModuleList(LlamaLayer(language, normed=i > 0) for i in range(language.num_hidden_layers))

    def new_cache(self, batch: int, capacity: int) -> DraftCache:
        weight = self.fc.weight
        return DraftCache(*self.shape.language.cache_sizes(batch, capacity), weight, weight.is_cuda)

    def run(self, inputs: Sequence[Tensor], positions: Tensor, cache: Any, seen: np.ndarray | Tensor | None) -> Tensor:
        """Compute what `forward` returns. `inputs` are its first two arguments.

        With `mask=prompt`, a query sees only the prompt's first P − 1 tokens, and of these only what `seen` allows.
        """
        if cache is not None and not cache.length:
            cache.prompt = inputs[0].shape[1]
        x = self.fc(torch.cat([*inputs], -1))
        size, is_prompt = x.shape[1], self.shape.convention.mask == "prompt"
        mask = attention_mask(np.tri(size, dtype=bool) if is_prompt and seen is None else seen, size, cache, x)
        if is_prompt:
            if mask is None:
                mask = x.new_zeros(size, cache.length + size)
            mask[:, max(1, (cache.prompt if cache is not None else size) - 1) :] = -torch.inf
        return run_layers(self.layers, self.shape.language, x, positions, cache, mask)


def read_public(folder: Path, target: ReadableTarget, convention: Convention) -> PublicDrafter:
    """Read a published drafter, without its copy of the target's embeddings. The weights keep their number format."""
    config, pickled = folder / CONFIG, folder / "pytorch_model.bin"
    language = read(Language, read_json(config), str(config), tolerant=True)
    if not (folder / WEIGHTS).is_file() and pickled.is_file():
        raise CheckpointError(
            f"{pickled} is pickled and can run code when it is opened: convert it to {WEIGHTS} where you trust it"
        )
    if language.hidden_size != target.width:
        raise CheckpointError(f"the drafter in {folder} is {language.hidden_size} wide, the target {target.width}")
    shards = open_shards(folder)
    vision = target.segments.get("vision", slice(0, 0))
    shape = PublicShape(language, "fc.bias" in shards.shapes, convention, vision.stop - vision.start)
    with torch.device("meta"):
        network = PublicDrafter(shape)
    layout = dict(shards.shapes)
    layout.pop(EMBEDDING, None)
    check_layout(layout, sizes_of(network), folder)
    network.load_state_dict({name: tensor for name, tensor in shards.items() if name != EMBEDDING}, assign=True)
    return network
