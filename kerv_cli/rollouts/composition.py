"""Whether a method's parts fit together, from its settings alone: refused before anything heavy is loaded."""

from __future__ import annotations

from kerv_cli.decoding.boundary import check_boundary
from kerv_cli.decoding.chunk import steps_of
from kerv_cli.decoding.rectify import DRAFT
from kerv_cli.drafting.kinematics import PREDICTORS
from kerv_cli.errors import UnknownName, UsageError
from kerv_cli.settings import MethodSettings, opening_sources

SOURCES = ("early", "retrieval", *PREDICTORS)
PROPOSERS = ("none", "drafter", "hybrid", "jacobi", "expert", *SOURCES)
RECTIFIERS = ("reinfer", "compensate")
SKIPS = ("none", "similarity")


def check_composition(method: MethodSettings, chunk: int) -> None:
    """chunk: the control steps that the target was trained for.

    Raises:
        UnknownName: no such part. UsageError: parts that do not belong together, or a number out of range.
    """
    _known("proposer.kind", method.proposer.kind, PROPOSERS)
    check_boundary(method.boundary)
    _known("rectifier.kind", method.rectifier.kind, RECTIFIERS)
    _known("rectifier.predictor", method.rectifier.predictor, (DRAFT, *PREDICTORS))
    _known("skip.kind", method.skip.kind, SKIPS)
    for source in opening_sources(method.opening.sources):
        _known("source of an opening", source, SOURCES)
    steps_of(method.chunk, chunk)
    if (method.proposer.kind == "hybrid") != (method.boundary.kind != "always"):
        raise UsageError(
            f"proposer={method.proposer.kind} with boundary={method.boundary.kind}: a boundary chooses between the "
            "two sides of proposer=hybrid, which needs one other than always"
        )
    if method.skip.kind != "none" and method.proposer.kind == "expert":
        raise UsageError("skip=similarity with proposer=expert: the expert verifies nothing")
    if method.opening.sources and method.opening.nodes < 1:
        raise UsageError(f"opening.nodes={method.opening.nodes}: at least 1")
    drafts = method.proposer.kind not in ("none", "expert")
    if drafts and min(method.proposer.depth, method.proposer.top_k, method.proposer.nodes) < 1:
        raise UsageError("proposer.depth, proposer.top_k and proposer.nodes must be at least 1")
    retrieves = {method.proposer.kind, *opening_sources(method.opening.sources)} & {"retrieval", "hybrid"}
    if retrieves and min(method.proposer.neighbours, method.opening.neighbours) < 1:
        raise UsageError("retrieval needs at least one neighbour")


def _known(what: str, name: str, known: tuple[str, ...]) -> None:
    if name not in known:
        raise UnknownName(what, name, known)
