"""A latency profile: seconds of every forward by its rows, for ceilings, predictions and projections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kerv_cli.bench.machine import Machine
from kerv_cli.bench.phases import Phase
from kerv_cli.errors import CheckpointError
from kerv_cli.files import read_json

KINDS = ("encode", "prefill", "verify", "draft", "feed")


@dataclass(frozen=True)
class Profile:
    """prompt: P. phases: kind -> (rows, seconds), rows increasing. Between measured rows times are interpolated, behind
    the last ones continued in a straight line."""

    prompt: int
    phases: Mapping[str, tuple[tuple[int, ...], tuple[float, ...]]]

    @classmethod
    def of(cls, prompt: int, phases: Sequence[Phase]) -> Profile:
        """From the medians of measured phases."""
        found = {}
        for kind in KINDS:
            own = sorted((p.rows, p.seconds) for p in phases if p.kind == kind)
            found[kind] = tuple(rows for rows, _ in own), tuple(seconds for _, seconds in own)
        return cls(prompt, found)

    def seconds(self, kind: str, rows: int) -> float:
        """Of one phase of so many rows."""
        known, times = self.phases[kind]
        if len(known) > 1 and rows > known[-1]:
            slope = (times[-1] - times[-2]) / (known[-1] - known[-2])
            return times[-1] + slope * (rows - known[-1])
        return float(np.interp(rows, known, times))

    def decode(self, tokens: int) -> float:
        """Of an autoregressive decode of N tokens."""
        return self.seconds("encode", 1) + self.seconds("prefill", self.prompt) + (tokens - 1) * self.one_token

    @property
    def one_token(self) -> float:
        """A forward of one token."""
        return self.seconds("verify", 1)

    def drafting(self, depth: int) -> float:
        """A chain of `depth` tokens from the drafter: its first token needs no forward."""
        rows, times = self.phases["draft"]
        step = times[-1] / max(1, rows[-1] - 1)
        return step * max(0, depth - 1)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "prompt": self.prompt,
            "phases": {
                kind: {"rows": list(rows), "seconds": list(seconds)} for kind, (rows, seconds) in self.phases.items()
            },
        }


def read_profile(path: Path) -> Profile:
    """The profile in the document of a bench.

    Raises:
        CheckpointError: no such document.
    """
    document = read_json(path)
    try:
        stored = document["profile"]
        phases = {k: (tuple(v["rows"]), tuple(v["seconds"])) for k, v in stored["phases"].items()}
        return Profile(int(stored["prompt"]), phases)
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path} holds no latency profile: make one with 'kerv bench'") from error


def projected(phases: Sequence[Phase], here: Machine, there: Machine, overhead: float = 0.0) -> list[Phase]:
    """The phases on a device that is not at hand: each needs its floor there, divided by the share of the floor that it
    reached here, and at least `overhead` seconds. A projection, not a measurement."""
    found = []
    for phase in phases:
        floor = there.floor(phase.read, phase.flops)
        share = min(1.0, phase.share)
        scale = here.bandwidth / there.bandwidth  # what has no floor, as the prompt's encoder, scales with bandwidth
        seconds = max(overhead, floor / share if share > 0 else phase.seconds * scale)
        found.append(replace(phase, seconds=seconds, p95=seconds, least=seconds, floor=floor))
    return found
