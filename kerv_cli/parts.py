"""kerv's own parts: the settings of each, with their defaults, and what each needs. Nothing heavy is imported here.

A method (docs/methods.md) is a composition of these parts, one of every kind in `METHOD_KINDS`. A part's settings are a
dataclass whose `kind` is the part's name; a YAML file under conf/ holds only what differs from the defaults here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from kerv_cli.errors import UsageError
from kerv_cli.registry import Part, find, register

METHOD_KINDS = ("prefill_draft", "proposer", "acceptance", "threshold", "rectifier", "boundary", "skip")
"""The parts of a method, in the order in which a decode meets them."""

PREFILL, STATES = "prefill", "states"
"""When a proposer can draft: before the prefill, or only behind it because it reads the target's hidden states."""


@dataclass
class Nothing:
    """Nothing is drafted, or nothing is skipped."""

    kind: str = "none"


# --- proposers: who drafts (§2.2, §4, §5); all but the drafter can draft before the prefill as well


@dataclass
class DrafterProposerSettings:
    """EAGLE-style drafter (§2.2). The default is a greedy chain as deep as the chunk: on a CPU it beats a tree, because
    relaxed acceptance forgives what siblings would catch and every verified node costs time (study=tree)."""

    kind: str = "drafter"
    depth: int = 15  # tokens
    top_k: int = 1  # children expanded per level
    nodes: int = 15  # tree nodes kept after reranking


@dataclass
class EarlyProposerSettings:
    """The early drafter's chunk: one chain from the prompt alone (§5)."""

    kind: str = "early"


@dataclass
class PredictionProposerSettings:
    """A kinematic prediction of the whole chunk as draft (§3.1): hold, linear, kalman, damped or acceleration."""

    kind: str = "hold"


@dataclass
class RetrievalProposerSettings:
    """The nearest stored chunks of the task as one tree (§4.2)."""

    kind: str = "retrieval"
    neighbours: int = 5  # stored chunks
    nodes: int = 50  # tree nodes


@dataclass
class HybridProposerSettings:
    """HeiSD: retrieval on one side of the boundary, the drafter on the other (§4.4). The paper's five neighbours need
    about 50 nodes and cost more than they gain here."""

    kind: str = "hybrid"
    depth: int = 15  # the drafter's, tokens
    top_k: int = 1
    nodes: int = 24  # of either side's tree
    neighbours: int = 3


@dataclass
class JacobiProposerSettings:
    """PD-VLA: the parallel argmax of the guess before, over the rest of the chunk (§6)."""

    kind: str = "jacobi"
    depth: int = 0  # tokens guessed at once; 0: all that are left


@dataclass
class MergedProposerSettings:
    """Whole drafts of several sources in one prefix tree, a branch each (§5, ours). The fallback sources draft only
    where none of the others is sure of its chunk: every node costs time."""

    kind: str = "merged"
    sources: list[str] = field(default_factory=lambda: ["early"])
    fallback: list[str] = field(default_factory=lambda: ["hold"])
    nodes: int = 48  # what is named last is dropped first
    neighbours: int = 1  # retrieval: stored chunks


# --- acceptance: which drafts are good enough (§2.1)


@dataclass
class StrictAcceptanceSettings:
    """A draft token must equal the target's: lossless."""

    kind: str = "strict"


@dataclass
class RelaxedAcceptanceSettings:
    """Spec-VLA: a draft token within r bins of the target's is kept."""

    kind: str = "relaxed"
    strict_dofs: bool = True  # ours: the action space's strict DoFs must match; the paper has one r for all


@dataclass
class SequenceAcceptanceSettings:
    """HeiSD: a kinematic group of one control step is accepted or rejected as a whole; strict DoFs must match."""

    kind: str = "sequence"
    group_limit: int = 30  # summed bias of a group, bins
    token_limit: int = 15  # bias of one token, bins


@dataclass
class HybridAcceptanceSettings:
    """HeiSD: retrieved drafts by `sequence`, all others by `relaxed`."""

    kind: str = "hybrid"
    strict_dofs: bool = True
    group_limit: int = 30
    token_limit: int = 15


# --- thresholds: r, in bins (§3.2)


@dataclass
class FixedThresholdSettings:
    """Spec-VLA: one radius."""

    kind: str = "fixed"
    r: int = 9


@dataclass
class KinematicThresholdSettings:
    """KERV: the radius follows the kinematic variability K of the decode before. `change`: it moves against the change
    of K (ablation)."""

    kind: str = "kinematic"
    r_min: int = 5
    r_max: int = 15
    phi: float = 2.0
    k_s: float | None = None  # reference level of K; None: the task's, from the calibration


@dataclass
class ScheduleThresholdSettings:
    """KERV's public code, r = 3 + 12 exp(−(t / τ)³): open loop, K is not looked at."""

    kind: str = "schedule"
    r_min: int = 3
    r_max: int = 15
    phi: float = 3.0
    tau: float = 20.0  # decodes


# --- rectifiers: what happens after a rejection (§3.1)


@dataclass
class ReinferSettings:
    """The target decodes on."""

    kind: str = "reinfer"


@dataclass
class CompensateSettings:
    """KERV: predict the rest of the rejected control step, drop the rest of the chunk."""

    kind: str = "compensate"
    predictor: str = "hold"  # a predictor, or draft: what the rejected draft had behind the rejected token (ours)
    steps: int = 1  # PL: control steps that a prediction may fill
    use_target_token: bool = True  # ours: the target's token at the rejected position is kept; false: predicted (KERV)
    min_verified: int = 1  # DoFs of a step that must be known for it to be filled
    rest: int = 0  # decodes without compensation after one (KERV: 4)
    max_dropped: int = -1  # control steps of the chunk that a compensation may drop; -1: any number (KERV)


# --- boundaries: which side of a hybrid proposer drafts (§4.4)


@dataclass
class ConstantBoundarySettings:
    """always: the method has one proposer. always_retrieval, always_drafter: one side of a hybrid proposer."""

    kind: str = "always"


@dataclass
class FusedBoundarySettings:
    """HeiSD: retrieval where the path is straight and fast, the drafter where it bends or slows down."""

    kind: str = "fused"
    alpha: float = 0.5  # weight of the radius of curvature against the path length
    window: int = 15  # newest measured positions
    f_star: float = 0.3  # fused metric from which retrieval drafts (measured; HeiSD: 0.5)


@dataclass
class RandomBoundarySettings:
    """The control of the fused boundary: the same shares without the metric."""

    kind: str = "random"
    p: float = 0.5  # probability of retrieval
    seed: int = 0


# --- skip: what is executed without a verification (§4.3)


@dataclass
class AlwaysSkipSettings:
    """What `prefill_draft` drafts is executed, never verified: the baseline without which no speedup means anything."""

    kind: str = "always"


@dataclass
class SimilaritySkipSettings:
    """HeiSD: a retrieved chunk whose similarity reaches s_min is executed without a forward of the target's trunk."""

    kind: str = "similarity"
    s_min: float | None = None  # None: the task's, from the calibration
    max_skips: int = 2  # decodes in a row without a verification
    up: float = 0.0  # share of the calibrated range that s_min rises after a failed episode (HeiSD's feedback: 0.25)
    down: float = 0.0  # and falls after a successful one (0.05); above 0 results depend on the order of episodes


# --- who searches the datastore (§4.1): every backend gives the same neighbours


@dataclass
class ExactSearchSettings:
    """In this process, numpy."""

    kind: str = "exact"


@dataclass
class QdrantSearchSettings:
    """The Qdrant engine (the extra: pip install 'kerv[qdrant]')."""

    kind: str = "qdrant"
    url: str | None = None  # a server, e.g. http://localhost:6333; None: the engine in this process


# --- executors of a sweep


@dataclass
class SlurmOptions:
    """`runtime.executor_options` of slurm: a block is a job."""

    cluster: str = "slurm"  # slurm | local (submitit's own processes on this machine)
    partition: str = ""  # empty: the cluster's default
    minutes: int = 120  # longest time of a job
    memory_gb: int = 8
    gpus: int = 0
    setup: list[str] = field(default_factory=list)  # shell lines before the job's Python starts


@dataclass
class RayOptions:
    """`runtime.executor_options` of ray: a block is a task."""

    address: str = ""  # of a running cluster, e.g. auto or ray://host:10001; empty: a Ray of its own on this machine
    gpus: float = 0.0  # per block


# --- checks of numbers, and what settings need


def _at_least(what: str, least: float, **values: float) -> None:
    for name, value in values.items():
        if not value >= least:
            raise UsageError(f"{what}.{name}={value}: at least {least:g}")


def _between(what: str, low: float, high: float, **values: float) -> None:
    for name, value in values.items():
        if not low <= value <= high:
            raise UsageError(f"{what}.{name}={value}: from {low:g} to {high:g}")


def check_tree(settings: Any) -> None:
    """Counts of a draft tree: at least one each."""
    counts = ("depth", "top_k", "nodes", "neighbours")
    _at_least("proposer", 1, **{name: getattr(settings, name) for name in counts if hasattr(settings, name)})


def check_merged(settings: MergedProposerSettings) -> None:
    """Every source must be a proposer of whole chains that can draft before the prefill."""
    check_tree(settings)
    if not settings.sources:
        raise UsageError("merged: name at least one of sources")
    for name in (*settings.sources, *settings.fallback):
        if not find("proposer", name, "source of a merged draft").traits.get("chains"):
            raise UsageError(f"source '{name}' of a merged draft: it does not draft whole chunks from the prompt")


def check_threshold(settings: Any) -> None:
    """Radii in bins and positive exponents; that a radius lies below the number of tokens is checked when built."""
    if isinstance(settings, FixedThresholdSettings):
        _at_least("threshold", 0, r=settings.r)
        return
    if not 0 <= settings.r_min <= settings.r_max:
        raise UsageError(
            f"threshold.r_min={settings.r_min} threshold.r_max={settings.r_max}: bins from 0 on, r_min not above r_max"
        )
    _positive("threshold", 50, phi=settings.phi)
    if isinstance(settings, ScheduleThresholdSettings):
        _positive("threshold", 1e9, tau=settings.tau)
    elif settings.k_s is not None:
        _positive("threshold", 1e9, k_s=settings.k_s)


def _positive(what: str, limit: float, **values: float) -> None:
    for name, value in values.items():
        if not 0 < value <= limit:
            raise UsageError(f"{what}.{name}={value}: above 0, at most {limit:g}")


def check_compensate(settings: CompensateSettings) -> None:
    """Raises UnknownName for a predictor that does not exist, UsageError for a number out of range."""
    find("predictor", settings.predictor, "rectifier.predictor")
    _at_least("rectifier", 1, steps=settings.steps)
    _at_least("rectifier", 0, rest=settings.rest, min_verified=settings.min_verified)
    if settings.predictor == "draft" and not settings.use_target_token:
        raise UsageError(
            "rectifier.predictor=draft goes on behind the target's token: leave rectifier.use_target_token=true"
        )


def check_boundary(settings: Any) -> None:
    """Raises UsageError for a number out of range."""
    if isinstance(settings, RandomBoundarySettings):
        _between("boundary", 0, 1, p=settings.p)
    elif isinstance(settings, FusedBoundarySettings):
        _between("boundary", 0, 1, alpha=settings.alpha)
        if math.isnan(settings.f_star):
            raise UsageError(f"boundary.f_star={settings.f_star}: a number")
        if settings.window < 3:
            raise UsageError(f"boundary.window={settings.window}: at least 3 positions")


def check_skip(settings: SimilaritySkipSettings) -> None:
    """Raises UsageError for a number out of range."""
    _at_least("skip", 1, max_skips=settings.max_skips)
    _at_least("skip", 0, up=settings.up, down=settings.down)


def needs_of_predictor(name: str) -> tuple[str, ...]:
    """A filter reads the noise that `kerv calibrate` fitted."""
    return ("calibration",) if find("predictor", name).traits.get("fitted") else ()


def needs_of_sources(names: Iterable[str]) -> tuple[str, ...]:
    """What the sources of a merged draft need together."""
    return tuple(dict.fromkeys(kind for name in names for kind in find("proposer", name).needs(None)))


def _calibrated(reads: bool) -> tuple[str, ...]:
    return ("calibration",) if reads else ()


# --- the registry's entries

_BUILD = "kerv_cli.decoding.build:"

register(
    Part(
        "environment",
        "metaworld",
        "kerv_cli.environments.metaworld.spec:SPEC",
        traits={"names": "kerv_cli.environments.metaworld.tasks:NAMES"},
    )
)
register(
    Part(
        "environment",
        "insertion",
        "kerv_cli.environments.insertion.spec:SPEC",
        traits={"names": "kerv_cli.environments.insertion.tasks:NAMES"},
    )
)
register(Part("target", "compact", "kerv_cli.targets.compact.target:build", about="the shipped family"))

for _name, _fitted in (("hold", False), ("linear", False), ("kalman", True), ("damped", True), ("acceleration", True)):
    register(Part("predictor", _name, "kerv_cli.drafting.kinematics:build_predictor", traits={"fitted": _fitted}))
register(Part("predictor", "draft", traits={"fitted": False}, about="what the rejected draft had (rectifier only)"))

register(Part("proposer", "none", _BUILD + "nothing", Nothing, traits={"when": PREFILL}, colour=0x6E7B8B))
register(
    Part(
        "proposer",
        "drafter",
        _BUILD + "drafter",
        DrafterProposerSettings,
        lambda settings: ("drafter",),
        check_tree,
        0x56B4E9,
        {"when": STATES},
    )
)
register(
    Part(
        "proposer",
        "early",
        _BUILD + "early",
        EarlyProposerSettings,
        lambda settings: ("early",),
        colour=0xD4A6C8,
        traits={"when": PREFILL, "chains": True},
    )
)
for _name, _colour in (
    ("hold", 0xE69F00),
    ("linear", 0x0072B2),
    ("kalman", 0xD55E00),
    ("damped", 0xA0522D),
    ("acceleration", 0x4C9F70),
):
    register(
        Part(
            "proposer",
            _name,
            _BUILD + "prediction",
            PredictionProposerSettings,
            lambda settings, name=_name: needs_of_predictor(name),  # type: ignore[misc]
            colour=_colour,
            traits={"when": PREFILL, "chains": True},
        )
    )
register(
    Part(
        "proposer",
        "retrieval",
        _BUILD + "retrieval",
        RetrievalProposerSettings,
        lambda settings: ("datastore",),
        check_tree,
        0x009E73,
        {"when": PREFILL, "chains": True},
    )
)
register(
    Part(
        "proposer",
        "hybrid",
        _BUILD + "hybrid",
        HybridProposerSettings,
        lambda settings: ("drafter", "datastore"),
        check_tree,
        traits={"when": STATES, "sides": True},
    )
)
register(
    Part(
        "proposer",
        "jacobi",
        _BUILD + "jacobi",
        JacobiProposerSettings,
        check=lambda settings: _at_least("proposer", 0, depth=settings.depth),
        colour=0x8A7FD4,
        traits={"when": STATES},
    )
)
register(
    Part(
        "proposer",
        "merged",
        _BUILD + "merged",
        MergedProposerSettings,
        lambda settings: needs_of_sources([*settings.sources, *settings.fallback]),
        check_merged,
        0xCC79A7,
        {"when": PREFILL},
    )
)

register(Part("acceptance", "strict", _BUILD + "acceptance", StrictAcceptanceSettings))
register(Part("acceptance", "relaxed", _BUILD + "acceptance", RelaxedAcceptanceSettings))
register(Part("acceptance", "sequence", _BUILD + "acceptance", SequenceAcceptanceSettings))
register(Part("acceptance", "hybrid", _BUILD + "acceptance", HybridAcceptanceSettings))

register(Part("threshold", "fixed", _BUILD + "threshold", FixedThresholdSettings, check=check_threshold))
for _name in ("kinematic", "change"):
    register(
        Part(
            "threshold",
            _name,
            _BUILD + "threshold",
            KinematicThresholdSettings,
            lambda settings: _calibrated(settings.k_s is None),
            check_threshold,
        )
    )
register(Part("threshold", "schedule", _BUILD + "threshold", ScheduleThresholdSettings, check=check_threshold))

register(Part("rectifier", "reinfer", _BUILD + "nothing", ReinferSettings))
register(
    Part(
        "rectifier",
        "compensate",
        _BUILD + "compensation",
        CompensateSettings,
        lambda settings: needs_of_predictor(settings.predictor),
        check_compensate,
    )
)

register(Part("boundary", "always", _BUILD + "nothing", ConstantBoundarySettings))
for _name in ("always_retrieval", "always_drafter"):
    register(Part("boundary", _name, _BUILD + "boundary", ConstantBoundarySettings, traits={"chooses": True}))
register(
    Part(
        "boundary",
        "fused",
        _BUILD + "boundary",
        FusedBoundarySettings,
        lambda settings: ("calibration",),
        check_boundary,
        traits={"chooses": True},
    )
)
register(
    Part(
        "boundary",
        "random",
        _BUILD + "boundary",
        RandomBoundarySettings,
        check=check_boundary,
        traits={"chooses": True},
    )
)

register(Part("skip", "none", _BUILD + "nothing", Nothing))
register(Part("skip", "always", _BUILD + "always_skip", AlwaysSkipSettings, traits={"takes_draft": True}))
register(
    Part(
        "skip",
        "similarity",
        _BUILD + "similarity_skip",
        SimilaritySkipSettings,
        lambda settings: ("datastore", *_calibrated(settings.s_min is None)),
        check_skip,
        0xF0E442,
    )
)

register(Part("datastore", "exact", "kerv_cli.drafting.search:exact_index", ExactSearchSettings))
register(Part("datastore", "qdrant", "kerv_cli.drafting.qdrant:qdrant_index", QdrantSearchSettings))

register(Part("artifact", "drafter", "kerv_cli.drafting.eagle:ARTIFACT"))
register(Part("artifact", "early", "kerv_cli.drafting.early:ARTIFACT"))
register(Part("artifact", "datastore", "kerv_cli.drafting.datastore:ARTIFACT"))
register(Part("artifact", "calibration", "kerv_cli.decoding.calibration_file:ARTIFACT"))

register(Part("executor", "local", "kerv_cli.studies.executors.local:build", about="processes of this machine"))
register(
    Part(
        "executor",
        "slurm",
        "kerv_cli.studies.executors.slurm:build",
        SlurmOptions,
        traits={"package": "submitit", "extra": "slurm"},
        about="jobs of a Slurm cluster",
    )
)
register(
    Part(
        "executor",
        "ray",
        "kerv_cli.studies.executors.ray:build",
        RayOptions,
        traits={"package": "ray", "extra": "ray"},
        about="tasks of a Ray cluster",
    )
)
