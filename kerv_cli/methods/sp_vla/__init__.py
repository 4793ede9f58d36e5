"""SP-VLA's schedule (docs/methods.md §6.1): a regression where the motion is fast, the target where it is slow."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import number
from kerv_cli.base.registry import add


@dataclass
class SpeedSkipSettings:
    """Executes chunks of a ridge regression over the last actions while the hand is fast."""

    kind: str = "speed"
    v_min: float = number(0.3, 0, 1000)  # speed of the hand from which on motion is intuitive, metres per second
    v_max: float = number(1000.0, 0, 1000)  # … and up to which
    buffer: int = number(6, 2, 10)  # n, last executed actions that the regression reads
    share: float = number(0.5, 0, 1)  # τ, share of these above which the target must have decoded
    penalty: float = number(1e-4, 0, 1e6)  # λ of the regression

    def check_together(self, prefix: str) -> None:
        """Refuse speeds that are not in order."""
        if self.v_min > self.v_max:
            raise UsageError(f"skip.v_min={self.v_min:g} skip.v_max={self.v_max:g}: v_min must not be above v_max")


_BUILD = "kerv_cli.methods.sp_vla.schedule:SpeedSkip.build"
add("skip", "speed", _BUILD, SpeedSkipSettings, colour=0x8C6D31)
