"""Settings of targets that come from elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from kerv_cli.base.limits import choice, number, setting
from kerv_cli.base.settings import CommandSettings, RunSettings


@dataclass
class GrowSettings:
    """The larger trunk of a grown target (docs/methods.md §0.2)."""

    width: int = number(0, 0, 65_536, help="of the layers; 0: nothing grows")
    heads: int = number(0, 0, 1024, help="attention heads of a layer")
    feed_forward: int = number(0, 0, 262_144, help="hidden units of a layer")
    layers: int = number(0, 0, 1024, help="decoder layers")
    drafter: bool = setting(False, "grow the drafter's layers too, to the same shape")


@dataclass
class BuildTargetSettings(RunSettings):
    """Settings of `kerv build target`: a published checkpoint, or a larger copy of a policy, becomes a target."""

    groups: ClassVar = {"grow": "none", "runtime": "cpu"}

    checkpoint: str = setting("", "folder of a Hugging Face checkpoint")
    family: str = setting("openvla", "kind of target")
    grow: GrowSettings = setting(GrowSettings, "shape to grow policy.target to: 60m, 150m, 1b, openvla-7b (conf/grow)")
    base: str = setting("mt10-vision", "the policy that grows")
    name: str = setting("openvla", "folder below <results>/artifacts/target, or a path")
    statistics: str | None = setting(None, "data set whose actions it emits; null: the only one there is")
    environment: str | None = setting(
        None, "environment whose DoFs, control rate and camera it gets; null: OpenVLA's own"
    )
    control_hz: float = number(5.0, above=0, most=10_000, help="control steps per second, without an environment")
    camera: str = setting("", "camera whose image it sees; empty: the environment's first, else primary")
    prompt: str = choice("openvla", "openvla", "openvla_v01", help="text around the instruction")
    crop: bool = setting(False, "show the central 90 %, for checkpoints fine-tuned with augmented images (LIBERO's)")
    libero: bool = setting(
        False, "before that send it through JPEG and Lanczos, as OpenVLA's evaluation on LIBERO does"
    )
    int8: bool = setting(False, "keep the language model's layers in one byte per weight")
    prompt_tokens: int = number(64, 1, 65_536, help="longest prompt, without the vision tokens")


@dataclass
class BuildPolicySettings(CommandSettings):
    """Settings of `kerv build policy`: fetch a released policy that the wheel leaves out."""

    source: str = setting("", "archive of the policy's folder (.tar.gz), by URL or path")
    sha256: str = setting("", "SHA-256 of the archive; not needed for kerv's own policies")
