"""HeiSD (docs/methods.md §2.1, §4): drafts by retrieval or by the drafter, and skipped verification.

A boundary chooses for each chunk whether retrieval or the drafter drafts. Retrieved drafts are accepted or rejected by
kinematic group (position, rotation, gripper). If a stored observation is similar enough, its chunk is executed without
verification.
"""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import MOST_BINS, MOST_DECODES, MOST_TOKENS, number
from kerv_cli.base.registry import DRAFTING, PREFILL, STATES, add
from kerv_cli.methods.eagle import DrafterProposerSettings, only_of_trees

MANIFEST = "manifest.json"
_DATASTORE, _RULES = "kerv_cli.methods.heisd.datastore:", "kerv_cli.methods.heisd.rules:"


# --- the datastore and its proposer (§4.1, §4.2)


@dataclass
class RetrievalProposerSettings:
    """Draft the task's most similar stored chunks, merged into one tree (docs/methods.md §4.2)."""

    kind: str = "retrieval"
    neighbours: int = number(5, 1, MOST_TOKENS)  # number of stored chunks in the tree
    nodes: int = number(50, 1, MOST_TOKENS)  # maximum number of tree nodes


add("artifact", "datastore", _DATASTORE + "DatastoreArtifact", by_task=True, needs_task=True, described_by=MANIFEST)
add(
    "proposer",
    "retrieval",
    _RULES + "RetrievalProposer.build",
    RetrievalProposerSettings,
    needs=("datastore",),
    colour=0x009E73,
    when=PREFILL,
    chains=True,
    drafts_whole_chunk=True,
    looks_up=True,
    cost="retrieval",
    measured_by="retrieval_unverified",
)
add("datastore", "exact", _DATASTORE + "ExactIndex")


@dataclass
class HybridProposerSettings(DrafterProposerSettings):
    """HeiSD: draft by retrieval or with the drafter, as the boundary chooses (docs/methods.md §4.4).

    Five neighbours make a tree of about 50 nodes, which costs more than it gains on a CPU. So the defaults are smaller.
    """

    kind: str = "hybrid"
    nodes: int = number(24, 1, MOST_TOKENS)  # maximum number of nodes of either tree
    neighbours: int = number(3, 1, MOST_TOKENS)  # retrieval: number of stored chunks in the tree


add(
    "proposer",
    "hybrid",
    _RULES + "HybridProposer.build",
    HybridProposerSettings,
    needs=("drafter", "datastore"),
    when=STATES,
    has_boundary=True,
    cost=DRAFTING,
    idle=lambda settings: only_of_trees(settings, "top_k"),  # `nodes` also limits the tree of stored chunks
)


# --- which drafts are good enough (§2.1)


@dataclass
class SequenceAcceptanceSettings:
    """HeiSD: accept or reject each kinematic group (position, rotation, gripper) of a control step as a whole.

    Strict DoFs, such as the gripper, must equal the target's tokens.
    """

    kind: str = "sequence"
    group_limit: int = number(30, 0, MOST_BINS)  # largest accepted sum of a group's distances, bins
    token_limit: int = number(15, 0, MOST_BINS)  # largest accepted distance of one token, bins


@dataclass
class HybridAcceptanceSettings(SequenceAcceptanceSettings):
    """HeiSD: judge retrieved drafts by acceptance=sequence, and all other drafts by acceptance=relaxed."""

    kind: str = "hybrid"
    strict_dofs: bool = True  # relaxed: whether strict DoFs, such as the gripper, must match (ours); public code: false


add("acceptance", "sequence", _RULES + "GroupRule.build", SequenceAcceptanceSettings, reads_threshold=False)
add("acceptance", "hybrid", _RULES + "by_proposer", HybridAcceptanceSettings)


# --- who drafts for the hybrid proposer (§4.4)


@dataclass
class FusedBoundarySettings:
    """HeiSD: retrieval drafts if the hand moves straight and fast, the drafter if it moves in a curve or slowly.

    F is the weighted sum of the path's radius of curvature and length. Retrieval drafts if F is at least F*.
    """

    kind: str = "fused"
    alpha: float = number(0.5, 0, 1)  # weight of the radius of curvature; the path length has the weight 1 − alpha
    window: int = number(15, 3, MOST_DECODES)  # number of newest hand positions to look at
    quantile: float = number(0.25, 0, 1)  # the limit F* is this quantile of F in the demonstrations (public code: 0.25)
    f_star: float | None = number(None, 0, 1)  # the limit F* itself, in place of a quantile (ours)


@dataclass
class RandomBoundarySettings:
    """Choose retrieval or the drafter at random: a baseline for boundary=fused."""

    kind: str = "random"
    p: float = number(0.5, 0, 1)  # probability of retrieval
    seed: int = number(0, 0, 2**32 - 1)


for _name in ("always_retrieval", "always_drafter"):
    add("boundary", _name, _RULES + "Random.always", chooses=True)
add(
    "boundary",
    "fused",
    _RULES + "Fused.build",
    FusedBoundarySettings,
    ("calibration",),
    chooses=True,
    idle=lambda settings: {} if settings.f_star is None else {"quantile": "boundary.f_star names the limit"},
)
add("boundary", "random", _RULES + "Random.build", RandomBoundarySettings, chooses=True)


# --- which retrieved chunks are executed without verification (§4.3)


@dataclass
class SimilaritySkipSettings:
    """HeiSD: execute the nearest stored chunk without verification if its observation is similar enough (s_min)."""

    kind: str = "similarity"
    s_min: float | None = number(None, -1e9, 1e9)  # smallest sufficient cosine; None: the task's calibrated value
    max_skips: int = number(2, 1, MOST_DECODES)  # maximum number of decodes in a row without verification (public code)
    # feedback, as a share of the calibrated range: s_min rises by `up` after a failed episode and falls by `down` after
    # a successful one; above 0, results depend on the order of the episodes
    up: float = number(0.0, 0, 1e9)
    down: float = number(0.0, 0, 1e9)


def needs_of_similarity(settings: SimilaritySkipSettings) -> tuple[str, ...]:
    """Return the kinds of artifacts needed: the datastore, and the calibration if `s_min` is None."""
    return ("datastore", "calibration") if settings.s_min is None else ("datastore",)


add("skip", "similarity", _RULES + "VerifySkip.build", SimilaritySkipSettings, needs_of_similarity, colour=0xF0E442)
