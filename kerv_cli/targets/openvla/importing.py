"""`kerv build target`: checks a published OpenVLA folder and describes it as a target."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import write_json
from kerv_cli.base.places import artifact
from kerv_cli.base.provenance import provenance
from kerv_cli.base.registry import find, load
from kerv_cli.base.spaces import ObservationSpace
from kerv_cli.targets.checkpoint import FORMAT, target_fields
from kerv_cli.targets.openvla.config import action_space, read_shape, read_statistics
from kerv_cli.targets.openvla.image import read_normalisations
from kerv_cli.targets.openvla.loading import check_finite, check_layout, digest_of, layout, open_shards
from kerv_cli.targets.openvla.prompt import Prompter
from kerv_cli.targets.openvla.target import OpenVLASettings
from kerv_cli.targets.settings import BuildTargetSettings

NO_STATE = ObservationSpace(proprioception=(), state=0, places=(), centre=(0.0, 0.0, 0.0))


def import_checkpoint(settings: BuildTargetSettings) -> tuple[Path, dict[str, Any]]:
    """Writes target.json for the checkpoint -> its folder, and figures for the user. Every number is read once.

    Raises:
        UsageError: no checkpoint, several statistics and none chosen. UnknownName: no such
            statistics or environment. CheckpointError: the folder is incomplete, damaged, pickled or another model's.
    """
    if not settings.checkpoint:
        raise UsageError("checkpoint=DIR: name the folder of a Hugging Face OpenVLA checkpoint")
    source = Path(settings.checkpoint).expanduser().resolve()
    shape = read_shape(source)
    spec = None if settings.environment is None else load(find("environment", settings.environment).build)
    statistics = read_statistics(source, settings.statistics)
    actions = action_space(shape, statistics, spec.actions if spec else None, settings.control_hz)
    prompter = Prompter(source, shape, settings.prompt, settings.prompt_tokens)
    prompter.ids("move")
    read_normalisations(source)
    shards = open_shards(source)
    check_layout(shards.shapes, layout(shape), source)
    parameters, hashes = check_finite(shards), shards.hashes()
    target_settings = OpenVLASettings(
        checkpoint=str(source),
        statistics=statistics.name,
        files=shards.sizes(),
        prompt=settings.prompt,
        crop=settings.crop,
        libero=settings.libero,
        int8=settings.int8,
        prompt_tokens=settings.prompt_tokens,
        image_size=shape.towers[0].image,
    )
    origin = {"command": "kerv build target", "settings": asdict(settings), "files": hashes, "parameters": parameters}
    folder = artifact(settings.results, "target", settings.name)
    fields = target_fields(
        "openvla",
        asdict(target_settings),
        spec.name if spec else "none",
        actions,
        spec.observation if spec else NO_STATE,
        cameras=[spec.camera_name(settings.camera) if spec else settings.camera or "primary"],
        provenance={**origin, **provenance(settings.runtime.device)},
    )
    computed = {"prompt": settings.prompt, "crop": settings.crop, "int8": settings.int8}
    if settings.libero:  # hashes of older targets lack it
        computed["libero"] = True
    digest = digest_of(hashes, computed)
    write_json(folder / "target.json", {"format": FORMAT, "kind": "target", "sha256": digest, **fields})
    prompt = shape.patches + len(prompter.ids("move"))
    figures = {"parameters": parameters, "prompt tokens": prompt, "action tokens": actions.tokens, "DoFs": actions.dofs}
    return folder, figures
