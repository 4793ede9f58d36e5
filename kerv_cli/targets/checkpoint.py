"""Read and write checkpoints: weights as safetensors, and a JSON description. Nothing is pickled.

The description contains settings, action and observation space, vocabulary and provenance (docs/formats.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import link_files, read_mapping, sha256_of, write_bytes, write_folder, write_json
from kerv_cli.base.manifests import read
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.targets import TargetPart

if TYPE_CHECKING:  # torch is imported where weights are read or written: a description is read without it
    import torch
    from torch import Tensor, nn

FORMAT = 2
WEIGHTS = "model.safetensors"
FLOAT32, FLOAT16, INT8 = "float32", "float16", "int8"  # number formats of stored weights
SCALE = ".scale"  # `<name>.scale` contains the scales of the int8 matrix `<name>`, one per row


@dataclass(frozen=True)
class Description:
    """The fields that the description (`<kind>.json`) of every artifact has. `sha256` is the hash of its weights."""

    format: int
    kind: str
    sha256: str


@dataclass(frozen=True)
class TargetDescription(Description):
    """The content of `target.json`.

    Attributes:
        family: Registered family of targets, such as `compact`.
        environment: Name of the environment that the target's demonstrations come from.
        settings: Settings of the family. They always contain `chunk`.
        words: Vocabulary of instructions.
        state_range: The 0.1th percentiles, then the 99.9th percentiles, of the demonstrations' states. Each tuple has
            one percentile per number of the state. None if the range was not recorded.
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
            raise ValueError("chunk is missing in the settings: the number of control steps per decode")

    @property
    def chunk(self) -> int:
        return int(self.settings["chunk"])

    @property
    def origin(self) -> Mapping[str, Any]:
        """Identity of the policy whose tokens the target decodes. The key `sha256` holds the hash of its weights.

        A grown target (docs/methods.md §0.2) decodes the tokens of the original policy. Any other decodes its own.
        """
        return self.settings.get("grown") or {"sha256": self.sha256}

    @property
    def parallel(self) -> bool:
        return bool(self.settings.get("parallel"))

    @property
    def tasks(self) -> list[str]:
        return list(self.provenance.get("settings", {}).get("task") or [])

    @property
    def demos(self) -> str:
        return self.provenance.get("settings", {}).get("demos") or ""

    def check_world(self, name: str, environment: str, actions: ActionSpace, size: int) -> None:
        """Refuse an environment in which the target cannot act. `size`: pixels per side of the environment's images."""
        trained = self.settings.get("image_size", size)
        if self.cameras and size != trained:
            raise UsageError(f"world.camera.size={size}: the policy was trained on {trained} pixels")
        self.actions.check_same(actions, f"target '{name}'", f"environment {environment}")

    def check_autoregressive(self, what: str, why: str) -> None:
        """Refuse a parallel target. `what` needs decoding token by token, because `why`."""
        if self.parallel:
            raise UsageError(f"{what}: the target decodes all tokens at once, {why}; choose one that is autoregressive")


T = TypeVar("T", bound=Description)


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None) -> None:
    from safetensors.torch import save

    write_bytes(path, save({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, metadata))


def load_tensors(path: Path, what: str) -> dict[str, Tensor]:
    """Return the tensors of a safetensors file, all finite. `what` names the content in error messages."""
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
    """Convert tensors to the number format in which they are stored.

    Args:
        stored: float32 changes nothing. float16 converts all floats. int8 converts matrices to integers from -127 to
            127, and all other floats to float16. Each row of a matrix gets a float16 scale in `<name>.scale`: the row's
            largest absolute value / 127.
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
    """Convert the int8 matrices of `compact` back to float32, and leave out their scales."""
    full = {}
    for name, tensor in tensors.items():
        if not (name.endswith(SCALE) and name.removesuffix(SCALE) in tensors):  # a module may have its own `….scale`
            scale = tensors.get(name + SCALE)
            full[name] = tensor if scale is None else (tensor.float().flatten(1) * scale.float()).view(tensor.shape)
    return full


def save_module(
    folder: Path, kind: str, module: nn.Module, description: Mapping[str, Any], stored: str = FLOAT32
) -> str:
    """Write the weights of a module and their description `<kind>.json`. Return the SHA-256 of the weights.

    Both files are replaced in one step. If the process is killed, the folder holds either the old pair of files or the
    new pair. Other files in the folder stay.

    Args:
        kind: Kind of artifact, such as `target`.
        description: Fields of the description besides format, kind and sha256.
        stored: Number format of the stored weights. `load_state` converts them back to float32.
    """
    folder = folder.resolve()  # a link to a folder on another disk stays one

    def fill(new: Path) -> None:
        if folder.exists():
            link_files(folder, new)
        save_tensors(new / WEIGHTS, compact(module.state_dict(), stored))
        digest = sha256_of(new / WEIGHTS)
        write_json(new / f"{kind}.json", {"format": FORMAT, "kind": kind, "sha256": digest, **description})

    write_folder(folder, fill)
    return sha256_of(folder / WEIGHTS)


def target_fields(
    family: str,
    settings: Mapping[str, Any],
    environment: str,
    actions: ActionSpace,
    observation: ObservationSpace,
    **others: Any,
) -> dict[str, Any]:
    """Return a target's description, to pass to `save_module`. The arguments are fields of `TargetDescription`."""
    spaces = {"actions": actions.as_dict(), "observation": asdict(observation)}
    empty: dict[str, Any] = {"cameras": [], "words": [], "provenance": {}}
    return {"family": family, "environment": environment, "settings": dict(settings), **spaces, **empty, **others}


def read_description(folder: Path, kind: str, schema: type[T]) -> T:
    """Return the description of an artifact, after checking its fields and the hash of its weights."""
    description = described(folder, kind, schema)
    check_weights(folder, kind, description.sha256)
    return description


def described(folder: Path, kind: str, schema: type[T]) -> T:
    """Return the description of an artifact without checking its weights."""
    path = folder / f"{kind}.json"
    if not path.is_file():
        raise CheckpointError(f"no {kind} in {folder}: run 'kerv train {kind}', or name a folder that holds one")
    value = read_mapping(path)
    if (value.get("format"), value.get("kind")) != (FORMAT, kind):
        raise CheckpointError(f"{path} is not a {kind} of format {FORMAT}: it was written by another version of kerv")
    return read(schema, value, str(path), tolerant=True)


def check_weights(folder: Path, kind: str, sha256: str) -> None:
    weights = folder / WEIGHTS
    if not weights.is_file():
        raise CheckpointError(f"{weights} is missing: the {kind} is incomplete, train or copy it again")
    if sha256_of(weights) != sha256:
        raise CheckpointError(f"{weights} does not match its description: damaged or mixed up, copy the folder again")


def load_state(module: nn.Module, folder: Path, kind: str) -> None:
    try:
        module.load_state_dict(expanded(load_tensors(folder / WEIGHTS, kind)))
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise CheckpointError(f"{kind} in {folder} does not fit its own settings: {reason}") from error


def read_target(folder: Path) -> TargetDescription:
    """Return the description of a target, and check its weights as its family does (`TargetPart.check_weights`)."""
    description = described(folder, "target", TargetDescription)
    family = TargetPart.every().get(description.family)
    if family is not None and family.check_weights is not None:
        family.check_weights(folder, description)
    else:
        check_weights(folder, "target", description.sha256)
    return description


def load_target(folder: Path, device: str = "cpu", dtype: torch.dtype | None = None) -> tuple[Any, TargetDescription]:
    """Load a target for inference. Its weights become float32 if `dtype` is None."""
    import torch

    description = read_target(folder)
    part = TargetPart.find(description.family, "target family")
    return part.built(folder, description, device, dtype or torch.float32), description
