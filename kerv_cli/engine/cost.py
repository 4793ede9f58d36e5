"""The cost model of a decode: its forwards, and their seconds by a latency profile (docs/measuring.md)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_json
from kerv_cli.engine.record import PARALLEL, DecodeRecord

KINDS = ("encode", "prefill", "verify", "draft", "feed")
"""Kinds of a profile's phases: docs/measuring.md."""

DRAFTER = "drafter"
_HOST = ("seconds.accept", "seconds.rectify", "seconds.other")
DECODE_TIMES = ("seconds.propose", *_HOST)
"""Phases of a recorded decode whose seconds do not depend on the target's size, where the drafter does not draft."""


@dataclass(frozen=True)
class Profile:
    """Seconds of every forward by its rows. prompt: P. phases: kind -> (rows, seconds), rows increasing. Between
    measured rows times are interpolated, behind the last ones continued in a straight line."""

    prompt: int
    phases: Mapping[str, tuple[tuple[int, ...], tuple[float, ...]]]

    def seconds(self, kind: str, rows: int) -> float:
        """Of one phase of so many rows."""
        measured, times = self.phases[kind]
        if len(measured) > 1 and rows > measured[-1]:
            slope = (times[-1] - times[-2]) / (measured[-1] - measured[-2])
            return times[-1] + slope * (rows - measured[-1])
        return float(np.interp(rows, measured, times))

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
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(f"{path} holds no latency profile: make one with 'kerv bench'") from error


@dataclass(frozen=True)
class Forward:
    """One forward of the target. kind: prefill | verify. start: tokens committed before it. drafted: nodes it verifies.
    accepted: draft tokens committed. proposer: who drafted, empty without a draft."""

    kind: str
    start: int
    drafted: int
    accepted: int
    proposer: str = ""


@dataclass(frozen=True)
class DecodeSequence:
    """One decode. forwards: empty where the draft was executed unverified. host: seconds, as recorded, of all that does
    not depend on the target's size: acceptance, rectification, and proposers other than the drafter."""

    forwards: tuple[Forward, ...]
    host: float

    @property
    def drafts(self) -> bool:
        """Whether the drafter, whose shape follows the target's, drafted in it."""
        return any(f.proposer == DRAFTER for f in self.forwards)


def sequence_of(row: Mapping[str, Any], size: int, tokens: int) -> DecodeSequence:
    """A row of decodes.parquet, cut to its first `tokens` of `size` tokens. A draft that reached beyond the cut shrinks
    with the depth that is left; a round behind the cut is left out."""
    forwards = []
    for played in row["rounds"]:
        start, nodes = int(played["start"]), int(played["tree_size"])
        if played["mode"] == "skip" or start >= tokens:
            continue
        if played["mode"] == PARALLEL:
            forwards.append(Forward("prefill", 0, tokens, 0))
            continue
        depth, most = tokens - start - 1, size - start - 1  # tokens that a draft may have here, and had in the record
        if depth < 1:
            nodes = 0
        elif nodes >= most:
            nodes = math.ceil(nodes * depth / most)
        kind = "prefill" if start == 0 else "verify"
        accepted = min(int(played["accepted"]), depth) if nodes else 0
        forwards.append(Forward(kind, start, nodes, accepted, str(played["proposer"]) if nodes else ""))
    drafted = any(f.proposer == DRAFTER for f in forwards)
    host = sum(float(row[name]) for name in (_HOST if drafted else DECODE_TIMES))
    return DecodeSequence(tuple(forwards), host)


def sequence_of_record(decode: DecodeRecord) -> DecodeSequence:
    """The forwards and host seconds of a decode that was just recorded, whole."""
    times = {name: decode.phases.get(name.removeprefix("seconds."), 0.0) for name in DECODE_TIMES}
    size = decode.size or len(decode.tokens)
    return sequence_of({"rounds": [vars(played) for played in decode.rounds], **times}, size, size)


def predicted(decode: DecodeSequence, profile: Profile) -> float:
    """Seconds of the decode by the cost model: the profile's times of its forwards, the drafter's passes
    and the states it is fed, and the recorded host seconds."""
    seconds = profile.seconds("encode", 1) + decode.host
    for i, forward in enumerate(decode.forwards):
        rows = forward.drafted + (profile.prompt if forward.kind == "prefill" else 1)
        seconds += profile.seconds(forward.kind, rows)
        if forward.proposer == DRAFTER:
            seconds += profile.drafting(min(forward.drafted, profile_depth(forward)))
        if decode.drafts and i + 1 < len(decode.forwards):
            first = forward.kind == "prefill"
            seconds += profile.seconds("feed", profile.prompt if first else forward.accepted + 1)
    return seconds


def profile_depth(forward: Forward) -> int:
    """Levels of a draft: a chain's length; a tree has more nodes than a chunk has tokens, and few levels."""
    return forward.drafted if forward.drafted < 32 else 5
