"""Checkpoints: safetensors + one JSON with settings, statistics, vocabulary and provenance. Nothing is pickled."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import nn

from kerv_cli.errors import CheckpointError
from kerv_cli.files import atomic_path, read_json, sha256_of, write_json
from kerv_cli.settings import TargetSettings
from kerv_cli.spaces import ActionTokenizer
from kerv_cli.targets.compact.layout import lay_out_for_inference
from kerv_cli.targets.compact.target import Target
from kerv_cli.targets.compact.text import WordTokenizer

FORMAT = 1


def save_tensors(path: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Atomic safetensors file."""
    payload = save({k: v.detach().cpu().contiguous() for k, v in tensors.items()})
    with atomic_path(path) as temporary:
        temporary.write_bytes(payload)


def load_tensors(path: Path, what: str) -> dict[str, torch.Tensor]:
    if not path.is_file():
        raise CheckpointError(f"no {what} at {path}: train it, or name another with its folder")
    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{what} at {path} is damaged ({error}): delete it and train or copy it again") from error


def save_module(folder: Path, kind: str, module: nn.Module, description: dict[str, Any]) -> str:
    """Write `model.safetensors` and `<kind>.json` -> sha256 of the weights. The JSON is written last."""
    folder.mkdir(parents=True, exist_ok=True)
    save_tensors(folder / "model.safetensors", dict(module.state_dict()))
    digest = sha256_of(folder / "model.safetensors")
    write_json(folder / f"{kind}.json", {"format": FORMAT, "kind": kind, "sha256": digest, **description})
    return digest


def read_description(folder: Path, kind: str) -> dict[str, Any]:
    """The JSON beside the weights, checked against them."""
    path = folder / f"{kind}.json"
    if not path.is_file():
        raise CheckpointError(f"no {kind} in {folder}: run 'kerv train {kind}', or name a folder that holds one")
    description = read_json(path)
    if description.get("format") != FORMAT or description.get("kind") != kind:
        raise CheckpointError(f"{path} is not a {kind} of format {FORMAT}: it was written by another version of kerv")
    weights = folder / "model.safetensors"
    if not weights.is_file():
        raise CheckpointError(f"{weights} is missing: the {kind} is incomplete, train or copy it again")
    if sha256_of(weights) != description["sha256"]:
        raise CheckpointError(f"{weights} does not match its description: damaged or mixed up, copy the folder again")
    return description


def load_state(module: nn.Module, folder: Path, kind: str) -> None:
    """Fill `module` with the folder's weights; a tensor of another name or shape is an error."""
    try:
        module.load_state_dict(load_tensors(folder / "model.safetensors", kind))
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise CheckpointError(f"{kind} in {folder} does not fit its own settings: {reason}") from error


def describe_target(target: Target, provenance: dict[str, Any]) -> dict[str, Any]:
    return {
        "settings": asdict(target.settings),
        "actions": {"low": target.actions.low.tolist(), "high": target.actions.high.tolist()},
        "words": list(target.words.words),
        "provenance": provenance,
    }


def save_target(folder: Path, target: Target, provenance: dict[str, Any]) -> str:
    return save_module(folder, "target", target, describe_target(target, provenance))


def load_target(folder: Path, device: str = "cpu", dtype: torch.dtype = torch.float32) -> tuple[Target, dict[str, Any]]:
    """The policy, ready for inference, and its description (settings, provenance, sha256)."""
    description = read_description(folder, "target")
    try:
        settings = TargetSettings(**description["settings"])
        actions = ActionTokenizer(*(np.asarray(description["actions"][k]) for k in ("low", "high")))
        target = Target(settings, actions, WordTokenizer(tuple(description["words"])))
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{folder / 'target.json'} is not a target's description ({error})") from error
    load_state(target, folder, "target")
    target = target.to(device=device, dtype=dtype).eval().requires_grad_(False)
    lay_out_for_inference(target)
    return target, description
