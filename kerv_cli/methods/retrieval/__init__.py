"""Drafts by retrieval (docs/methods.md §4.1, §4.2; HeiSD): settings and registration of the proposer, its datastore,
and what searches that."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.base.limits import MOST_TOKENS, number
from kerv_cli.base.registry import PREFILL, add

_DATASTORE = "kerv_cli.methods.retrieval.datastore:"


@dataclass
class RetrievalProposerSettings:
    """The nearest stored chunks of the task as one tree (§4.2)."""

    kind: str = "retrieval"
    neighbours: int = number(5, 1, MOST_TOKENS)  # stored chunks
    nodes: int = number(50, 1, MOST_TOKENS)  # tree nodes


@dataclass
class QdrantSearchSettings:
    """The Qdrant engine (the extra: pip install 'kerv[qdrant]')."""

    kind: str = "qdrant"
    url: str | None = None  # a server, e.g. http://localhost:6333; None: the engine in this process


add("artifact", "datastore", _DATASTORE + "DatastoreArtifact")
_retrieval = (_DATASTORE + "RetrievalProposer.build", RetrievalProposerSettings, ("datastore",))
add("proposer", "retrieval", *_retrieval, colour=0x009E73, when=PREFILL, chains=True)
# what searches (§4.1): every backend finds the same neighbours
add("datastore", "exact", "kerv_cli.methods.retrieval.search:exact_index")
add("datastore", "qdrant", "kerv_cli.methods.retrieval.qdrant:qdrant_index", QdrantSearchSettings)
