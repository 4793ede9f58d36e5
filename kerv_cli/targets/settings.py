"""Settings of `kerv build target`, which makes targets that are not trained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, number, setting
from kerv_cli.base.settings import RunSettings


@dataclass
class GrowSettings:
    """Shape of the enlarged trunk of a grown target (docs/methods.md §0.2)."""

    width: int = number(0, 0, 65_536, help="width of the layers; 0: the trunk is not enlarged")
    heads: int = number(0, 0, 1024, help="attention heads of a layer")
    feed_forward: int = number(0, 0, 262_144, help="hidden units of a layer")
    layers: int = number(0, 0, 1024, help="decoder layers")
    drafter: bool = setting(False, "enlarge the drafter's layers too, to the same shape")
    prompt: int = number(0, 0, 4096, help="prompt tokens that a prefill pays for; 0: as many as there are")


@dataclass
class BuildTargetSettings(RunSettings):
    """Settings of `kerv build target`, which imports a published checkpoint or enlarges a policy."""

    groups: ClassVar = {"grow": "none", "runtime": "cpu"}

    checkpoint: str = setting("", "folder of a Hugging Face checkpoint")
    family: str = setting("openvla", "kind of target")
    grow: GrowSettings = setting(GrowSettings, "enlarge policy.target to this shape: 60m, 150m, 1b, openvla-7b")
    base: str = setting("mt10-vision", "the policy that is enlarged")
    name: str = setting("openvla", "name of the new folder in <results>/artifacts/target")
    statistics: str | None = setting(None, "data set whose action statistics it uses; null: the only one in it")
    environment: str | None = setting(
        None, "environment whose DoFs, control rate and camera it uses; null: OpenVLA's own"
    )
    control_hz: float = number(5.0, above=0, most=10_000, help="control steps per second, if environment= is null")
    camera: str = setting("", "camera whose image it reads; empty: the environment's first, else primary")
    prompt: str = choice("openvla", "openvla", "openvla_v01", help="text around the instruction")
    crop: bool = setting(False, "crop to the central 90 %, for checkpoints trained on augmented images (LIBERO's)")
    libero: bool = setting(
        False, "first compress the image as JPEG and resize it by Lanczos, as OpenVLA's evaluation on LIBERO does"
    )
    int8: bool = setting(False, "store the language model's layers with one byte per weight")
    check: bool = setting(False, "compare tokens and logits with the transformers package; loads the weights twice")
    prompt_tokens: int = number(64, 1, 65_536, help="longest prompt in tokens, without the vision tokens")

    def check_together(self, prefix: str) -> None:
        """Check settings that depend on each other.

        Args:
            prefix: Start of the settings' names in error messages.

        Raises:
            UsageError: `check` is set, but the target is not made from an OpenVLA checkpoint.
        """
        if self.check and (self.family != "openvla" or self.grow.width):
            raise UsageError(f"{prefix}check=true compares checkpoints of OpenVLA: name one with checkpoint=DIR")
