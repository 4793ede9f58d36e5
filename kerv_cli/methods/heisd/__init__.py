"""HeiSD (docs/methods.md §2.1, §4): drafts by retrieval, beside the drafter, and skipped verification.

A boundary chooses between retrieval and the drafter. Kinematic groups are accepted as a whole. If a stored observation
is similar enough, its chunk is executed without verification.
"""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import MOST_BINS, MOST_DECODES, MOST_TOKENS, number
from kerv_cli.base.registry import DRAFTING, PREFILL, STATES, add

MANIFEST = "manifest.json"
_DATASTORE, _RULES = "kerv_cli.methods.heisd.datastore:", "kerv_cli.methods.heisd.rules:"


# --- the datastore and what drafts from it (§4.1, §4.2)


@dataclass
class RetrievalProposerSettings:
    """The nearest stored chunks of the task as one tree (§4.2)."""

    kind: str = "retrieval"
    neighbours: int = number(5, 1, MOST_TOKENS)  # stored chunks
    nodes: int = number(50, 1, MOST_TOKENS)  # tree nodes


@dataclass
class QdrantSearchSettings:
    """Search by Qdrant (the extra: pip install 'kerv[qdrant]'). Without url and path: in memory."""

    kind: str = "qdrant"
    url: str | None = None  # a server, e.g. http://localhost:6333
    path: str | None = None  # a folder of qdrant-client's local mode, for one process at a time


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
add("datastore", "qdrant", _DATASTORE + "QdrantIndex", QdrantSearchSettings)


@dataclass
class HybridProposerSettings:
    """HeiSD: retrieval or the drafter, as the boundary says (§4.4).

    The paper's five neighbours need about 50 nodes and cost more than they gain here.
    """

    kind: str = "hybrid"
    depth: int = number(15, 1, MOST_TOKENS)  # the drafter's, tokens
    top_k: int = number(1, 1, MOST_TOKENS)
    nodes: int = number(24, 1, MOST_TOKENS)  # of a tree
    neighbours: int = number(3, 1, MOST_TOKENS)


_hybrid = (_RULES + "HybridProposer.build", HybridProposerSettings, ("drafter", "datastore"))
add("proposer", "hybrid", *_hybrid, when=STATES, has_boundary=True, cost=DRAFTING)


# --- which drafts are good enough (§2.1)


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


add("acceptance", "sequence", _RULES + "GroupRule.build", SequenceAcceptanceSettings, reads_threshold=False)
add("acceptance", "hybrid", _RULES + "by_proposer", HybridAcceptanceSettings)


# --- who drafts for the hybrid proposer (§4.4)


@dataclass
class FusedBoundarySettings:
    """HeiSD: retrieval where the path is straight and fast, the drafter where it bends or slows down."""

    kind: str = "fused"
    alpha: float = number(0.5, 0, 1)  # weight of the radius of curvature against the path length
    window: int = number(15, 3, MOST_DECODES)  # newest measured positions
    f_star: float = number(0.3, 0, 1)  # fused metric from which retrieval drafts (measured; HeiSD: 0.5)


@dataclass
class RandomBoundarySettings:
    """The control of the fused boundary: the same shares without the metric."""

    kind: str = "random"
    p: float = number(0.5, 0, 1)  # probability of retrieval
    seed: int = number(0, 0, 2**32 - 1)


for _name in ("always_retrieval", "always_drafter"):
    add("boundary", _name, _RULES + "Random.always", chooses=True)
add("boundary", "fused", _RULES + "Fused.build", FusedBoundarySettings, ("calibration",), chooses=True)
add("boundary", "random", _RULES + "Random.build", RandomBoundarySettings, chooses=True)


# --- what is executed without a verification (§4.3)


@dataclass
class SimilaritySkipSettings:
    """HeiSD: executes a retrieved chunk of at least similarity s_min without a forward of the target's trunk."""

    kind: str = "similarity"
    s_min: float | None = number(None, -1e9, 1e9)  # None: the task's, from the calibration
    max_skips: int = number(2, 1, MOST_DECODES)  # decodes in a row without a verification
    # share of the calibrated range that s_min rises after a failed episode (HeiSD: 0.25), and falls after a successful
    # one; above 0 results depend on the order of episodes
    up: float = number(0.0, 0, 1e9)
    down: float = number(0.0, 0, 1e9)


def needs_of_similarity(settings: SimilaritySkipSettings) -> tuple[str, ...]:
    """Return the datastore, and the calibration if no level is given."""
    return ("datastore", "calibration") if settings.s_min is None else ("datastore",)


add("skip", "similarity", _RULES + "VerifySkip.build", SimilaritySkipSettings, needs_of_similarity, colour=0xF0E442)
