"""Opens the safetensors shards of a folder, checks names and shapes against the layout, and fills the modules.

Shards stay memory-mapped: on a CPU, in the number format of the file, weights are never copied. Nothing is unpickled.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_mapping, regular, sha256_of
from kerv_cli.targets.openvla.config import CONFIG, Shape
from kerv_cli.targets.openvla.trunk import LanguageModel, quantise
from kerv_cli.targets.openvla.vision import Block, PoolingHead, Projector, VisionBackbone

Sizes = tuple[int, ...]
INDEX, SINGLE = "model.safetensors.index.json", "model.safetensors"
PICKLED = ("*.bin", "*.pt", "*.pth", "*.ckpt")
LISTED = 3  # names of each kind in a message


@dataclass(frozen=True)
class Shards:
    """The safetensors files of a folder. tensors: name -> file; shapes: name -> shape, from the files' headers."""

    folder: Path
    tensors: Mapping[str, str]
    shapes: Mapping[str, Sizes]

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files, each once."""
        return tuple(sorted(set(self.tensors.values())))

    def sizes(self) -> dict[str, int]:
        """File -> bytes."""
        return {name: (self.folder / name).stat().st_size for name in self.files}

    def hashes(self) -> dict[str, str]:
        """File -> SHA-256."""
        return {name: sha256_of(self.folder / name) for name in self.files}

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """Every tensor, backed by the file's memory map."""
        for file in self.files:
            with _open_tensors(self.folder / file) as handle:
                for name in handle.keys():  # noqa: SIM118 - not a mapping
                    yield name, handle.get_tensor(name)


@contextlib.contextmanager
def _open_tensors(path: Path) -> Iterator[Any]:
    try:
        with safe_open(regular(path), framework="pt", device="cpu") as handle:
            yield handle
    except (SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(f"{path} is missing, cut short or damaged ({error}): download it again") from error


def open_shards(folder: Path) -> Shards:
    """The shards of `folder`; reads their headers only.

    Raises:
        CheckpointError: none, pickled ones, a missing or truncated shard, an index that does not match them.
    """
    index = folder / INDEX
    if index.is_file():
        named = read_mapping(index).get("weight_map")
        if not isinstance(named, dict) or not all(isinstance(x, str) and "/" not in x for x in named.values()):
            raise CheckpointError(f"{index} has no weight_map of file names: download it again")
        files = sorted(set(named.values()))
    elif (folder / SINGLE).is_file():
        named, files = None, [SINGLE]
    else:
        raise CheckpointError(_no_weights(folder))
    tensors, shapes = {}, {}
    for file in files:
        with _open_tensors(folder / file) as handle:
            for name in handle.keys():  # noqa: SIM118 - not a mapping
                tensors[name], shapes[name] = file, tuple(handle.get_slice(name).get_shape())
    if named is not None and named != tensors:
        wrong = sorted(name for name in {*named, *tensors} if named.get(name) != tensors.get(name))
        raise CheckpointError(f"{index} and its shards disagree about {_listed(wrong)}: download the folder again")
    return Shards(folder, tensors, shapes)


def _no_weights(folder: Path) -> str:
    pickled = sorted(path.name for pattern in PICKLED for path in folder.glob(pattern))
    if not pickled:
        return f"no safetensors in {folder}: name the folder of a Hugging Face OpenVLA checkpoint"
    return (
        f"{folder} holds pickled weights ({pickled[0]}), which can run code when they are opened, and no safetensors: "
        "convert them to safetensors where you trust them"
    )


def check_layout(shapes: Mapping[str, Sizes], expected: Mapping[str, Sizes], where: Path) -> None:
    """Compares the names and shapes of a folder with those that its config asks for.

    Raises:
        CheckpointError: tensors are missing, too many, or of another shape; the line lists the first of each.
    """
    missing = [name for name in expected if name not in shapes]
    extra = [name for name in shapes if name not in expected]
    both = [name for name in expected if name in shapes and tuple(shapes[name]) != tuple(expected[name])]
    misshapen = [f"{name} {_text(shapes[name])}, not {_text(expected[name])}" for name in both]
    kinds = {"missing": missing, "unknown": extra, "of another shape": misshapen}
    wrong = [f"{len(names)} {kind}: {_listed(names)}" for kind, names in kinds.items() if names]
    if wrong:
        raise CheckpointError(f"the weights in {where} are not those of its {CONFIG}: {'; '.join(wrong)}")


def _text(sizes: Sizes) -> str:
    return "x".join(map(str, sizes))


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join(names[:LISTED]) + more


class OpenVLAModel(nn.Module):
    """The modules, under the published names."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.vision_backbone = VisionBackbone(shape)
        self.projector = Projector(shape)
        self.language_model = LanguageModel(shape.language)


def layout(shape: Shape) -> dict[str, Sizes]:
    """Name -> shape of every tensor of a checkpoint: those of the modules, and of each tower what nothing reads, its
    last block, the norm behind it and SigLIP's pooling head."""
    with torch.device("meta"):
        tensors = sizes_of(OpenVLAModel(shape))
        for name, tower in zip(("featurizer", "fused_featurizer"), shape.towers, strict=True):
            unread = {f"blocks.{tower.depth - 1}": Block(tower), "norm": nn.LayerNorm(tower.width)}
            if tower.pooled:
                unread["attn_pool"] = PoolingHead(tower)
            for part, module in unread.items():
                tensors |= sizes_of(module, f"vision_backbone.{name}.{part}.")
    return tensors


def sizes_of(module: nn.Module, prefix: str = "") -> dict[str, Sizes]:
    """Name -> shape of a module's tensors."""
    return {f"{prefix}{name}": tuple(tensor.shape) for name, tensor in module.state_dict().items()}


def load_model(folder: Path, shape: Shape, device: str, dtype: torch.dtype, int8: bool) -> OpenVLAModel:
    """The model of `folder`, frozen. int8: the layers of the language model with one byte per weight.

    Raises:
        CheckpointError: as `open_shards` and `check_layout`.
    """
    shards = open_shards(folder)
    check_layout(shards.shapes, layout(shape), folder)
    with torch.device("meta"):
        model = OpenVLAModel(shape)
    names = model.state_dict().keys()
    state = {n: t.to(device=device, dtype=dtype) for n, t in shards.items() if n in names}
    model.load_state_dict(state, assign=True)
    del state
    if int8:
        quantise(model.language_model.model.layers)
    return model.eval().requires_grad_(False)


def check_finite(shards: Shards) -> int:
    """Reads every number once -> how many there are.

    Raises:
        CheckpointError: a tensor holds numbers that are not finite.
    """
    count = 0
    for name, tensor in shards.items():
        if not torch.isfinite(tensor).all():
            raise CheckpointError(f"{shards.folder / shards.tensors[name]} has numbers in {name} that are not finite")
        count += tensor.numel()
    return count


def digest_of(hashes: Mapping[str, str], settings: Mapping[str, Any]) -> str:
    """One SHA-256 for weights in several files and the settings that change what they compute."""
    text = json.dumps({"files": dict(sorted(hashes.items())), "settings": dict(settings)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
