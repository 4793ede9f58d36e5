"""`kerv build target`: checks a published OpenVLA folder and describes it as a target."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import write_json
from kerv_cli.base.places import artifact
from kerv_cli.base.registry import find, load
from kerv_cli.base.spaces import ObservationSpace
from kerv_cli.targets.checkpoint import FORMAT, target_fields
from kerv_cli.targets.openvla.config import action_space, read_shape, read_statistics
from kerv_cli.targets.openvla.image import read_normalisations
from kerv_cli.targets.openvla.loading import check_finite, digest_of, open_checked
from kerv_cli.targets.openvla.prompt import Prompter
from kerv_cli.targets.openvla.target import OpenVLASettings
from kerv_cli.targets.provenance import provenance
from kerv_cli.targets.settings import BuildTargetSettings

NO_STATE = ObservationSpace(proprioception=(), state=0, places=(), centre=(0.0, 0.0, 0.0))


def import_checkpoint(settings: BuildTargetSettings) -> tuple[Path, dict[str, Any]]:
    """Write target.json for the checkpoint. Every number of the weights is read once.

    Returns:
        The target's folder, and figures for the user.

    Raises:
        UsageError: There is no checkpoint, or several statistics and none chosen.
        UnknownName: There are no such statistics, or no such environment.
        CheckpointError: The folder is incomplete, damaged, pickled or another model's.
    """
    if not settings.checkpoint:
        raise UsageError("checkpoint=DIR: name the folder of a Hugging Face OpenVLA checkpoint")
    source = Path(settings.checkpoint).expanduser().resolve()
    shape = read_shape(source)
    spec = None if settings.environment is None else load(find("environment", settings.environment).build)
    statistics, bounds = read_statistics(source, settings.statistics)
    actions = action_space(shape, bounds, spec.actions if spec else None, settings.control_hz)
    prompt = Prompter(source, shape, settings.prompt, settings.prompt_tokens).ids("move")
    read_normalisations(source)
    shards = open_checked(source, shape)
    parameters, hashes = check_finite(shards), shards.hashes()
    computed = {"prompt": settings.prompt, "crop": settings.crop, "int8": settings.int8}
    if settings.libero:  # hashes of older targets lack it
        computed["libero"] = True
    target = OpenVLASettings(
        checkpoint=str(source),
        statistics=statistics,
        files=shards.sizes(),
        prompt=settings.prompt,
        crop=settings.crop,
        libero=settings.libero,
        int8=settings.int8,
        prompt_tokens=settings.prompt_tokens,
        image_size=shape.towers[0].image,
    )
    origin = {"command": "kerv build target", "settings": asdict(settings), "files": hashes, "parameters": parameters}
    fields = target_fields(
        "openvla",
        asdict(target),
        spec.name if spec else "none",
        actions,
        spec.observation if spec else NO_STATE,
        cameras=[spec.camera_name(settings.camera) if spec else settings.camera or "primary"],
        provenance={**origin, **provenance(settings.runtime.device)},
    )
    folder = artifact(settings.results, "target", settings.name)
    described = {"format": FORMAT, "kind": "target", "sha256": digest_of(hashes, computed), **fields}
    write_json(folder / "target.json", described)
    tokens = shape.patches + len(prompt)
    figures = {"parameters": parameters, "prompt tokens": tokens, "action tokens": actions.tokens, "DoFs": actions.dofs}
    return folder, figures
