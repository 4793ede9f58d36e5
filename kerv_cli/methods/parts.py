"""kerv's own parts: the settings of each, with their defaults and limits, and the artifacts that each needs. Nothing
heavy is imported here.

A method (docs/methods.md) is a composition of these parts, one of every kind in `METHOD_KINDS`. A part's settings are a
dataclass whose `kind` is the part's name; a YAML file under conf/ holds only what differs from the defaults here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import number
from kerv_cli.base.registry import NoSettings, Part, find, register

METHOD_KINDS = ("prefill_draft", "proposer", "acceptance", "threshold", "rectifier", "boundary", "skip")
"""The parts of a method, in the order in which a decode uses them."""

PART_GROUPS = (*METHOD_KINDS, "datastore")
"""Settings of a rollout whose choices are parts; YAML files in conf/<group>/ are further choices."""

MOST_TOKENS = 65_536  # of a draft or its tree
LOSS_SCALE = 0.1  # ε_a: mean abs difference of two chunks that counts as a whole loss, normalised action units
MOST_BINS = 65_536
MOST_DECODES = 1_000_000  # of an episode, in which a setting may count

PREFILL, STATES = "prefill", "states"
"""When a proposer can draft: before the prefill, or only behind it because it reads the target's hidden states."""


def part_of(group: str, name: str) -> Part:
    """The part that a group of settings chooses; an in-prefill draft's part is an ordinary proposer.

    Raises:
        UnknownName: there is none.
    """
    return find("proposer" if group == "prefill_draft" else group, name, f"{group}.kind")


# --- proposers: what drafts (§2.2, §4, §5); most can draft before the prefill as well


@dataclass
class DrafterProposerSettings:
    """EAGLE-style drafter (§2.2). The default is a greedy chain as deep as the chunk: on a CPU it beats a tree, because
    relaxed acceptance accepts most of what siblings would catch, and every verified node costs time (study=tree)."""

    kind: str = "drafter"
    depth: int = number(15, 1, MOST_TOKENS)  # tokens
    top_k: int = number(1, 1, MOST_TOKENS)  # children expanded per level
    nodes: int = number(15, 1, MOST_TOKENS)  # tree nodes kept after reranking


@dataclass
class RetrievalProposerSettings:
    """The nearest stored chunks of the task as one tree (§4.2)."""

    kind: str = "retrieval"
    neighbours: int = number(5, 1, MOST_TOKENS)  # stored chunks
    nodes: int = number(50, 1, MOST_TOKENS)  # tree nodes


@dataclass
class HybridProposerSettings:
    """HeiSD: retrieval on one side of the boundary, the drafter on the other (§4.4). The paper's five neighbours need
    about 50 nodes and cost more than they gain here."""

    kind: str = "hybrid"
    depth: int = number(15, 1, MOST_TOKENS)  # the drafter's, tokens
    top_k: int = number(1, 1, MOST_TOKENS)
    nodes: int = number(24, 1, MOST_TOKENS)  # of either side's tree
    neighbours: int = number(3, 1, MOST_TOKENS)


@dataclass
class JacobiProposerSettings:
    """PD-VLA: the parallel argmax of the guess before, over the rest of the chunk (§6)."""

    kind: str = "jacobi"
    depth: int = number(0, 0, MOST_TOKENS)  # tokens guessed at once; 0: all that are left


@dataclass
class MergedProposerSettings:
    """Merges whole drafts of several sources into one prefix tree (§5, ours). The fallback sources draft only where
    none of the others is sure of its chunk, because every node costs time."""

    kind: str = "merged"
    sources: list[str] = field(default_factory=lambda: ["early"])
    fallback: list[str] = field(default_factory=lambda: ["hold"])
    nodes: int = number(48, 1, MOST_TOKENS)  # the last sources' chains are dropped first
    neighbours: int = number(1, 1, MOST_TOKENS)  # retrieval: stored chunks


# --- acceptance: which drafts are good enough (§2.1)


@dataclass
class RelaxedAcceptanceSettings:
    """Spec-VLA: a draft token within r bins of the target's is kept."""

    kind: str = "relaxed"
    strict_dofs: bool = True  # ours: the action space's strict DoFs must match; the paper has one r for all


@dataclass
class SequenceAcceptanceSettings:
    """HeiSD: a kinematic group of one control step is accepted or rejected as a whole; strict DoFs must match."""

    kind: str = "sequence"
    group_limit: int = number(30, 0, MOST_BINS)  # summed bias of a group, bins
    token_limit: int = number(15, 0, MOST_BINS)  # bias of one token, bins


@dataclass
class HybridAcceptanceSettings:
    """HeiSD: retrieved drafts by `sequence`, all others by `relaxed`."""

    kind: str = "hybrid"
    strict_dofs: bool = True
    group_limit: int = number(30, 0, MOST_BINS)
    token_limit: int = number(15, 0, MOST_BINS)


# --- thresholds: r, in bins (§3.2); that it lies below the number of tokens is checked when it is built


@dataclass
class FixedThresholdSettings:
    """Spec-VLA: one radius."""

    kind: str = "fixed"
    r: int = number(9, 0, MOST_BINS)


@dataclass
class KinematicThresholdSettings:
    """KERV: the radius follows the kinematic variability K of the decode before. `change`: it moves against the change
    of K (ablation)."""

    kind: str = "kinematic"
    r_min: int = number(5, 0, MOST_BINS)
    r_max: int = number(15, 0, MOST_BINS)
    phi: float = number(2.0, above=0, most=50)
    k_s: float | None = number(None, above=0, most=1e9)  # reference level of K; None: the task's, from the calibration


@dataclass
class ScheduleThresholdSettings:
    """KERV's public code, r = 3 + 12 exp(−(t / τ)³) in decode t: open loop, K is not used."""

    kind: str = "schedule"
    r_min: int = number(3, 0, MOST_BINS)
    r_max: int = number(15, 0, MOST_BINS)
    phi: float = number(3.0, above=0, most=50)
    tau: float = number(20.0, above=0, most=1e9)  # decodes


# --- rectifiers: what happens after a rejection (§3.1)


@dataclass
class CompensateSettings:
    """KERV: predict the rest of the rejected control step, drop the rest of the chunk."""

    kind: str = "compensate"
    predictor: str = "hold"  # a predictor, or draft: the rejected draft's remaining tokens (ours)
    steps: int = number(1, 1, MOST_TOKENS)  # PL: control steps that a prediction may fill
    use_target_token: bool = True  # ours: the target's token at the rejected position is kept; false: predicted (KERV)
    min_verified: int = number(1, 0, MOST_TOKENS)  # DoFs of a step that must be known for it to be filled
    rest: int = number(0, 0, MOST_DECODES)  # decodes without compensation after one (KERV: 4)
    max_dropped: int = number(-1, -1, MOST_TOKENS)  # control steps that a compensation may drop; -1: any (KERV)


# --- boundaries: which side of a hybrid proposer drafts (§4.4)


@dataclass
class FusedBoundarySettings:
    """HeiSD: retrieval where the path is straight and fast, the drafter where it bends or slows down."""

    kind: str = "fused"
    alpha: float = number(0.5, 0, 1)  # weight of the radius of curvature against the path length
    window: int = number(15, 3, MOST_DECODES)  # newest measured positions
    f_star: float = number(0.3, -1e9, 1e9)  # fused metric from which retrieval drafts (measured; HeiSD: 0.5)


@dataclass
class RandomBoundarySettings:
    """The control of the fused boundary: the same shares without the metric."""

    kind: str = "random"
    p: float = number(0.5, 0, 1)  # probability of retrieval
    seed: int = number(0, 0, 2**32 - 1)


# --- skip: what is executed without a verification (§4.3)


@dataclass
class SimilaritySkipSettings:
    """HeiSD: a retrieved chunk whose similarity reaches s_min is executed without a forward of the target's trunk."""

    kind: str = "similarity"
    s_min: float | None = number(None, -1e9, 1e9)  # None: the task's, from the calibration
    max_skips: int = number(2, 1, MOST_DECODES)  # decodes in a row without a verification
    # share of the calibrated range that s_min rises after a failed episode (HeiSD: 0.25), and falls after a successful
    # one; above 0 results depend on the order of episodes
    up: float = number(0.0, 0, 1e9)
    down: float = number(0.0, 0, 1e9)


@dataclass
class StreakSkipSettings:
    """Verified chunks that agree with their draft allow 1, 2, 4, … unverified decodes (§4.5). The draft is the
    in-prefill one, of `merged` its first source's."""

    kind: str = "streak"
    most: int = number(8, 1)  # decodes in a row without a verification
    tolerance: float = number(0.05, 0)  # mean abs difference that still agrees, normalised; 0: accepted whole


@dataclass
class RiskSkipSettings:
    """A gate on a score, calibrated so that the risk of what it trusts is at most epsilon, and audited (§4.6). The
    draft is the in-prefill one, of `merged` its first source's; without one, what the method retrieves."""

    kind: str = "risk"
    score: str = "odds"
    epsilon: float = number(0.15, above=0, most=0.99)  # mean loss of unverified drafts
    delta: float = number(0.1, above=0, most=0.5)  # probability that the calibration, or an alarm, errs
    level: float | None = number(None, -1e9, 1e9)  # least score that is trusted; None: the certified one
    audit: float = number(0.05, 0, 1)  # p_a, share of trusted drafts that are verified all the same
    opening: int = number(1, 0, MOST_DECODES)  # first decodes of an episode that are verified
    doubt: float = number(
        1.0, above=0, most=2
    )  # a verified draft of this loss or more has the next one verified; 2: none


# --- what searches the datastore (§4.1): every backend gives the same neighbours


@dataclass
class QdrantSearchSettings:
    """The Qdrant engine (the extra: pip install 'kerv[qdrant]')."""

    kind: str = "qdrant"
    url: str | None = None  # a server, e.g. http://localhost:6333; None: the engine in this process


# --- executors of a sweep


@dataclass
class LocalOptions:
    """The local executor has no `runtime.executor_options`."""


@dataclass
class SlurmOptions:
    """`runtime.executor_options` of slurm: a block is a job."""

    cluster: str = "slurm"  # slurm | local (submitit's own processes on this machine)
    partition: str = ""  # empty: the cluster's default
    minutes: int = number(120, 1, 100_000)  # longest time of a job
    memory_gb: int = number(8, 1, 100_000)
    gpus: int = number(0, 0, 1024)
    setup: list[str] = field(default_factory=list)  # shell lines before the job's Python starts


@dataclass
class RayOptions:
    """`runtime.executor_options` of ray: a block is a task."""

    address: str = ""  # of a running cluster, e.g. auto or ray://host:10001; empty: a Ray of its own on this machine
    gpus: float = number(0.0, 0, 1024)  # per block


# --- checks of settings together, and the artifacts that settings need


def check_merged(settings: MergedProposerSettings) -> None:
    """Raises UsageError without a source, or for one that cannot draft whole chains before the prefill."""
    if not settings.sources:
        raise UsageError("merged: name at least one of sources")
    for name in (*settings.sources, *settings.fallback):
        if not find("proposer", name, "source of a merged draft").traits.get("chains"):
            raise UsageError(f"source '{name}' of a merged draft: it does not draft whole chunks from the prompt")


def check_risk(settings: RiskSkipSettings) -> None:
    """Raises UnknownName for a score that does not exist."""
    find("score", settings.score, "skip.score")


def needs_of_risk(settings: RiskSkipSettings) -> tuple[str, ...]:
    """What the score reads, and the recording that certifies a level, unless one is given."""
    certified = ("risk",) if settings.level is None else ()
    return (*certified, *find("score", settings.score, "skip.score").needs(None))


def check_radii(settings: KinematicThresholdSettings | ScheduleThresholdSettings) -> None:
    """Raises UsageError for radii that are negative or not in order."""
    if not 0 <= settings.r_min <= settings.r_max:
        raise UsageError(
            f"threshold.r_min={settings.r_min} threshold.r_max={settings.r_max}: bins from 0 on, r_min not above r_max"
        )


def check_compensate(settings: CompensateSettings) -> None:
    """Raises UnknownName for a predictor that does not exist, UsageError for one that lacks the target's token."""
    find("predictor", settings.predictor, "rectifier.predictor")
    if settings.predictor == "draft" and not settings.use_target_token:
        raise UsageError(
            "rectifier.predictor=draft goes on behind the target's token: leave rectifier.use_target_token=true"
        )


def needs_of_predictor(name: str) -> tuple[str, ...]:
    """A filter reads the noise that `kerv calibrate` fitted."""
    return ("calibration",) if find("predictor", name).traits.get("fitted") else ()


def needs_of_sources(names: Iterable[str]) -> tuple[str, ...]:
    """The artifacts that the sources of a merged draft need together."""
    return tuple(dict.fromkeys(kind for name in names for kind in find("proposer", name).needs(None)))


def _calibrated(reads: bool) -> tuple[str, ...]:
    return ("calibration",) if reads else ()


# --- the registry's entries

_Needs = tuple[str, ...] | Callable[[Any], tuple[str, ...]]


def _add(
    kind: str,
    name: str,
    build: str = "",
    settings: type = NoSettings,
    needs: _Needs = (),
    check: Callable[[Any], None] | None = None,
    colour: int | None = None,
    **traits: Any,
) -> None:
    """Registers a part. build: in kerv_cli; needs: artifact kinds, or a function of the settings."""
    wanted = needs if callable(needs) else lambda _: needs
    register(Part(kind, name, build and f"kerv_cli.{build}", settings, wanted, check, colour, traits))


_add("environment", "metaworld", "worlds.metaworld.spec:SPEC", names="kerv_cli.worlds.metaworld.tasks:NAMES")
for _name, _module, _class, _needs in (
    ("push", "push", "Push", ("actions", "position")),
    ("actuation", "actuation", "Actuation", ("actions",)),
    ("sensor", "sensor", "Sensor", ("images",)),
    ("light", "light", "Light", ("model",)),
    ("colour", "colour", "Colour", ("model",)),
    ("camera", "camera", "CameraJitter", ("model",)),
    ("object", "objects", "Objects", ("model", "range")),
):
    _add("stress", _name, f"worlds.stress.{_module}:{_class}", needed=_needs)
_add("stress", "none")
_add("target", "compact", "targets.compact.folder:build")
_add(
    *("target", "openvla", "targets.openvla.target:build"),
    weights="kerv_cli.targets.openvla.target:check_weights",
    importer="kerv_cli.targets.openvla.importing:import_checkpoint",
    images_alone=True,  # reads no state
)
_add("artifact", "drafter", "methods.eagle:ARTIFACT")
_add("artifact", "early", "methods.early:ARTIFACT")
_add("artifact", "datastore", "methods.datastore:ARTIFACT")
_add("artifact", "risk", "methods.risk_file:ARTIFACT")
_add("artifact", "score", "methods.learned_score:ARTIFACT")
_add("artifact", "calibration", "methods.calibration_file:ARTIFACT")
_add("datastore", "exact", "methods.search:exact_index")
_add("datastore", "qdrant", "methods.qdrant:qdrant_index", QdrantSearchSettings)
_add("executor", "local", "lab.executors.local:build", LocalOptions)
_add("executor", "slurm", "lab.executors.slurm:build", SlurmOptions, package="submitit", extra="slurm")
_add("executor", "ray", "lab.executors.ray:build", RayOptions, package="ray", extra="ray")

_BUILD = "methods.build:"
_CHAINS: dict[str, Any] = {
    "when": PREFILL,
    "chains": True,
}  # drafts whole chains, so that a merged draft can take it as a source

_add("proposer", "none", _BUILD + "nothing", colour=0x6E7B8B, when=PREFILL)
_add("proposer", "drafter", _BUILD + "drafter", DrafterProposerSettings, ("drafter",), colour=0x56B4E9, when=STATES)
_add("proposer", "early", _BUILD + "early", needs=("early",), colour=0xD4A6C8, **_CHAINS)
for _name, _fitted, _colour in (
    ("hold", False, 0xE69F00),
    ("linear", False, 0x0072B2),
    ("kalman", True, 0xD55E00),
    ("damped", True, 0xA0522D),
    ("acceleration", True, 0x4C9F70),
):
    _add("predictor", _name, "methods.kinematics:build_predictor", fitted=_fitted)
    _add("proposer", _name, _BUILD + "prediction", needs=_calibrated(_fitted), colour=_colour, **_CHAINS)
_add("predictor", "draft", fitted=False)  # of a rectifier only: the rejected draft's remaining tokens
_retrieval = (_BUILD + "retrieval", RetrievalProposerSettings, ("datastore",))
_add("proposer", "retrieval", *_retrieval, colour=0x009E73, **_CHAINS)
_hybrid = (_BUILD + "hybrid", HybridProposerSettings, ("drafter", "datastore"))
_add("proposer", "hybrid", *_hybrid, when=STATES, sides=True)
_add("proposer", "jacobi", _BUILD + "jacobi", JacobiProposerSettings, colour=0x8A7FD4, when=STATES)
_add(
    *("proposer", "merged", _BUILD + "merged", MergedProposerSettings),
    needs=lambda settings: needs_of_sources([*settings.sources, *settings.fallback]),
    check=check_merged,
    colour=0xCC79A7,
    when=PREFILL,
)

_add("acceptance", "strict", _BUILD + "acceptance")  # a draft token must equal the target's: lossless
_add("acceptance", "relaxed", _BUILD + "acceptance", RelaxedAcceptanceSettings)
_add("acceptance", "sequence", _BUILD + "acceptance", SequenceAcceptanceSettings)
_add("acceptance", "hybrid", _BUILD + "acceptance", HybridAcceptanceSettings)

_add("threshold", "fixed", _BUILD + "threshold", FixedThresholdSettings)
for _name in ("kinematic", "change"):
    _kinematic = (_BUILD + "threshold", KinematicThresholdSettings, lambda settings: _calibrated(settings.k_s is None))
    _add("threshold", _name, *_kinematic, check_radii)
_add("threshold", "schedule", _BUILD + "threshold", ScheduleThresholdSettings, check=check_radii)

_add("rectifier", "reinfer", _BUILD + "nothing")  # the target decodes on
_compensate = (_BUILD + "compensation", CompensateSettings, lambda settings: needs_of_predictor(settings.predictor))
_add("rectifier", "compensate", *_compensate, check_compensate)

_add("boundary", "always", _BUILD + "nothing")  # the method has one proposer
for _name in ("always_retrieval", "always_drafter"):  # one side of a hybrid proposer
    _add("boundary", _name, _BUILD + "boundary", chooses=True)
_add("boundary", "fused", _BUILD + "boundary", FusedBoundarySettings, ("calibration",), chooses=True)
_add("boundary", "random", _BUILD + "boundary", RandomBoundarySettings, chooses=True)

_add("skip", "none", _BUILD + "nothing")
_add("skip", "parallel", _BUILD + "parallel_pass", colour=0x17BECF, parallel=True)  # a parallel target's own decoding
_add("skip", "streak", _BUILD + "streak_skip", StreakSkipSettings, colour=0xE8C547, takes_draft=True, merges=True)
_risk: dict[str, Any] = {"takes_draft": True, "merges": True, "retrieves": True}
_add("skip", "risk", _BUILD + "risk_skip", RiskSkipSettings, needs_of_risk, check_risk, colour=0x3B6FB6, **_risk)
for _name, _score, _needed in (
    ("odds", "Odds", ("early",)),
    ("entropy", "Entropy", ("early",)),
    ("familiarity", "Familiarity", ("early",)),
    ("steadiness", "Steadiness", ()),
    ("agreement_hold", "agreement_hold", ()),
    ("agreement_retrieval", "agreement_retrieval", ("datastore",)),
    ("similarity", "Similarity", ("datastore",)),
    ("learned", "Learned", ("early", "score")),
):
    _add("score", _name, "methods.scores:" + _score, needs=_needed)
_add("skip", "always", _BUILD + "always_skip", takes_draft=True)  # what prefill_draft drafts is never verified
_add(
    *("skip", "similarity", _BUILD + "similarity_skip", SimilaritySkipSettings),
    needs=lambda settings: ("datastore", *_calibrated(settings.s_min is None)),
    colour=0xF0E442,
)
