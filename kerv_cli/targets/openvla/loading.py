"""Load the safetensors files of an OpenVLA checkpoint, after checking the names and shapes of their tensors.

The files are memory-mapped. On a CPU the weights are not copied, unless they are converted to another number format.
Nothing is unpickled.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import sha256_of, visible
from kerv_cli.targets.compact.trunk import Rotary
from kerv_cli.targets.openvla.config import CONFIG, Shape
from kerv_cli.targets.openvla.network import OpenVLAModel, published

Sizes = tuple[int, ...]
PICKLED = (".bin", ".pt", ".pth", ".ckpt")


@dataclass(frozen=True)
class Shards:
    """The safetensors files of a checkpoint.

    Attributes:
        tensors: Name of the file that holds each tensor, by the tensor's name.
        shapes: Shape of each tensor, by name.
    """

    folder: Path
    tensors: Mapping[str, str]
    shapes: Mapping[str, Sizes]

    @property
    def files(self) -> tuple[str, ...]:
        return tuple(sorted(set(self.tensors.values())))

    def sizes(self) -> dict[str, int]:
        return {name: (self.folder / name).stat().st_size for name in self.files}

    def hashes(self) -> dict[str, str]:
        return {name: sha256_of(self.folder / name) for name in self.files}

    def items(self) -> Iterator[tuple[str, Tensor]]:
        for file in self.files:
            with _open_tensors(self.folder / file) as handle:
                for name in handle.keys():  # noqa: SIM118 - not a mapping
                    yield name, handle.get_tensor(name)


@contextlib.contextmanager
def _open_tensors(path: Path) -> Iterator[Any]:
    try:
        with safe_open(path, framework="pt", device="cpu") as handle:
            yield handle
    except (SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(f"{path} is missing, cut short or damaged ({error}): download it again") from error


def open_shards(folder: Path) -> Shards:
    """Open the safetensors files in a folder. Only their headers are read."""
    files = sorted(folder.glob("[!.]*.safetensors"))
    if not files:
        pickled = [path.name for path in visible(folder) if path.suffix in PICKLED]
        if pickled:
            raise CheckpointError(
                f"{folder} holds pickled weights ({pickled[0]}), which can run code when they are opened, and no "
                "safetensors: convert them to safetensors where you trust them"
            )
        raise CheckpointError(f"no safetensors in {folder}: name the folder of a Hugging Face checkpoint")
    tensors: dict[str, str] = {}
    shapes: dict[str, Sizes] = {}
    for file in files:
        with _open_tensors(file) as handle:
            for name in handle.keys():  # noqa: SIM118 - not a mapping
                if name in tensors:
                    raise CheckpointError(
                        f"{tensors[name]} and {file.name} in {folder} both hold {name}: remove the one that does not "
                        "belong there"
                    )
                tensors[name], shapes[name] = file.name, tuple(handle.get_slice(name).get_shape())
    return Shards(folder, tensors, shapes)


def layout(shape: Shape) -> dict[str, Sizes]:
    with torch.device("meta"):
        state = OpenVLAModel(shape).state_dict()
    sizes: dict[str, Sizes] = {}
    for name, tensor in state.items():
        parts = published(name)
        sizes |= dict.fromkeys(parts, (len(tensor) // len(parts), *tensor.shape[1:]))
    return sizes


def is_unread(name: str, shape: Shape) -> bool:
    """Return whether a tensor has no effect, because it is in a tower's last block, final norm or pooling head."""
    dino, siglip = shape.towers
    last = rf"featurizer\.blocks\.{dino.depth - 1}|fused_featurizer\.blocks\.{siglip.depth - 1}"
    return re.match(rf"vision_backbone\.({last}|\w+\.norm|\w+\.attn_pool)\.", name) is not None


def open_checked(folder: Path, shape: Shape) -> Shards:
    shards, expected = open_shards(folder), layout(shape)
    shapes = {name: sizes for name, sizes in shards.shapes.items() if not is_unread(name, shape)}
    wrong = sorted(name for name in {*shapes, *expected} if shapes.get(name) != expected.get(name))
    if wrong:
        raise CheckpointError(
            f"the weights in {folder} do not fit its {CONFIG}: {len(wrong)} are missing, unknown or of another "
            f"shape, such as {wrong[0]}"
        )
    return shards


def load_model(folder: Path, shape: Shape, device: str, dtype: torch.dtype) -> Any:
    tensors = dict(open_checked(folder, shape).items())
    with torch.device("meta"):
        model: Any = OpenVLAModel(shape)
    state = {}
    for name in model.state_dict():
        parts = [tensors.pop(part).to(device=device, dtype=dtype) for part in published(name)]
        state[name] = parts[0] if len(parts) == 1 else torch.cat(parts)
    model.load_state_dict(state, assign=True)
    trunk = model.language_model.model
    trunk.rotary = Rotary(trunk.width // trunk.heads).to(device, dtype)
    return model.eval().requires_grad_(False)


def check_finite(shards: Shards) -> int:
    """Check that all weights are finite, which reads the whole checkpoint. Return the number of weights."""
    count = 0
    for name, tensor in shards.items():
        if not torch.isfinite(tensor).all():
            raise CheckpointError(f"{shards.folder / shards.tensors[name]} has numbers in {name} that are not finite")
        count += tensor.numel()
    return count


def digest_of(hashes: Mapping[str, str], settings: Mapping[str, Any]) -> str:
    """Return one SHA-256 for the files of a model and the settings that change what the model computes."""
    text = json.dumps({"files": dict(sorted(hashes.items())), "settings": dict(settings)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
