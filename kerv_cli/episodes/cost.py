"""The cost model predicts a decode's seconds from its forwards and a measured latency profile (docs/measuring.md).

Every forward and draft has a kind of cost, such as `prefill`, `verify` or `draft`. A profile has the seconds of each
kind.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_json
from kerv_cli.base.registry import DRAFTING, ProposerPart
from kerv_cli.engine.record import PARALLEL, DecodeRecord

# Kinds of cost that depend on the target's size (docs/measuring.md). Every other kind, such as `retrieval`, is the
# cost of other proposers' drafts.
FORWARDS = ("encode", "prefill", "verify", "feed", DRAFTING, "tree")

FORMAT = 2  # version of the profile's file format

# Phases whose recorded seconds the cost model reads. For `vision`, it only reads whether the seconds are 0.
READ_PHASES = ("vision", "propose", "accept", "rectify", "other")


# Key of a profile of the papers' public code, which goes on until it has more than N tokens: one round too many.
EXTRA_ROUND = "extra_round"

Columns = Mapping[str, np.ndarray]  # arrays by name
# Attributes of `Round` that the cost model reads.
COUNTED = ("mode", "proposer", "start", "tree_size", "accepted", "levels")


def source_costs() -> dict[str, list[str]]:
    """Return, for each kind of cost, the names of the proposers whose drafts have this cost.

    Proposers without a kind of cost are left out. For them, the cost model keeps the recorded drafting time.
    """
    costs: dict[str, list[str]] = {}
    for name, part in ProposerPart.every().items():
        if part.cost:
            costs.setdefault(part.cost, []).append(name)
    return costs


@dataclass(frozen=True)
class Profile:
    """Measured seconds of each kind of forward and draft, for several numbers of tokens."""

    prompt: int  # number of prompt tokens P
    # for each kind of cost, the pair (rows, seconds). `rows` are numbers of tokens, increasing. A forward or draft
    # over `rows[i]` tokens takes `seconds[i]`.
    phases: Mapping[str, tuple[tuple[int, ...], tuple[float, ...]]]
    tokens: int = 0  # number of tokens N in a chunk
    about: Mapping[str, Any] = field(default_factory=dict)  # what was measured: target, machine, versions

    def lacks(self, kinds: Iterable[str]) -> list[str]:
        return [kind for kind in kinds if not self.phases.get(kind, ((), ()))[0]]

    def seconds(self, kind: str, rows: int) -> float:
        return float(self.times(kind, np.array([rows]))[0])

    def times(self, kind: str, rows: np.ndarray) -> np.ndarray:
        """Return the seconds (n,) of n forwards or drafts of a kind, over `rows` (n,) tokens each.

        Seconds are linear between the measured numbers of tokens and beyond the largest; below the smallest, constant.
        """
        measured, times = self.phases[kind]
        seconds: np.ndarray = np.interp(rows, measured, times)
        if len(measured) > 1:
            slope = (times[-1] - times[-2]) / (measured[-1] - measured[-2])
            seconds = seconds + slope * np.maximum(rows - measured[-1], 0)
        return seconds

    def decode(self, tokens: int) -> float:
        first = self.seconds("encode", 1) + self.seconds("prefill", self.prompt)
        return first + (tokens - 1 + bool(self.about.get(EXTRA_ROUND))) * self.seconds("verify", 1)

    def as_dict(self) -> dict[str, Any]:
        phases = {kind: {"rows": list(rows), "seconds": list(seconds)} for kind, (rows, seconds) in self.phases.items()}
        return {"format": FORMAT, "prompt": self.prompt, "tokens": self.tokens, "phases": phases}


def read_profile(path: Path) -> Profile:
    """Read the latency profile from a JSON file that `kerv bench` has written."""
    document = read_json(path)
    try:
        stored = document["profile"]
        phases: dict[str, tuple[tuple[int, ...], tuple[float, ...]]] = {}
        for kind, costs in stored["phases"].items():
            phases[kind] = tuple(map(int, costs["rows"])), tuple(map(float, costs["seconds"]))
        about = {key: value for key, value in document.items() if isinstance(value, str | bool | int | float)}
        profile = Profile(int(stored["prompt"]), phases, int(stored["tokens"]), about)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(f"{path} holds no latency profile: make one with 'kerv bench'") from error
    if stored.get("format") != FORMAT:
        target = about.get("target", "TARGET")
        raise CheckpointError(f"{path} has another format than {FORMAT}: measure it with 'kerv bench target={target}'")
    for kind, (rows, seconds) in phases.items():
        increases = len(rows) == len(seconds) and list(rows) == sorted(set(rows))
        if not increases or not all(0 <= value < math.inf for value in seconds):
            raise CheckpointError(f"{path} has impossible times of the phase '{kind}'")
    return profile


class Calls(NamedTuple):
    """The m forwards or drafts of one kind of cost in several decodes."""

    decode: np.ndarray  # (m,) index of the decode that ran each forward or draft
    rows: np.ndarray  # (m,) number of tokens that each forward or draft processed, not counting the prompt's tokens
    with_prompt: np.ndarray  # (m,) bool, whether the forward or draft also processed the prompt's tokens


@dataclass(frozen=True)
class Work:
    """What several decodes computed: forwards and drafts, and the recorded seconds of everything else."""

    calls: Mapping[str, Calls]  # the forwards and the drafter's drafts, by kind of cost (one of `FORWARDS`)
    # for each kind of cost that other proposers' drafts have, such as `retrieval`: (decodes,) bool, whether the
    # decode used a proposer with this kind of cost
    sources: Columns
    host: np.ndarray  # (decodes,) recorded seconds that neither depend on the target's size nor were spent on drafting
    # (decodes,) recorded seconds of drafting. 0 if the drafter drafted, because `calls` holds its drafts.
    propose: np.ndarray
    # each decode's first verification after its prefill, with its draft: the round that the papers' public code runs
    # once more at the end (`EXTRA_ROUND`)
    again: Mapping[str, Calls]

    @property
    def needs(self) -> list[str]:
        return [*self.calls, *self.sources]


def work_of(rounds: Columns, counts: np.ndarray, phases: Columns, looked_up: np.ndarray, size: int) -> Work:
    """Count the forwards and drafts of several decodes, from the columns of their records.

    `rounds` has for each name in `COUNTED` an array over all n rounds, decode after decode. `phases` has for each name
    in `READ_PHASES` the seconds (decodes,). `counts` is the number of rounds of each decode, `looked_up` whether it
    searched a datastore, `size` the number of tokens N in a chunk.
    """
    decodes, decode = len(counts), np.repeat(np.arange(len(counts)), counts)
    mode, proposer, start = rounds["mode"], rounds["proposer"], rounds["start"]
    costs = source_costs()
    drafts = (rounds["tree_size"] > 0) & np.isin(proposer, costs.pop(DRAFTING, []))
    has_drafter = np.bincount(decode, drafts, decodes) > 0
    nodes = np.where(mode == PARALLEL, size, rounds["tree_size"])
    accepted = np.where(mode == PARALLEL, 0, rounds["accepted"])
    levels = rounds["levels"]
    trees = drafts & (levels > 0)
    forward, prefill = mode != "skip", start == 0
    # the drafter reads a round's states only if another draft can follow: two or more tokens are left
    is_last, following = np.diff(decode, append=decodes) != 0, np.append(start[1:], 0)
    feeds = forward & has_drafter[decode] & ~is_last & (size - following > 1)

    def calls(chosen: np.ndarray, rows: np.ndarray, with_prompt: np.ndarray | bool = False) -> Calls:
        return Calls(decode[chosen], rows[chosen], np.broadcast_to(with_prompt, rows.shape)[chosen])

    def drafted_in(chosen: np.ndarray) -> dict[str, Calls]:
        return {
            DRAFTING: calls(chosen & drafts & ~trees, nodes),
            "tree": calls(chosen & trees, np.minimum(levels, size - start - 1)),
        }

    verifies = np.flatnonzero(forward & ~prefill)
    first = np.zeros(len(decode), bool)
    first[verifies[np.unique(decode[verifies], return_index=True)[1]]] = True
    encoded = np.flatnonzero(phases["vision"])
    found = {
        "encode": Calls(encoded, np.ones(len(encoded), int), np.zeros(len(encoded), bool)),
        "prefill": calls(forward & prefill, nodes, True),
        "verify": calls(forward & ~prefill, 1 + nodes),
        "feed": calls(feeds, accepted + ~prefill, prefill),
        **drafted_in(np.ones(len(decode), bool)),
    }
    sources: dict[str, np.ndarray] = {}
    for kind, names in costs.items():
        sources[kind] = np.bincount(decode, np.isin(proposer, names), decodes) > 0
        if any(ProposerPart.find(name).looks_up for name in names):
            sources[kind] |= looked_up
    return Work(
        calls={kind: of_kind for kind, of_kind in found.items() if len(of_kind.decode)},
        sources={kind: drafted for kind, drafted in sources.items() if drafted.any()},
        host=phases["accept"] + phases["rectify"] + phases["other"],
        propose=np.where(has_drafter, 0.0, phases["propose"]),
        again={
            "verify": calls(first, 1 + nodes),
            "feed": calls(first & has_drafter[decode], accepted + 1),
            **drafted_in(first),
        },
    )


def work_of_record(decode: DecodeRecord) -> Work:
    columns = {name: np.array(list(map(attrgetter(name), decode.rounds))) for name in COUNTED}
    phases = {name: np.array([decode.phases.get(name, float(name == "vision"))]) for name in READ_PHASES}
    searched = np.array([decode.similarity is not None])
    return work_of(columns, np.array([len(decode.rounds)]), phases, searched, decode.size or len(decode.tokens))


def prices(work: Work, profile: Profile) -> np.ndarray:
    """Estimate the seconds of each decode, (decodes,).

    Forwards and the drafter's drafts take the profile's seconds. So do other proposers' drafts, if the profile lists
    them. Everything else keeps its recorded seconds.
    """
    total = np.array(work.host, dtype=float)
    again = work.again.items() if profile.about.get(EXTRA_ROUND) else ()
    for kind, (decode, rows, with_prompt) in (*work.calls.items(), *again):
        known = DRAFTING if kind == "tree" and profile.lacks([kind]) else kind
        total += np.bincount(decode, profile.times(known, rows + with_prompt * profile.prompt), len(total))
    drafting = np.zeros(len(total))
    if not profile.lacks(work.sources):
        for kind, drafted in work.sources.items():
            drafting += drafted * profile.seconds(kind, 1)
    return total + np.where(drafting > 0, drafting, work.propose)
