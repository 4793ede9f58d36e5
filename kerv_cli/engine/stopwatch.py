"""A stopwatch that measures a decode's seconds by phase, on a CPU and on CUDA."""

from __future__ import annotations

import itertools
import time

import torch

from kerv_cli.engine.record import PHASES


class Stopwatch:
    """Measures the seconds that each phase of one decode takes (`PHASES`).

    On CUDA the stopwatch records events in the stream and reads them at the end. So measuring does not slow the decode.
    The CPU waits for the GPU only at the start and at the end.
    """

    def __init__(self, device: torch.device) -> None:
        self.phases = dict.fromkeys(PHASES, 0.0)
        self.events: list[tuple[str, torch.cuda.Event]] | None = None
        if device.type == "cuda":
            torch.cuda.synchronize()
            self.events = [("", _event())]
        self.began = self.last = time.perf_counter()

    def lap(self, phase: str) -> None:
        """Add the time since the last lap to `phase`, one of `PHASES`. On CUDA, this time is added by `stop`."""
        if self.events is not None:
            self.events.append((phase, _event()))
            return
        now = time.perf_counter()
        self.phases[phase] += now - self.last
        self.last = now

    def stop(self) -> float:
        """Stop and return the seconds since the start. The time since the last lap counts as phase `other`."""
        self.lap("other")
        if self.events is not None:
            torch.cuda.synchronize()
            self.last = time.perf_counter()
            for (_, begin), (phase, end) in itertools.pairwise(self.events):
                self.phases[phase] += begin.elapsed_time(end) / 1000.0
            self.phases["other"] += max(0.0, self.last - self.began - sum(self.phases.values()))
        return self.last - self.began


def _event() -> torch.cuda.Event:
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event
