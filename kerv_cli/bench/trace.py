"""Traces: which drafts were made and accepted, in a file that any program can write (docs/trace.md)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path

import numpy as np

from kerv_cli.base import manifests
from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.limits import number
from kerv_cli.base.rows import values_of
from kerv_cli.engine.cost import COUNTED, READ_PHASES, Work, work_of
from kerv_cli.engine.record import PARALLEL

MOST = 1_000_000  # of every count in a trace
MODES = ("forward", "skip", PARALLEL)
"""Modes of a round: the target ran, a draft was executed without a forward, or one forward gave all tokens."""


@dataclass(frozen=True)
class TracedRound:
    """A forward of the target, and the draft that it verified. The defaults are one token without a draft.

    Attributes:
        start: Number of tokens committed before this forward. 0: it reads the prompt.
        parents: Index of each draft node's parent. −1: the node follows the last committed token. Empty: unknown, or no
            draft.
        nodes: Number of draft nodes. Only needed if `parents` is empty.
        levels: Number of levels of a drafted tree. 0: a chain, or computed from `parents`.
        accepted: Number of accepted draft tokens.
        committed: Number of committed tokens, the target's own token included.
        proposer: Name of the proposer that drafted: `none`, or a proposer of kerv with the same cost.
        mode: One of MODES.
    """

    start: int = 0
    parents: list[int] = field(default_factory=list)
    nodes: int = 0
    levels: int = 0
    accepted: int = 0
    committed: int = 1
    proposer: str = "none"
    mode: str = "forward"

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            CheckpointError: A count is impossible, a parent comes after its child, or the mode is unknown.
        """
        for name in ("start", "nodes", "levels", "accepted", "committed"):
            if not 0 <= getattr(self, name) <= MOST:
                raise CheckpointError(f"{name}={getattr(self, name)}: from 0 to {MOST}")
        if any(not -1 <= parent < node for node, parent in enumerate(self.parents)):
            raise CheckpointError(f"parents={self.parents}: each is the index of an earlier node, or -1")
        if self.accepted > self.drafted and self.mode == MODES[0]:
            raise CheckpointError(f"accepted={self.accepted} of {self.drafted} draft tokens")
        if self.mode not in MODES:
            raise CheckpointError(f"mode={self.mode}: one of {', '.join(MODES)}")

    @property
    def drafted(self) -> int:
        """Number of draft tokens."""
        return len(self.parents) or self.nodes

    @property
    def depth(self) -> int:
        """Number of levels of a drafted tree. 0 for a chain."""
        if self.levels or self.parents == list(range(-1, len(self.parents) - 1)):
            return self.levels
        depths: list[int] = []
        for parent in self.parents:
            depths.append(1 if parent < 0 else depths[parent] + 1)
        return max(depths)


@dataclass(frozen=True)
class TracedDecode:
    """One decode of a trace.

    Attributes:
        episode: Name of the episode.
        tokens: N, number of tokens of the chunk.
        rounds: The decode's rounds in order.
        setting: Name of the setting that decoded, such as a method's name.
        prompt: Number of prompt tokens. None: unknown.
        encoded: Whether the target's vision encoder ran.
        searched: Whether a datastore was searched although no round drafted with the result.
        seconds: Seconds by phase, as far as they are known: `propose`, `accept`, `rectify`, `other`.
    """

    episode: str
    tokens: int = number(1, 1, MOST)
    rounds: list[TracedRound] = field(default_factory=list)
    setting: str = ""
    prompt: int | None = number(None, 1, MOST)
    encoded: bool = True
    searched: bool = False
    seconds: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that there is a round.

        Raises:
            CheckpointError: There is none.
        """
        if not self.rounds:
            raise CheckpointError("rounds: a decode has one at least")


def read_trace(path: Path) -> list[TracedDecode]:
    """Return the decodes of a trace.

    Raises:
        CheckpointError: The file is missing or empty, or a line is no decode. The message names the line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CheckpointError(f"trace={path} cannot be read: {error}") from error
    decodes = []
    for number_, line in enumerate(lines, 1):
        if line.strip():
            try:
                value = json.loads(line)
            except ValueError as error:
                raise CheckpointError(f"{path}:{number_} is no JSON: see docs/trace.md") from error
            decodes.append(manifests.read(TracedDecode, value, f"{path}:{number_}", tolerant=True))
    if not decodes:
        raise CheckpointError(f"{path} has no decode: see docs/trace.md")
    return decodes


def grouped(decodes: Sequence[TracedDecode]) -> Iterator[tuple[str, int, list[TracedDecode]]]:
    """Yield (setting, N, decodes) for each setting and each number N of tokens per chunk."""
    groups: dict[tuple[str, int], list[TracedDecode]] = {}
    for one in decodes:
        groups.setdefault((one.setting, one.tokens), []).append(one)
    for (name, tokens), group in groups.items():
        yield name, tokens, group


def work_of_trace(decodes: Sequence[TracedDecode], tokens: int) -> Work:
    """Count the forwards and drafts of some decodes, and sum their other seconds.

    Args:
        decodes: The decodes, all of the same chunk length.
        tokens: N, number of tokens of a chunk.
    """
    rounds: list[Mapping[str, str | int]] = []
    phases = {name: np.zeros(len(decodes)) for name in READ_PHASES}
    for number_, decode in enumerate(decodes):
        rounds += map(_counted, decode.rounds)
        for name in READ_PHASES:
            phases[name][number_] = decode.seconds.get(name, 0.0)
        phases["vision"][number_] = decode.encoded
    columns = {name: np.array(list(map(itemgetter(name), rounds))) for name in COUNTED}
    counts = np.array(list(map(len, values_of(decodes, "rounds"))))
    searched = np.array(values_of(decodes, "searched"))
    return work_of(columns, counts, phases, searched, tokens)


def _counted(one: TracedRound) -> Mapping[str, str | int]:
    """Return the attributes of a round that the cost model reads."""
    return {
        "mode": one.mode,
        "proposer": one.proposer,
        "start": one.start,
        "tree_size": one.drafted,
        "accepted": one.accepted,
        "levels": one.depth,
    }
