"""Settings of compact targets, and of `kerv build target`, which makes targets that are not trained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, number, setting
from kerv_cli.base.settings import REPLACE, RunSettings


@dataclass
class TargetSettings:
    """Shapes of the compact target (docs/methods.md §0.1). Each file in `conf/target` is a ready-made set of shapes."""

    size: str = setting("small", "name of these shapes")
    observation: str = choice("vision", "vision", "state", help="read images, or the simulator's state")
    width: int = number(192, 2, 65_536, help="width E of the embeddings and hidden states")
    layers: int = number(8, 1, 1024, help="decoder layers")
    heads: int = number(6, 1, 1024, help="attention heads")
    feed_forward: int = number(512, 1, 262_144, help="hidden units of a layer's feed-forward part")
    chunk: int = number(4, 1, 1024, help="H, control steps per decode")
    code: str = choice("bins", "bins", "fast", help="tokens: a bin per number, or a FAST code of the whole chunk")
    grid: int = number(4, 1, 512, help="vision tokens per side")
    keypoints: int = number(32, 1, 4096, help="points that the vision encoder finds in an image (spatial soft-argmax)")
    channels: int = number(24, 1, 4096, help="width of the vision encoder's first stage")
    norm: str = choice("group", "group", "instance", help="vision encoder's norm; instance: least sensitive to light")
    scene_tokens: int = number(4, 1, 1024, help="prompt tokens that hold the positions of object and goal")
    instruction_tokens: int = number(10, 1, 1024, help="longest instruction in words")
    image_size: int = number(96, 8, 4096, help="pixels per side of a camera view")
    parallel: bool = setting(False, "decode all tokens of a chunk at once (docs/methods.md §6)")

    def check_together(self, prefix: str) -> None:
        if self.parallel and self.code != "bins":
            raise UsageError(f"{prefix}parallel=true: chunks of {prefix}code={self.code} differ in length; use bins")
        if self.width % (2 * self.heads):
            raise UsageError(f"{prefix}width={self.width} must be a multiple of 2 x {prefix}heads={self.heads}")
        if self.observation == "vision" and self.image_size % (8 * self.grid):
            raise UsageError(f"{prefix}image_size={self.image_size} must be a multiple of 8 x {prefix}grid={self.grid}")


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
    base: str = setting("mt10-h1", "the policy that is enlarged")
    name: str = setting("openvla", "name of the new folder in <results>/artifacts/target")
    replace: bool = setting(False, REPLACE)
    statistics: str | None = setting(None, "data set whose action statistics it uses; null: the only one in it")
    environment: str | None = setting(
        None, "environment whose DoFs, control rate and camera it uses; null: OpenVLA's own"
    )
    control_hz: float = number(5.0, above=0, most=10_000, help="control steps per second, if environment= is null")
    camera: str = setting("", "camera whose image it reads; empty: the environment's first, else primary")
    crop: bool = setting(False, "crop to the central 90 %, for checkpoints trained on augmented images (LIBERO's)")
    libero: bool = setting(
        False, "first compress the image as JPEG and resize it by Lanczos, as OpenVLA's evaluation on LIBERO does"
    )
    prompt_tokens: int = number(64, 1, 512, help="longest prompt in tokens, without the vision tokens")
