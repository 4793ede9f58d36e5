"""`kerv build drafter`: a drafter of the public layout, checked against a target and copied beside it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.provenance import provenance_of
from kerv_cli.base.runtime import set_up
from kerv_cli.methods.artifacts import Artifacts, MadeFor
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.drafter import DrafterArtifact
from kerv_cli.methods.eagle.public import Convention, PublicDrafter, read_public
from kerv_cli.training.settings import BuildDrafterSettings


def import_drafter(settings: BuildDrafterSettings) -> tuple[Path, dict[str, Any]]:
    """Writes the drafter's folder -> the folder, and figures for the user.

    Raises:
        UsageError: no checkpoint. CheckpointError: no such target, an incomplete,
            damaged or pickled drafter, or one of another width.
    """
    if not settings.checkpoint:
        raise UsageError("checkpoint=DIR: name the folder of a drafter (config.json, model.safetensors)")
    convention = Convention(settings.positions, settings.mask)
    device, _ = set_up(settings.runtime)
    artifacts = Artifacts(settings.results, settings.policy, device=device, dtype=settings.runtime.dtype)
    target: Any = artifacts.target
    shape, tensors = read_public(Path(settings.checkpoint).expanduser(), target, convention)
    folder = artifacts.path("drafter")
    drafter = PublicDrafter(shape)
    drafter.load_state_dict(tensors, assign=True)  # stored in their own number format
    parameters = sum(tensor.numel() for tensor in tensors.values())
    provenance = provenance_of("kerv build drafter", settings, device, parameters=parameters)
    made_for = MadeFor.of(artifacts.description)
    shapes = asdict(DrafterSettings(kind="public", layers=shape.language.num_hidden_layers))
    DrafterArtifact().save(folder, drafter, made_for, provenance, settings=shapes, public=asdict(shape))
    return folder, {"parameters": parameters, "layers": shape.language.num_hidden_layers, **asdict(convention)}
