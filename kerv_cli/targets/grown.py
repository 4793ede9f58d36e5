"""A grown target: a trained policy whose trunk is enlarged, so that it costs more but gives the same tokens.

It shows how a method behaves at the speed of a larger model (docs/methods.md §0.2). Only the trunk's layers grow: they
get additional channels that stay zero, additional heads and hidden units whose output weights are zero, and further
layers that add nothing. A longer prompt consists of masked tokens, which a prefill computes and drops. The outputs are
equal except for rounding, but every weight is read and multiplied. The folder of a grown target contains only a recipe.
The weights are made when the target is loaded (`compact/growth.py`).
"""

from __future__ import annotations

import functools
import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import write_json
from kerv_cli.base.manifests import read
from kerv_cli.base.paths import find_target
from kerv_cli.targets import checkpoint
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.targets.settings import BuildTargetSettings, GrowSettings

if TYPE_CHECKING:
    import torch

    from kerv_cli.targets.compact.target import CompactTarget


@dataclass
class Recipe(GrowSettings):
    """The recipe of a grown target: the shape of the new trunk, and the folder and hash of the target that grows."""

    base: str = ""
    sha256: str = ""


def recipe_of(description: TargetDescription) -> Recipe:
    return read(Recipe, description.settings.get("grown", {}), "a grown target's recipe")


def check_weights(folder: Path, description: TargetDescription) -> None:
    recipe = recipe_of(description)
    if checkpoint.read_target(Path(recipe.base)).sha256 != recipe.sha256:
        raise CheckpointError(f"{folder} grows from {recipe.base}, whose weights are others now: build it again")


def build(folder: Path, description: TargetDescription, device: str, dtype: torch.dtype) -> CompactTarget:
    """Load the original policy, which the recipe of a grown target names, and enlarge its trunk."""
    from kerv_cli.targets.compact.growth import enlarge, grow_trunk
    from kerv_cli.targets.compact.program import compile_parts
    from kerv_cli.targets.compact.target import build as build_compact

    recipe = recipe_of(description)
    base = Path(recipe.base)
    target = build_compact(base, checkpoint.read_target(base), device, dtype)
    grow_trunk(target, recipe)
    if recipe.drafter:
        target.enlarges = functools.partial(enlarge, recipe=recipe, padding=target.trunk.padding)
    compile_parts(target)
    return target


def grow(settings: BuildTargetSettings, folder: Path) -> dict[str, Any]:
    """Write a grown target's recipe, for `kerv build target grow=SHAPE`. Return numbers to print, by name."""
    import torch

    from kerv_cli.targets.compact.growth import grow_trunk
    from kerv_cli.targets.compact.target import build as build_compact

    base = find_target(settings.results, settings.base).resolve()
    description = checkpoint.read_target(base)
    if description.family != "compact":
        raise UsageError(f"policy.target={settings.base} is of family {description.family}: only compact ones grow")
    recipe = Recipe(**asdict(settings.grow), base=str(base), sha256=description.sha256)
    target = build_compact(base, description, "cpu", torch.float32)
    grow_trunk(target, recipe)
    identity = asdict(recipe) | {"base": ""}
    if not recipe.prompt:
        del identity["prompt"]  # targets that were grown before this setting existed keep their hash
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
    grown = {**description.settings, "grown": asdict(recipe)}
    write_json(folder / "target.json", asdict(replace(description, family="grown", settings=grown, sha256=digest)))
    weights = sum(p.numel() for p in target.trunk.layers.parameters() if p.dim() == 2)
    return {"weights": weights, "weights of the policy": description.provenance.get("parameters", 0)}
