"""Write and read the folder of a compact target: its weights and `target.json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from kerv_cli.base.manifests import read
from kerv_cli.targets.checkpoint import FLOAT32, TargetDescription, save_module, target_fields
from kerv_cli.targets.compact.compilable import load_compiled
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
    """Write a target's weights and `target.json`. Return the SHA-256 of the weights.

    Args:
        folder: Folder to write to.
        target: The target.
        environment: Name of the environment that the target's demonstrations come from.
        provenance: How the target was made, see `provenance_of`.
        stored: Number format of the stored weights: float32, float16 or int8.
        state_range: The 0.1th percentile of each number of the demonstrations' states, then the 99.9th percentile of
            each. None: not recorded.
    """
    others: dict[str, Any] = {"cameras": target.cameras, "words": target.words.words, "provenance": provenance}
    if state_range:
        others["state_range"] = state_range
    spaces = target.actions, target.observation
    fields = target_fields("compact", asdict(target.settings), environment, *spaces, **others)
    return save_module(folder, "target", target, fields, stored)


def build(folder: Path, description: TargetDescription, device: str, dtype: torch.dtype) -> CompactTarget:
    """Load a compact target for inference. The target is frozen and, on a CPU, compiled.

    Args:
        folder: Folder with the weights.
        description: The content of its `target.json`.
        device: Device to load it to.
        dtype: Number format to convert the weights to.

    Raises:
        CheckpointError: The description does not belong to a compact target, or the weights do not fit it.
    """
    settings = read(TargetSettings, description.settings, str(folder / "target.json"))
    camera = description.cameras[0] if description.cameras else ""
    words = WordTokenizer(description.words)
    target = CompactTarget(settings, description.actions, description.observation, words, camera)
    target.sha256 = description.sha256
    return load_compiled(target, folder, "target", device, dtype)
