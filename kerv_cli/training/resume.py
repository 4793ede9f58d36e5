"""The resume file of a training: weights, moments and progress together, so that a kill cannot tear them apart."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.manifests import read
from kerv_cli.targets.checkpoint import load_tensors, save_tensors
from kerv_cli.targets.folders import RESUME

Metrics = dict[str, float]

_UNREADABLE = (SafetensorError, OSError, KeyError, TypeError, ValueError)


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    Attributes:
        identity: Hash of everything that determines the run.
        step: Steps done.
        history: Metrics of every validation.
    """

    identity: str
    step: int
    history: list[Metrics]


def stored_identity(folder: Path) -> str | None:
    """Return the identity of the run in the folder without reading its tensors; None if there is none to read."""
    try:
        return str(json.loads(_state(folder / RESUME)["progress"])["identity"])
    except _UNREADABLE:
        return None


def write_state(path: Path, tensors: Mapping[str, Tensor], progress: Progress) -> None:
    """Write tensors and progress into one file."""
    text = json.dumps(asdict(progress), allow_nan=False)
    # one key: safetensors orders several at random, and equal states must be equal bytes
    save_tensors(path, tensors, {"state": json.dumps({"progress": text, "sha256": digest(tensors, text)})})


def read_state(path: Path) -> tuple[dict[str, Tensor], Progress]:
    """Read what `write_state` wrote.

    Raises:
        CheckpointError: The file is damaged, or holds numbers that are not finite.
    """
    try:
        state = _state(path)
        tensors, text = load_tensors(path, "training state"), state["progress"]
        if state["sha256"] != digest(tensors, text):
            raise ValueError("its hash does not fit")
        return tensors, read(Progress, json.loads(text), str(path), tolerant=True)
    except _UNREADABLE as error:
        remedy = f"move {path.parent} aside to begin again"
        raise CheckpointError(f"training state at {path} is damaged ({error}): {remedy}") from error


def _state(path: Path) -> dict[str, str]:
    with safe_open(path, "pt") as file:
        state: dict[str, str] = json.loads((file.metadata() or {})["state"])
    return state


def digest(tensors: Mapping[str, Tensor], text: str) -> str:
    """Return the SHA-256 over names, types, shapes and bytes of tensors, and a text."""
    hasher = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        hasher.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        hasher.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return hasher.hexdigest()
