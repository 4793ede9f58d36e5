"""Settings of the benchmark."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, number, setting
from kerv_cli.base.settings import CommandSettings, RunSettings
from kerv_cli.bench.physics import CHUNK, DEVICES, SHAPES, SHARE

PROJECTIONS = {name: [device.bandwidth / 1e9, device.flops / 1e12] for name, device in DEVICES.items()}


@dataclass
class BenchSettings(RunSettings):
    """Settings of `kerv bench`, which compares a target's measured times with the shortest that the device allows."""

    target: str = setting("mt10-vision", "a policy, or a shape of conf/target with random weights")
    dtype: str = choice(
        "auto", "auto", "float32", "bfloat16", "float16", help="number format of a shape; auto: bfloat16 on a GPU"
    )
    repeats: int = number(30, 3, 100_000, help="repeats of every measurement, for medians and 95th percentiles")
    tokens: int = number(16, 4, 256, help="N, tokens of a shape's chunk, at least")
    projected: str = choice("none", "none", *SHAPES, help="compute its times on GPUs, measure nothing")
    projections: dict[str, list[float]] = setting(PROJECTIONS, "GPU -> published GB/s and dense bfloat16 TFLOP/s")
    share: float = number(
        SHARE, above=0, most=1, help="share of these that a computed profile reaches (gpt-fast, Llama-2 7B, A100: 0.69)"
    )

    def check_together(self, prefix: str) -> None:
        """Check settings that depend on each other.

        Args:
            prefix: Start of the settings' names in error messages.

        Raises:
            UsageError: A device of `projections` does not have two positive numbers.
        """
        for name, figures in self.projections.items():
            if len(figures) != 2 or min(figures) <= 0:
                raise UsageError(f"{prefix}projections.{name}={figures}: two numbers above 0, GB/s and TFLOP/s")


@dataclass
class EstimateSettings(CommandSettings):
    """Settings of `kerv estimate`, which computes how much speculation can speed up a policy. Nothing is run."""

    weights: str = setting("", "weights of the policy, encoder included: 7B, 450M; the rest of its shape is assumed")
    model: str = setting("", "instead: a Hugging Face config.json or its folder, a target of kerv, or openvla-7b")
    tokens: int | None = number(
        None, 0, CHUNK, help="N, tokens per chunk; default: the model's, else 7. 0: it has none"
    )
    actions: int = number(1, 1, 1000, help="control steps per chunk")
    hz: float | None = number(None, above=0, help="control steps per second that the robot asks for")
    prompt: int | None = number(None, 1, 100_000, help="prompt tokens, the image's included")
    vision: str = setting("", "vision encoder: its weights (400M), or its time (8ms)")
    bits: int = number(16, 1, 32, help="bits of a weight of the language model; arithmetic stays in bfloat16")
    device: list[str] = setting(["h100"], f"GPUs: {', '.join(DEVICES)}")
    on: list[str] = setting([], "instead: profiles of 'kerv bench', as on= of 'kerv report'")
    trace: str = setting("", "price the decodes of this file, see docs/trace.md")
    choose: str = choice("none", "none", "draft", help="draft: which length of drafted chains the trace's decodes want")

    def check_together(self, prefix: str) -> None:
        """Check settings that depend on each other.

        Args:
            prefix: Start of the settings' names in error messages.

        Raises:
            UsageError: A device is unknown, `choose` is set without `trace`, or `on` is set together with a policy.
        """
        if self.choose != "none" and not self.trace:
            raise UsageError(f"{prefix}choose={self.choose} needs trace=FILE", f"{prefix}choose")
        if self.on and (described := [key for key in ("weights", "model", "vision") if getattr(self, key)]):
            raise UsageError(f"{prefix}on=PROFILE has the costs: leave out {', '.join(described)}", f"{prefix}on")
        for name in self.device:
            if name not in DEVICES:
                raise UsageError(f"{prefix}device={name}: known are {', '.join(DEVICES)}", f"{prefix}device")
