"""Drafters in the file layout of the published EAGLE and Spec-VLA code (docs/methods.md §2.2).

Such a drafter is a linear layer `fc` and one Llama layer, without a norm before or after it. It uses the target's
embeddings and head, and has the same inputs as our own drafter. `Convention` describes two further differences.

Shapes: B sequences, T new tokens, S cached tokens, P prompt tokens, E width of the target.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_json
from kerv_cli.base.manifests import read
from kerv_cli.engine.protocol import ReadableTarget
from kerv_cli.targets.attention import Cache, attention_mask
from kerv_cli.targets.checkpoint import WEIGHTS, load_tensors
from kerv_cli.targets.openvla.config import CONFIG, Language
from kerv_cli.targets.openvla.loading import Sizes, check_layout, open_shards, sizes_of
from kerv_cli.targets.openvla.network import LlamaLayer, run_layers

EMBEDDING = "embed_tokens.weight"


@dataclass(frozen=True)
class Convention:
    """Two ways in which a published drafter may differ from our own.

    Attributes:
        positions: Rotary positions of drafted tokens. `sequence`: they count all tokens before. `text`: they do not
            count the vision tokens, because the published code counts token ids and vision tokens have none.
        mask: `causal`: every token sees all tokens before it. `prompt`: every token sees only the prompt without its
            last token. Spec-VLA's drafter was trained with this mask.
    """

    positions: str = "sequence"
    mask: str = "causal"


@dataclass(frozen=True)
class PublicShape:
    """Shape of a published drafter.

    Attributes:
        language: Sizes of the drafter's Llama layer.
        bias: Whether `fc` has a bias.
        convention: How the drafter differs from our own.
        skipped: Number of vision tokens in the target's prompt. They get no position number with `positions=text`.
    """

    language: Language
    bias: bool
    convention: Convention
    skipped: int


class DraftCache(Cache):
    """Keys and values of a drafter. The attribute `prompt` is the number of prompt tokens."""

    prompt = 0


class PublicDrafter(nn.Module):
    """The network of a published drafter."""

    def __init__(self, shape: PublicShape) -> None:
        super().__init__()
        self.shape, language = shape, shape.language
        self.fc = nn.Linear(2 * language.hidden_size, language.hidden_size, bias=shape.bias)
        self.layers = nn.ModuleList(LlamaLayer(language, normed=i > 0) for i in range(language.num_hidden_layers))

    def new_cache(self, batch: int, capacity: int, fixed: bool | None = None) -> DraftCache:
        """Return an empty cache.

        Args:
            batch: Number of sequences.
            capacity: Maximum number of tokens.
            fixed: Whether the cache's tensors always have full size, as CUDA graphs need. None: only on CUDA.
        """
        weight, sizes = self.fc.weight, self.shape.language.cache_sizes(batch, capacity)
        return DraftCache(*sizes, weight, weight.is_cuda if fixed is None else fixed)

    def draft_position(self, index: int) -> int:
        """Return the rotary position at which drafting begins.

        Args:
            index: Position of the first draft step in the sequence, counted from the prompt's beginning.
        """
        return index - self.shape.skipped * (self.shape.convention.positions == "text")

    def forward(
        self,
        following: Tensor,
        hidden: Tensor,
        positions: Tensor,
        cache: DraftCache | None = None,
        seen: np.ndarray | Tensor | None = None,
    ) -> Tensor:
        """Return the predicted hidden states at the next positions, (B, T, E).

        Args:
            following: (B, T, E) embedding of the token after each position.
            hidden: (B, T, E) hidden state at each position.
            positions: (T,) rotary positions.
            cache: Keys and values of earlier positions. If it is empty, `hidden` must have the states of the whole
                prompt. None: there are no earlier positions.
            seen: (T, M) bool, which of the last M keys each query sees. None: all keys up to its own position.
        """
        if cache is not None and not cache.length:
            cache.prompt = hidden.shape[1]
        x = self.fc(torch.cat([following, hidden], -1))
        if self.shape.convention.mask == "prompt":
            mask: Tensor | None = self.prompt_mask(x, cache, seen)
        else:
            mask = attention_mask(seen, x.shape[1], cache, x)
        return run_layers(self.layers, self.shape.language, x, positions, cache, mask)

    def prompt_mask(self, x: Tensor, cache: DraftCache | None, seen: np.ndarray | Tensor | None) -> Tensor:
        """Return the additive attention mask for `mask=prompt`.

        A query sees a key only if the key is one of the prompt's first P − 1 tokens and `seen` allows it.

        Args:
            x: (B, T, E) inputs of the layers.
            cache: Keys and values of S earlier tokens. None: there are none, and x is the prompt.
            seen: (T, M) bool, which of the last M keys each query may see. None: all keys up to its own position.

        Returns:
            (T, S + T): 0 for visible keys, −∞ for hidden keys.
        """
        prompt = cache.prompt if cache is not None else x.shape[1]
        mask = attention_mask(np.tri(x.shape[1], dtype=bool) if seen is None else seen, x.shape[1], cache, x)
        if mask is None:
            assert cache is not None
            mask = x.new_zeros(x.shape[1], cache.length + x.shape[1])
        mask[:, max(1, prompt - 1) :] = -torch.inf
        return mask


def layout_of(shape: PublicShape) -> dict[str, Sizes]:
    """Return the size of each tensor that a published drafter of this shape must contain, by the tensor's name."""
    with torch.device("meta"):
        return sizes_of(PublicDrafter(shape))


def read_public(folder: Path, target: ReadableTarget, convention: Convention) -> tuple[PublicShape, dict[str, Tensor]]:
    """Read a published drafter, without its copy of the target's embeddings.

    Args:
        folder: Folder with `config.json` and `model.safetensors`.
        target: The target for which the drafter drafts.
        convention: How the drafter differs from our own.

    Returns:
        The drafter's shape, and its tensors by name.

    Raises:
        CheckpointError: The folder is incomplete, damaged or pickled, or the drafter has another width than the target.
    """
    config, pickled = folder / CONFIG, folder / "pytorch_model.bin"
    language = read(Language, read_json(config), str(config), tolerant=True)
    if not (folder / WEIGHTS).is_file() and pickled.is_file():
        raise CheckpointError(
            f"{pickled} is pickled and can run code when it is opened: convert it to {WEIGHTS} where you trust it"
        )
    if language.hidden_size != target.width:
        raise CheckpointError(f"the drafter in {folder} is {language.hidden_size} wide, the target {target.width}")
    shards = open_shards(folder)
    skipped = target.segments["vision"] if "vision" in target.segments else slice(0, 0)
    shape = PublicShape(language, "fc.bias" in shards.shapes, convention, skipped.stop - skipped.start)
    layout = {name: sizes for name, sizes in shards.shapes.items() if name != EMBEDDING}
    check_layout(layout, layout_of(shape), folder)
    return shape, {name: tensor for name, tensor in shards.items() if name != EMBEDDING}


def load_public(folder: Path, shape: PublicShape, target: ReadableTarget) -> PublicDrafter:
    """Load an imported drafter with frozen weights, on the target's device and in the target's number format.

    Raises:
        CheckpointError: The weights are damaged or have other shapes.
    """
    tensors = load_tensors(folder / WEIGHTS, "drafter")
    layout = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    check_layout(layout, layout_of(shape), folder)
    drafter = PublicDrafter(shape)
    drafter.load_state_dict(tensors)
    return drafter.to(device=target.device, dtype=target.dtype).eval().requires_grad_(False)
