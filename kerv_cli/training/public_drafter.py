"""`kerv build drafter`: a drafter of the public layout, checked against a target and copied beside it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import write_json
from kerv_cli.base.provenance import provenance
from kerv_cli.base.runtime import set_up
from kerv_cli.base.settings import BuildDrafterSettings, DrafterSettings
from kerv_cli.methods.artifacts import Artifacts
from kerv_cli.methods.eagle.public import Convention, read_public, save_public
from kerv_cli.targets.checkpoint import FORMAT


def import_drafter(settings: BuildDrafterSettings) -> tuple[Path, dict[str, Any]]:
    """Writes the drafter's folder -> the folder, and figures for the user.

    Raises:
        UsageError: no checkpoint. UnknownName: no such convention. CheckpointError: no such target, an incomplete,
            damaged or pickled drafter, or one of another width.
    """
    if not settings.checkpoint:
        raise UsageError("checkpoint=DIR: name the folder of a drafter (config.json, model.safetensors)")
    convention = Convention(settings.positions, settings.mask).check()
    device, _ = set_up(settings.runtime)
    artifacts = Artifacts(settings.results, settings.policy, device=device, dtype=settings.runtime.dtype)
    target: Any = artifacts.target
    shape, tensors = read_public(Path(settings.checkpoint).expanduser(), target, convention)
    folder = artifacts.place("drafter")
    digest = save_public(folder, tensors)
    parameters = sum(tensor.numel() for tensor in tensors.values())
    description = {
        "format": FORMAT,
        "kind": "drafter",
        "sha256": digest,
        "settings": asdict(DrafterSettings(kind="public", layers=shape.language.num_hidden_layers)),
        "target": artifacts.description.sha256,
        "actions": target.actions.as_dict(),
        "provenance": {
            "command": "kerv build drafter",
            "settings": asdict(settings),
            "parameters": parameters,
            **provenance(device),
        },
        "public": asdict(shape),
    }
    write_json(folder / "drafter.json", description)
    figures = {"parameters": parameters, "layers": shape.language.num_hidden_layers, **asdict(convention)}
    return folder, figures
