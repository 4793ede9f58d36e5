"""Settings of the benchmark."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import choice, limits, number, setting
from kerv_cli.base.settings import RunSettings

PROJECTIONS = {"A100 80GB": [2039.0, 312.0], "H100 SXM": [3350.0, 989.0], "RTX 4090": [1008.0, 165.0]}


@dataclass
class BenchSettings(RunSettings):
    """Settings of `kerv bench`, which compares a target's measured times with the shortest that the device allows."""

    model: str = setting("mt10-vision", "a policy, or a shape of conf/target with random weights")
    dtype: str = choice(
        "auto", "auto", "float32", "bfloat16", "float16", help="number format of a shape; auto: bfloat16 on a GPU"
    )
    repeats: int = number(30, 3, 100_000, help="repeats of every measurement, for medians and 95th percentiles")
    tokens: list[int] = setting([7, 16], "N, tokens of a chunk; a shape decodes the largest", **limits(4, 256))
    projected: str = setting("", "a shape of conf/target: also estimate its times on the devices of projections=")
    projections: dict[str, list[float]] = setting(PROJECTIONS, "device -> published GB/s and dense bfloat16 TFLOP/s")

    def check_together(self, prefix: str) -> None:
        """Check settings that depend on each other.

        Args:
            prefix: Start of the settings' names in error messages.

        Raises:
            UsageError: `tokens` is empty, or a device of `projections` does not have two positive numbers.
        """
        if not self.tokens:
            raise UsageError(f"{prefix}tokens=[]: name at least one N")
        for name, figures in self.projections.items():
            if len(figures) != 2 or min(figures) <= 0:
                raise UsageError(f"{prefix}projections.{name}={figures}: two numbers above 0, GB/s and TFLOP/s")
