"""Settings of the benchmark."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, limits, number, setting
from kerv_cli.base.settings import CommandSettings, RunSettings
from kerv_cli.bench.physics import CHUNK, DEVICES, SHAPES, SHARE

PROJECTIONS = {name: [device.bandwidth / 1e9, device.flops / 1e12] for name, device in DEVICES.items()}


@dataclass
class BenchSettings(RunSettings):
    """Settings of `kerv bench`, which compares a target's measured times with the shortest that the device allows."""

    target: str = setting("mt10-h1", "a policy, or a shape of conf/target with random weights")
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
        for name, figures in self.projections.items():
            if len(figures) != 2 or min(figures) <= 0:
                raise UsageError(f"{prefix}projections.{name}={figures}: two numbers above 0, GB/s and TFLOP/s")


@dataclass
class EstimateSettings(CommandSettings):
    """Settings of `kerv estimate`, which computes how much verified drafts can speed up a policy. Nothing is run."""

    weights: str = setting("", f"size of the policy, such as 7B or 450M, or one of {', '.join(SHAPES)}")
    code: str = choice(
        "bins", "bins", "fast", "flow", help="what the policy emits: tokens per number, FAST, or no tokens"
    )
    tokens: int | None = number(None, 0, CHUNK, help="N, tokens per chunk; default: 7, FAST 30; 0: as code=flow")
    device: list[str] = setting(["h100"], f"GPUs: {', '.join(DEVICES)}")
    hz: float | None = number(None, above=0, help="control steps per second that the robot needs")
    actions: int = number(1, 1, 1000, help="control steps per chunk")
    accepted: list[float] = setting(
        [0.5, 0.7, 0.9], "probabilities that a draft token is accepted after accepted ones", **limits(0, 1)
    )
    on: list[str] = setting([], "instead of weights and device: profiles of 'kerv bench', as on= of 'kerv report'")

    def check_together(self, prefix: str) -> None:
        if self.weights and self.on:
            raise UsageError(f"{prefix}on=PROFILE has the costs: leave out weights", f"{prefix}on")
        if not self.accepted:
            raise UsageError(f"{prefix}accepted=[]: name at least one probability", f"{prefix}accepted")
        for name in self.device:
            if name not in DEVICES:
                raise UsageError(f"{prefix}device={name}: known are {', '.join(DEVICES)}", f"{prefix}device")
