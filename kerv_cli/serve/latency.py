"""Latency of answered requests, for the server's log."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass
class Latencies:
    """Milliseconds of every answer. decode: inference time; whole: from the message's arrival to the answer's end."""

    decode: list[float] = field(default_factory=list)
    whole: list[float] = field(default_factory=list)

    def add(self, decode: float, whole: float) -> None:
        """One answer."""
        self.decode.append(decode)
        self.whole.append(whole)

    def __str__(self) -> str:
        parts = [f"{len(self.whole)} answers"]
        for name, values in (("decode", self.decode), ("answer", self.whole)):
            if values:
                p50, p95 = np.percentile(values, [50, 95])
                parts.append(f"{name} p50 {p50:.1f} p95 {p95:.1f} worst {max(values):.1f} ms")
        return ", ".join(parts)
