"""The stopwatch of a decode: on CUDA it waits for the device twice, however many laps there are."""

from __future__ import annotations

import time

import pytest
import torch

from kerv_cli.engine.record import PHASES
from kerv_cli.engine.stopwatch import Stopwatch


class Event:
    """Stands in for a CUDA event: the host's time when it was recorded."""

    def __init__(self, enable_timing: bool) -> None:
        assert enable_timing

    def record(self) -> None:
        """Notes the time."""
        self.at = time.perf_counter()

    def elapsed_time(self, later: Event) -> float:
        """Milliseconds."""
        return 1000.0 * (later.at - self.at)


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_phases_add_up_to_the_decode(device, monkeypatch):
    waits: list[str] = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: waits.append("wait"))
    monkeypatch.setattr(torch.cuda, "Event", Event)
    clock = Stopwatch(torch.device(device))
    for phase in ("vision", "prefill", "verify", "verify"):
        time.sleep(0.002)
        clock.lap(phase)
    seconds = clock.stop()
    assert len(waits) == (2 if device == "cuda" else 0)
    assert set(clock.phases) == set(PHASES)
    assert sum(clock.phases.values()) == pytest.approx(seconds, abs=1e-4)
    assert clock.phases["verify"] >= 0.004 > clock.phases["other"]
