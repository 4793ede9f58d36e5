"""Settings of targets that come from elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import choice, number, setting
from kerv_cli.base.settings import CommandSettings, RunSettings


@dataclass
class BuildTargetSettings(RunSettings):
    """`kerv build target`: a published checkpoint as a target of ours. Nothing is copied: it stays where it lies."""

    checkpoint: str = setting("", "folder of a Hugging Face checkpoint")
    family: str = setting("openvla", "kind of target")
    name: str = setting("openvla", "folder below <results>/artifacts/target, or a path")
    statistics: str | None = setting(None, "data set whose actions it emits; null: the only one")
    environment: str | None = setting(None, "whose DoFs, control rate and camera it has; null: OpenVLA's own")
    control_hz: float = number(5.0, above=0, most=10_000, help="control steps per second, without an environment")
    camera: str = setting("", "image it is shown; empty: the environment's first camera, else primary")
    prompt: str = choice("openvla", "openvla", "openvla_v01", help="text around the instruction")
    crop: bool = setting(False, "show the central 90 %: for checkpoints fine-tuned with augmented images (LIBERO's)")
    libero: bool = setting(False, "before that a JPEG round trip and Lanczos, as OpenVLA's evaluation on LIBERO does")
    int8: bool = setting(False, "the language model's layers with one byte per weight")
    prompt_tokens: int = number(64, 1, 65_536, help="longest prompt, without the vision tokens")


@dataclass
class BuildPolicySettings(CommandSettings):
    """`kerv build policy`: a policy of a release, which a wheel leaves out."""

    source: str = setting("", "archive of the policy's folder (.tar.gz), by URL or path")
    sha256: str = setting("", "of the archive; of a policy of kerv's the weights' hashes suffice")
