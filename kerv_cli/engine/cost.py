"""The cost model of a decode: its rounds, and their seconds by a latency profile (docs/measuring.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_json
from kerv_cli.base.registry import DRAFTING, parts
from kerv_cli.engine.record import PARALLEL, DecodeRecord

FORWARDS = ("encode", "prefill", "verify", "feed", DRAFTING, "tree")
"""Kinds of a profile's costs that follow the target's shape: docs/measuring.md. The others are proposers' own."""

FORMAT = 2
"""Of a profile."""

_WIDE = 32  # nodes from which on a draft of unknown settings is a tree of few levels
_LEVELS = 5
_HOST = ("accept", "rectify", "other")
HOST_PHASES = ("propose", *_HOST)
"""Phases of a recorded decode whose seconds do not depend on the target's size, where the drafter does not draft."""
READ_PHASES = ("vision", *HOST_PHASES)
"""Phases whose recorded seconds the model reads: of vision only whether there were any."""
_ABSENT = (1.0, *[0.0] * len(HOST_PHASES))  # of `READ_PHASES` that a record lacks: it encoded, the rest took no time


def source_costs() -> dict[str, list[str]]:
    """Kind of a cost -> the proposers whose drafts have it. Others take the seconds that were recorded."""
    costs: dict[str, list[str]] = {}
    for name, part in parts("proposer").items():
        if "cost" in part.traits:
            costs.setdefault(part.traits["cost"], []).append(name)
    return costs


@dataclass(frozen=True)
class Profile:
    """Seconds of every forward by its rows, and of drafts. Between measured rows times are interpolated, behind the
    last ones continued in a straight line.

    prompt: P. phases: kind -> (rows, seconds), rows increasing. tokens: N of the chunks. about: target, machine,
    versions.
    """

    prompt: int
    phases: Mapping[str, tuple[tuple[int, ...], tuple[float, ...]]]
    tokens: int = 0
    about: Mapping[str, Any] = field(default_factory=dict)

    def seconds(self, kind: str, rows: int) -> float:
        """Of one phase of so many rows."""
        return float(self.times(kind, np.array([rows]))[0])

    def times(self, kind: str, rows: np.ndarray) -> np.ndarray:
        """`seconds` of every number of rows (n,)."""
        measured, times = self.phases[kind]
        seconds: np.ndarray = np.interp(rows, measured, times)
        if len(measured) > 1:
            slope = (times[-1] - times[-2]) / (measured[-1] - measured[-2])
            seconds = seconds + slope * np.maximum(rows - measured[-1], 0)
        return seconds

    def decode(self, tokens: int) -> float:
        """Of an autoregressive decode of N tokens."""
        return (
            self.seconds("encode", 1) + self.seconds("prefill", self.prompt) + (tokens - 1) * self.seconds("verify", 1)
        )

    def drafting(self, depth: int) -> float:
        """A chain of `depth` tokens from the drafter."""
        return self.seconds("draft", depth) if depth else 0.0

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        phases = {kind: {"rows": list(rows), "seconds": list(seconds)} for kind, (rows, seconds) in self.phases.items()}
        return {"format": FORMAT, "prompt": self.prompt, "tokens": self.tokens, "phases": phases}


def read_profile(path: Path) -> Profile:
    """The profile in the document of a bench.

    Raises:
        CheckpointError: no such document, or one of another format.
    """
    document = read_json(path)
    try:
        stored = document["profile"]
        phases = {
            kind: (tuple(map(int, costs["rows"])), tuple(map(float, costs["seconds"])))
            for kind, costs in stored["phases"].items()
        }
        about = {key: value for key, value in document.items() if isinstance(value, str | bool | int | float)}
        profile = Profile(int(stored["prompt"]), phases, int(stored["tokens"]), about)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(f"{path} holds no latency profile: make one with 'kerv bench'") from error
    if stored.get("format") != FORMAT:
        target = about.get("target", "TARGET")
        raise CheckpointError(f"{path} has another format than {FORMAT}: measure it with 'kerv bench target={target}'")
    return profile


@dataclass(frozen=True)
class Work:
    """What some decodes did, flat: n rounds with a forward of the target, of `len(host)` decodes.

    decode: (n,) which decode. prefill: (n,) bool. nodes, accepted: (n,) of the draft. levels: (n,) of the drafter's
    draft, 0 where it did not draft; tree: (n,) bool, more than a chain. feeds: (n,) bool, the drafter is fed behind it.
    host: (decodes,) seconds, as recorded, of acceptance and all else that does not depend on the target's size, but for
    proposing. encoded: (decodes,) bool, whether the target encoded the observation. propose: seconds of proposing, 0
    where the drafter, which follows the target's shape, drafted. sources: kind -> (decodes,) bool, whether there was
    such a draft besides.
    """

    decode: np.ndarray
    prefill: np.ndarray
    nodes: np.ndarray
    accepted: np.ndarray
    levels: np.ndarray
    tree: np.ndarray
    feeds: np.ndarray
    host: np.ndarray
    encoded: np.ndarray
    propose: np.ndarray
    sources: Mapping[str, np.ndarray]

    @property
    def needs(self) -> list[str]:
        """The kinds of costs that price it."""
        used = {
            "encode": self.encoded.any(),
            "prefill": self.prefill.any(),
            "verify": (~self.prefill).any(),
            "feed": self.feeds.any(),
            "draft": (self.levels[~self.tree] > 1).any(),
            "tree": self.tree.any(),
            **{kind: count.any() for kind, count in self.sources.items()},
        }
        return [kind for kind, is_used in used.items() if is_used]


def work_of(
    rounds: Mapping[str, np.ndarray],
    counts: np.ndarray,
    phases: Mapping[str, np.ndarray],
    looked_up: np.ndarray,
    size: int,
    drafter: tuple[int, int] | None = None,
) -> Work:
    """The work of some decodes.

    Args:
        rounds: of all decodes, one behind the other: mode, proposer, start, tree_size, accepted, (n,) each.
        counts: (decodes,) rounds of each.
        phases: (decodes,) seconds of each of `READ_PHASES`.
        looked_up: (decodes,) bool: something was retrieved.
        size: N.
        drafter: the proposer's `depth` and `top_k`; None: not recorded, a draft of many nodes is then a tree.
    """
    decodes, decode = len(counts), np.repeat(np.arange(len(counts)), counts)
    mode, proposer = rounds["mode"], rounds["proposer"]
    costs = source_costs()
    drafters = costs.pop(DRAFTING, [])
    drafts, parallel = (rounds["tree_size"] > 0) & np.isin(proposer, drafters), mode == PARALLEL
    has_drafter = np.bincount(decode, drafts, decodes) > 0
    nodes = np.where(parallel, size, rounds["tree_size"])
    depth, top_k = drafter or (_LEVELS, 0)
    tree = drafts & ((nodes >= _WIDE) if drafter is None else top_k > 1)
    levels = np.where(tree, np.minimum(depth, size - rounds["start"] - 1), nodes) * drafts
    host, propose = sum(phases[name] for name in _HOST), np.where(has_drafter, 0.0, phases["propose"])
    others = {kind: np.bincount(decode, np.isin(proposer, names), decodes) > 0 for kind, names in costs.items()}
    for kind, names in costs.items():
        if any(parts("proposer")[name].traits.get("looks_up") for name in names):
            others[kind] |= looked_up
    last = np.diff(decode, append=decodes) > 0
    forward = mode != "skip"
    accepted = np.where(parallel, 0, rounds["accepted"])
    return Work(
        decode=decode[forward],
        prefill=(rounds["start"] == 0)[forward],
        nodes=nodes[forward],
        accepted=accepted[forward],
        levels=levels[forward],
        tree=tree[forward],
        feeds=(has_drafter[decode] & ~last)[forward],
        host=np.asarray(host),
        encoded=phases["vision"] != 0,
        propose=propose,
        sources=others,
    )


def work_of_record(decode: DecodeRecord) -> Work:
    """The work of a decode that was just recorded."""
    names = ("mode", "proposer", "start", "tree_size", "accepted")
    return work_of(
        {name: np.array([getattr(one, name) for one in decode.rounds]) for name in names},
        np.array([len(decode.rounds)]),
        {name: np.array([decode.phases.get(name, absent)]) for name, absent in zip(READ_PHASES, _ABSENT, strict=True)},
        np.array([decode.similarity is not None]),
        decode.size or len(decode.tokens),
    )


def predicted(work: Work, profile: Profile) -> float:
    """`prices` of all decodes, summed."""
    return float(prices(work, profile).sum())


def prices(work: Work, profile: Profile) -> np.ndarray:
    """(decodes,) seconds by the cost model: the profile's costs of the forwards, of the drafter's passes and of the
    states it is fed, of early and retrieved drafts, and the recorded host seconds. Where the profile lacks the costs of
    those drafts, they take what was recorded."""
    rows = work.nodes + np.where(work.prefill, profile.prompt, 1)
    seconds = np.zeros(len(rows))
    for kind, chosen in (("prefill", work.prefill), ("verify", ~work.prefill)):
        seconds[chosen] = profile.times(kind, rows[chosen]) if chosen.any() else 0.0
    trees = "tree" if profile.phases.get("tree", ((), ()))[0] else "draft"
    for kind, chosen in (("draft", (work.levels > 0) & ~work.tree), (trees, work.tree)):
        if chosen.any():
            seconds[chosen] += profile.times(kind, work.levels[chosen])
    if work.feeds.any():
        fed = work.accepted + np.where(work.prefill, profile.prompt, 1)
        seconds += np.where(work.feeds, profile.times("feed", fed), 0.0)
    total = work.encoded * profile.seconds("encode", 1) + work.host + np.bincount(work.decode, seconds, len(work.host))
    used = {kind: drafts for kind, drafts in work.sources.items() if drafts.any()}
    if missing(list(used), profile):
        return np.asarray(total + work.propose)
    drafting = sum((drafts * profile.seconds(kind, 1) for kind, drafts in used.items()), np.zeros(len(total)))
    return np.asarray(total + np.where(drafting > 0, drafting, work.propose))


def missing(needs: Sequence[str], profile: Profile) -> list[str]:
    """The kinds of costs that a profile lacks."""
    return [kind for kind in needs if not profile.phases.get(kind, ((), ()))[0]]
