"""Checkpoints: safetensors, and one JSON with settings, spaces, vocabulary and provenance. Nothing is pickled."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import read_mapping, sha256_of, write_bytes, write_json
from kerv_cli.base.manifests import read
from kerv_cli.base.registry import find, load, parts
from kerv_cli.base.spaces import ActionSpace, ObservationSpace

if TYPE_CHECKING:  # torch is imported where weights are read or written: a description is read without it
    import torch
    from torch import Tensor, nn

FORMAT = 2
WEIGHTS = "model.safetensors"
FLOAT32, FLOAT16, INT8 = "float32", "float16", "int8"
"""How weights are stored."""
SCALE = ".scale"
"""Ending of the name of the tensor that holds an int8 matrix's scales, one per row."""


@dataclass(frozen=True)
class Description:
    """The fields in the JSON of every artifact with weights. `sha256` is that of the weights' file."""

    format: int
    kind: str
    sha256: str


@dataclass(frozen=True)
class TargetDescription(Description):
    """A target's JSON.

    Attributes:
        family: Name of the registered target that reads `settings`.
        environment: Environment of the demonstrations that it was trained on.
        settings: Settings of the family, `chunk` among them.
        actions: Action space.
        observation: Observation space.
        cameras: Names of the images that it reads.
        words: Vocabulary of instructions.
        provenance: How it was made.
        state_range: 0.1th and 99.9th percentile of the demonstrations' states (s,). None if not recorded.
    """

    family: str
    environment: str
    settings: dict[str, Any]
    actions: ActionSpace
    observation: ObservationSpace
    cameras: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    provenance: dict[str, Any] = field(default_factory=dict)
    state_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.settings.get("chunk"), int):
            raise ValueError("settings lack chunk, the control steps of a decode")

    @property
    def chunk(self) -> int:
        """H, the control steps that it was trained to decode at once."""
        return int(self.settings["chunk"])

    @property
    def origin(self) -> Mapping[str, Any]:
        """Folder (`base`) and weights' hash (`sha256`) of the policy whose tokens it decodes; a grown target's base."""
        return self.settings.get("grown") or {"sha256": self.sha256}

    @property
    def parallel(self) -> bool:
        """Whether it decodes all tokens of a chunk at once, and only so."""
        return bool(self.settings.get("parallel"))

    @property
    def tasks(self) -> list[str]:
        """Tasks and suites that it was trained on, empty if unknown."""
        return list(self.provenance.get("settings", {}).get("task") or [])

    @property
    def demos(self) -> str:
        """Name of the demonstrations that it was trained on, empty if unknown."""
        return self.provenance.get("settings", {}).get("demos") or ""

    def check_world(self, name: str, environment: str, actions: ActionSpace, size: int) -> None:
        """Refuse a world that the target was not made for.

        Args:
            name: Name of the target.
            environment: Name of the world's environment.
            actions: Action space of the environment.
            size: Pixels of the frames that the target would see.

        Raises:
            UsageError: The frames have another size.
            CheckpointError: The action space is another one.
        """
        trained = self.settings.get("image_size", size)
        if self.cameras and size != trained:
            raise UsageError(f"world.camera.size={size}: the policy was trained on {trained} pixels")
        self.actions.check_same(actions, f"target '{name}'", f"environment {environment}")

    def check_autoregressive(self, what: str, why: str) -> None:
        """Refuse a target that decodes in parallel.

        Args:
            what: The setting that needs another target.
            why: What this one lacks.

        Raises:
            UsageError: It is parallel.
        """
        if self.parallel:
            raise UsageError(f"{what}: the target decodes all tokens at once, {why}; choose one that is autoregressive")


T = TypeVar("T", bound=Description)


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None) -> None:
    """Write a safetensors file atomically. Raises StorageError if that fails."""
    from safetensors.torch import save

    write_bytes(path, save({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, metadata))


def load_tensors(path: Path, what: str) -> dict[str, Tensor]:
    """Return the tensors of a safetensors file.

    Args:
        path: The file.
        what: Its name in messages.

    Raises:
        CheckpointError: It is missing, damaged, or holds numbers that are not finite.
    """
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if not path.is_file():
        raise CheckpointError(f"no {what} at {path}: train it, or name another with its folder")
    try:
        tensors = load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(
            f"{what} at {path} is damaged ({error}): move it aside and train or copy it again"
        ) from error
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not torch.isfinite(tensor).all():
            raise CheckpointError(f"{what} at {path} has numbers in {name} that are not finite: train it again")
    return tensors


def compact(state: Mapping[str, Tensor], stored: str) -> dict[str, Tensor]:
    """Return the tensors as they are stored.

    float16 halves all floats. int8 stores every matrix as integers of -127 to 127 and a float16 scale per row, the
    row's largest absolute value / 127, under `<name>{SCALE}`. Other floats become float16.
    """
    import torch

    if stored == FLOAT32:
        return dict(state)
    small: dict[str, Tensor] = {}
    for name, tensor in state.items():
        if stored == INT8 and tensor.is_floating_point() and tensor.dim() >= 2:
            rows = tensor.float().flatten(1)
            scale = (rows.abs().amax(1, keepdim=True) / 127).clamp_min(1e-7).half()
            small[name] = (rows / scale.float()).round().clamp(-127, 127).to(torch.int8).view(tensor.shape)
            small[name + SCALE] = scale
        else:
            small[name] = tensor.half() if tensor.is_floating_point() else tensor
    return small


def expanded(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Invert `compact`: matrices with a scale become float32, the rest stays as it is."""
    full = {}
    for name, tensor in tensors.items():
        if not (name.endswith(SCALE) and name.removesuffix(SCALE) in tensors):  # a module's own may be called so
            scale = tensors.get(name + SCALE)
            full[name] = tensor if scale is None else (tensor.float().flatten(1) * scale.float()).view(tensor.shape)
    return full


def save_module(
    folder: Path, kind: str, module: nn.Module, description: Mapping[str, Any], stored: str = FLOAT32
) -> str:
    """Write the weights and, last, `<kind>.json`. Return the SHA-256 of the weights.

    Args:
        folder: Folder to write to.
        kind: Kind of artifact.
        module: Module whose weights are written.
        description: Fields of the JSON.
        stored: Number format of the weights. `load_state` converts them back to float32.
    """
    folder.mkdir(parents=True, exist_ok=True)
    save_tensors(folder / WEIGHTS, compact(module.state_dict(), stored))
    digest = sha256_of(folder / WEIGHTS)
    write_json(folder / f"{kind}.json", {"format": FORMAT, "kind": kind, "sha256": digest, **description})
    return digest


def target_fields(
    family: str,
    settings: Mapping[str, Any],
    environment: str,
    actions: ActionSpace,
    observation: ObservationSpace,
    **others: Any,
) -> dict[str, Any]:
    """Return the fields of a target.json for `save_module`. The arguments are fields of `TargetDescription`."""
    spaces = {"actions": actions.as_dict(), "observation": observation.as_dict()}
    empty: dict[str, Any] = {"cameras": [], "words": [], "provenance": {}}
    return {"family": family, "environment": environment, "settings": dict(settings), **spaces, **empty, **others}


def read_description(folder: Path, kind: str, schema: type[T]) -> T:
    """Return the JSON beside the weights, checked against its schema and their hash.

    Raises:
        CheckpointError: It is missing, of another version, damaged, or of other weights.
    """
    description = described(folder, kind, schema)
    check_weights(folder, kind, description.sha256)
    return description


def described(folder: Path, kind: str, schema: type[T]) -> T:
    """Return the JSON of a folder, checked against its schema but not against weights; errors as `read_description`."""
    path = folder / f"{kind}.json"
    if not path.is_file():
        raise CheckpointError(f"no {kind} in {folder}: run 'kerv train {kind}', or name a folder that holds one")
    status = path.stat()
    version = status.st_ino, status.st_size, status.st_mtime_ns
    return _read_description(path, kind, schema, version)  # type: ignore[arg-type]


def check_weights(folder: Path, kind: str, sha256: str) -> None:
    """Check that the weights in `folder` are there and have this hash.

    Raises:
        CheckpointError: They are not.
    """
    weights = folder / WEIGHTS
    if not weights.is_file():
        raise CheckpointError(f"{weights} is missing: the {kind} is incomplete, train or copy it again")
    if sha256_of(weights) != sha256:
        raise CheckpointError(f"{weights} does not match its description: damaged or mixed up, copy the folder again")


@functools.lru_cache(maxsize=256)
def _read_description(path: Path, kind: str, schema: type[T], version: tuple[int, int, int]) -> T:
    """Read the JSON file, once per process as long as its `version` (inode, size, time of change) stays the same."""
    value = read_mapping(path)
    if (value.get("format"), value.get("kind")) != (FORMAT, kind):
        raise CheckpointError(f"{path} is not a {kind} of format {FORMAT}: it was written by another version of kerv")
    return read(schema, value, str(path), tolerant=True)


def load_state(module: nn.Module, folder: Path, kind: str) -> None:
    """Load the folder's weights into `module`.

    Raises:
        CheckpointError: They are missing, damaged, or do not fit the module.
    """
    try:
        module.load_state_dict(expanded(load_tensors(folder / WEIGHTS, kind)))
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise CheckpointError(f"{kind} in {folder} does not fit its own settings: {reason}") from error


def read_target(folder: Path) -> TargetDescription:
    """Return a target's description; errors as `read_description`.

    A family whose weights are in another folder checks them itself: its trait `weights` names a function of
    (folder, description).
    """
    description = described(folder, "target", TargetDescription)
    family = parts("target").get(description.family)
    if family is not None and "weights" in family.traits:
        load(family.traits["weights"])(folder, description)
    else:
        check_weights(folder, "target", description.sha256)
    return description


def load_target(folder: Path, device: str = "cpu", dtype: torch.dtype | None = None) -> tuple[Any, TargetDescription]:
    """Return the target in `folder`, ready for inference, and its description. `dtype` is float32 by default.

    Raises:
        CheckpointError: It is missing or damaged.
        UnknownName: Its family is not registered.
    """
    import torch

    description = read_target(folder)
    part = find("target", description.family, "target family")
    return part.built(folder, description, device, dtype or torch.float32), description
