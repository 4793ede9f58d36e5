"""Drafters in the layout of the public EAGLE and Spec-VLA codes (docs/methods.md §2.2).

They are `fc` and one Llama layer without a norm before or after it. Embeddings and head are the target's. Their inputs
are those of our own drafter. Two differences are switches of `Convention`.
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
from kerv_cli.targets.openvla.loading import SINGLE, Sizes, check_layout, open_shards, sizes_of
from kerv_cli.targets.openvla.trunk import LlamaLayer, run_layers

EMBEDDING = "embed_tokens.weight"


@dataclass(frozen=True)
class Convention:
    """How a public drafter's code differs from kerv's.

    Attributes:
        positions: `sequence`: drafted tokens go on counting after the whole prompt. `text`: vision tokens are not
            counted. EAGLE's tree counts token ids, and Spec-VLA gives vision tokens none.
        mask: `causal`: every token sees all before it. `prompt`: no token sees a key after the prompt's last but one.
            Spec-VLA trains so: its attention mask is zero from there on.
    """

    positions: str = "sequence"
    mask: str = "causal"


@dataclass(frozen=True)
class PublicShape:
    """Shape of a public drafter.

    Attributes:
        skipped: Vision tokens, which `positions=text` does not count.
    """

    language: Language
    bias: bool
    convention: Convention
    skipped: int


class DraftCache(Cache):
    """A cache that remembers the length of the prompt."""

    prompt = 0


class PublicDrafter(nn.Module):
    """The network; called like `EagleNetwork`."""

    def __init__(self, shape: PublicShape) -> None:
        super().__init__()
        self.shape, language = shape, shape.language
        self.fc = nn.Linear(2 * language.hidden_size, language.hidden_size, bias=shape.bias)
        self.layers = nn.ModuleList(LlamaLayer(language, normed=i > 0) for i in range(language.num_hidden_layers))

    def new_cache(self, batch: int, capacity: int, fixed: bool | None = None) -> DraftCache:
        """Return an empty cache, on CUDA of fixed shapes unless `fixed` says otherwise."""
        weight, sizes = self.fc.weight, self.shape.language.cache_sizes(batch, capacity)
        return DraftCache(*sizes, weight, weight.is_cuda if fixed is None else fixed)

    def draft_position(self, index: int) -> int:
        """Return the rotary position of the drafted token at `index` of the sequence."""
        return index - self.shape.skipped * (self.shape.convention.positions == "text")

    def forward(
        self,
        following: Tensor,
        hidden: Tensor,
        positions: Tensor,
        cache: DraftCache | None = None,
        seen: np.ndarray | Tensor | None = None,
    ) -> Tensor:
        """Return the predicted hidden states (B, T, E). A call on an empty cache is the prompt's.

        The arguments are those of `EagleNetwork.forward`.
        """
        if cache is not None and not cache.length:
            cache.prompt = hidden.shape[1]
        x = self.fc(torch.cat([following, hidden], -1))
        mask = self.prompt_mask(x, cache, seen) if self.shape.convention.mask == "prompt" else None
        return run_layers(self.layers, self.shape.language, x, positions, cache, seen, mask)

    def prompt_mask(self, x: Tensor, cache: DraftCache | None, seen: np.ndarray | Tensor | None) -> Tensor:
        """Return an additive mask (T, S + T) in which no key after the prompt's last but one is seen."""
        prompt = cache.prompt if cache is not None else x.shape[1]
        mask = attention_mask(np.tri(x.shape[1], dtype=bool) if seen is None else seen, x.shape[1], cache, x)
        if mask is None:
            assert cache is not None
            mask = x.new_zeros(x.shape[1], cache.length + x.shape[1])
        mask[:, max(1, prompt - 1) :] = -torch.inf
        return mask


def layout_of(shape: PublicShape) -> dict[str, Sizes]:
    """Return name -> shape of a drafter's own tensors."""
    with torch.device("meta"):
        return sizes_of(PublicDrafter(shape))


def read_public(folder: Path, target: ReadableTarget, convention: Convention) -> tuple[PublicShape, dict[str, Tensor]]:
    """Return shape and tensors of a public drafter's folder, without its copy of the embeddings.

    Raises:
        CheckpointError: An incomplete, damaged or pickled folder, or a drafter of another width than the target's.
    """
    config, pickled = folder / CONFIG, folder / "pytorch_model.bin"
    language = read(Language, read_json(config), str(config), tolerant=True)
    if not (folder / SINGLE).is_file() and pickled.is_file():
        raise CheckpointError(
            f"{pickled} is pickled and can run code when it is opened: convert it to {SINGLE} where you trust it"
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
    """Return the drafter in `folder`, frozen, on the target's device.

    Raises:
        CheckpointError: The weights are damaged or of another shape.
    """
    tensors = load_tensors(folder / WEIGHTS, "drafter")
    layout = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    check_layout(layout, layout_of(shape), folder)
    drafter = PublicDrafter(shape)
    drafter.load_state_dict(tensors)
    return drafter.to(device=target.device, dtype=target.dtype).eval().requires_grad_(False)
