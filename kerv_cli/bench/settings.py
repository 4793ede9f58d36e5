"""Settings of the benchmark."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, limits, number, setting
from kerv_cli.base.settings import RunSettings

PROJECTIONS = {"A100 80GB": [2039.0, 312.0], "H100 SXM": [3350.0, 989.0], "RTX 4090": [1008.0, 165.0]}


@dataclass
class BenchSettings(RunSettings):
    """`kerv bench`: how far a target is from what the device can do."""

    model: str = setting("mt10-vision", "a policy, or a shape of conf/target with random weights")
    dtype: str = choice(
        "auto",
        "auto",
        "float32",
        "bfloat16",
        "float16",
        help="of a shape; auto: the faster one",
    )
    repeats: int = number(30, 3, 100_000, help="of every measurement, for medians and 95th percentiles")
    tokens: list[int] = setting([7, 16], "N, tokens of a chunk; of a shape: at most", **limits(4, 256))
    projected: str = setting("", "a shape of conf/target whose profiles on `projections` are written too")
    projections: dict[str, list[float]] = setting(PROJECTIONS, "device -> published GB/s and dense bfloat16 TFLOP/s")

    def check_together(self, prefix: str) -> None:
        """Raises UsageError without a chunk to measure, and for a device without its two figures."""
        if not self.tokens:
            raise UsageError(f"{prefix}tokens=[]: name at least one N")
        for name, figures in self.projections.items():
            if len(figures) != 2 or min(figures) <= 0:
                raise UsageError(f"{prefix}projections.{name}={figures}: two numbers above 0, GB/s and TFLOP/s")
