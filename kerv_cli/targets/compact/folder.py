"""The folder of a compact target: `save_target` writes it, `build` reads it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from kerv_cli.base.manifests import read
from kerv_cli.targets.checkpoint import FLOAT32, TargetDescription, save_module, target_fields
from kerv_cli.targets.compact.packable import load_packed
from kerv_cli.targets.compact.settings import TargetSettings
from kerv_cli.targets.compact.target import CompactTarget
from kerv_cli.targets.compact.text import WordTokenizer


def save_target(
    folder: Path,
    target: CompactTarget,
    environment: str,
    provenance: dict[str, Any],
    stored: str = FLOAT32,
    state_range: Sequence[Sequence[float]] | None = None,
) -> str:
    """Writes the folder of a target -> sha256 of its weights. environment: that of its demonstrations. stored: as in
    `save_module`. state_range: as in `TargetDescription`."""
    others: dict[str, Any] = {"cameras": target.cameras, "words": target.words.words, "provenance": provenance}
    if state_range:
        others["state_range"] = state_range
    spaces = target.actions, target.observation
    fields = target_fields("compact", asdict(target.settings), environment, *spaces, **others)
    return save_module(folder, "target", target, fields, stored)


def build(folder: Path, description: TargetDescription, device: str, dtype: torch.dtype) -> CompactTarget:
    """The target in `folder`, frozen and packed for inference.

    Raises:
        CheckpointError: the description is not a compact target's, or the weights do not fit it.
    """
    settings = read(TargetSettings, description.settings, str(folder / "target.json"))
    camera = description.cameras[0] if description.cameras else ""
    words = WordTokenizer(description.words)
    target = CompactTarget(settings, description.actions, description.observation, words, camera)
    target.sha256 = description.sha256
    return load_packed(target, folder, "target", device, dtype)
