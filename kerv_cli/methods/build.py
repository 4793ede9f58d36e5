"""Builds parts from their settings: the functions that the registry names, and `compose`, which calls them.

A build function takes (settings, context) and returns the part, or None for the absence of one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.registry import NoSettings, Part, find
from kerv_cli.engine.acceptance import Acceptance
from kerv_cli.engine.chunk import DraftsChunks, Proposer, steps_of
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.protocol import Target
from kerv_cli.methods import boundary as boundaries
from kerv_cli.methods import thresholds
from kerv_cli.methods.calibration_file import Calibration
from kerv_cli.methods.kinematics import MINIMUM, Predictor, build_predictor
from kerv_cli.methods.parts import LOSS_SCALE, METHOD_KINDS, PREFILL, RetrievalProposerSettings, part_of
from kerv_cli.methods.proposers import (
    DrafterProposer,
    EarlyProposer,
    HybridProposer,
    JacobiProposer,
    MergedProposer,
    PredictionProposer,
    RetrievalProposer,
)
from kerv_cli.methods.rectify import DRAFT, Compensation
from kerv_cli.methods.risk import RiskSkip
from kerv_cli.methods.risk_file import RiskRecording
from kerv_cli.methods.verify_skip import AlwaysSkip, ParallelPass, SkipLevels, StreakSkip, VerifySkip

LEAST_HISTORY = {"hold": 1, "linear": 2}  # actions that a predictor needs at least; filters: kinematics.MINIMUM


@dataclass(frozen=True)
class Context:
    """The surroundings of a part. artifact: kind -> the loaded artifact. task: full name, or empty. built: the method's
    parts so far, by kind."""

    target: Any  # a Target; some parts want a ReadableTarget
    artifact: Callable[[str], Any]
    task: str = ""
    built: dict[str, Any] = field(default_factory=dict)

    @property
    def calibration(self) -> Calibration:
        """The calibration of the target."""
        loaded: Calibration = self.artifact("calibration")
        return loaded


def check(method: Mapping[str, Any], chunk: int, trained: int, parallel: bool = False) -> None:
    """Refuses parts that do not belong together, and numbers out of range, before anything heavy is loaded.

    method: kind -> settings, for every kind of METHOD_KINDS. chunk: asked for; trained: H of the target. parallel:
    whether the target decodes all tokens at once.

    Raises:
        UnknownName: no such part. UsageError: a composition that cannot work, or a number out of range.
    """
    chosen = {kind: part_of(kind, method[kind].kind) for kind in METHOD_KINDS}
    for kind, part in chosen.items():
        if not isinstance(method[kind], part.settings):
            raise UsageError(f"{kind}.kind={part.name}: choose {kind}={part.name}, each has settings of its own")
        part.check_settings(method[kind], kind)
    steps_of(chunk, trained)
    proposer, boundary, draft = chosen["proposer"], chosen["boundary"], chosen["prefill_draft"]
    if bool(proposer.traits.get("sides")) != bool(boundary.traits.get("chooses")):
        raise UsageError(
            f"proposer={proposer.name} with boundary={boundary.name}: a boundary chooses between the two sides of "
            "proposer=hybrid, which needs one other than always"
        )
    if draft.traits.get("when") != PREFILL:
        raise UsageError(
            f"prefill_draft={draft.name}: it reads the target's states, which come after the prefill; use it as "
            f"proposer={draft.name}"
        )
    check_parallel(chosen, parallel)
    skip = chosen["skip"].traits
    joined = bool(skip.get("merges")) and draft.name == "merged"
    retrieved = bool(skip.get("retrieves")) and draft.name == "none" and proposer.name in ("hybrid", "retrieval")
    if skip.get("takes_draft") and not draft.traits.get("chains") and not joined and not retrieved:
        raise UsageError(
            f"skip={chosen['skip'].name} with prefill_draft={draft.name}: it executes what one source drafts before "
            "the prefill, e.g. prefill_draft=early"
        )


def check_parallel(chosen: Mapping[str, Part], parallel: bool) -> None:
    """A parallel target has one way to decode, and no other target has it.

    Raises:
        UsageError: the method and the target differ, or a part would never be asked.
    """
    asked = bool(chosen["skip"].traits.get("parallel"))
    if asked and not parallel:
        raise UsageError(
            "skip=parallel: this target decodes token by token; policy=parallel is the shipped one that does not, "
            "kerv train target target.parallel=true trains one"
        )
    if parallel and not asked:
        raise UsageError("this target decodes all tokens at once and nothing else: use method=parallel")
    idle = [kind for kind in ("prefill_draft", "proposer") if chosen[kind].name != "none"]
    if asked and idle:
        raise UsageError(f"skip=parallel with {idle[0]}={chosen[idle[0]].name}: nothing is drafted, leave it out")


def is_parallel(target: Any) -> bool:
    """Whether a target decodes all tokens at once; see `targets.protocol.ParallelTarget`."""
    return bool(getattr(target, "parallel", False))


def needs(method: Mapping[str, Any]) -> tuple[str, ...]:
    """The kinds of artifacts that a method's parts read, each once, in the order of its parts."""
    wanted = (need for kind in METHOD_KINDS for need in part_of(kind, method[kind].kind).needs(method[kind]))
    return tuple(dict.fromkeys(wanted))


def compose(
    method: Mapping[str, Any],
    target: Target,
    artifact: Callable[[str], Any],
    task: str = "",
    chunk: int = 0,
) -> Decoder:
    """The decoder of a method around a target.

    method: kind -> settings. artifact: kind -> the loaded artifact; called for the kinds in `needs` alone. task: full
    name, for parts whose calibrated levels differ between tasks. chunk: H; 0: the target's.

    Raises:
        UsageError: as `check`. CheckpointError: an artifact is missing or belongs to another target.
    """
    check(method, chunk, target.chunk, is_parallel(target))
    context = Context(target, artifact, task)
    for kind in METHOD_KINDS:
        context.built[kind] = part_of(kind, method[kind].kind).built(method[kind], context)
    return Decoder(target, Parts(**context.built), chunk)


def own_decoder(target: Any) -> Decoder:
    """A target as it was trained to decode: autoregressive, or all tokens in one pass."""
    return Decoder(target, Parts(skip=ParallelPass(target)) if is_parallel(target) else None)


def nothing(settings: Any, context: Context) -> None:
    """Choices that stand for the absence of a part: none, reinfer, always."""


def drafter(settings: Any, context: Context) -> DrafterProposer:
    """proposer=drafter, and the drafter's side of hybrid."""
    return DrafterProposer(context.artifact("drafter"), context.target, settings.depth, settings.top_k, settings.nodes)


def early(settings: Any, context: Context) -> EarlyProposer:
    """proposer=early."""
    return EarlyProposer(context.artifact("early"), context.target)


def prediction(settings: Any, context: Context) -> PredictionProposer:
    """proposer=hold, linear, kalman, …"""
    return PredictionProposer(predictor(settings.kind, context))


def retrieval(settings: Any, context: Context) -> RetrievalProposer:
    """proposer=retrieval, and retrieval's side of hybrid."""
    return RetrievalProposer(context.artifact("datastore"), context.target, settings.neighbours, settings.nodes)


def hybrid(settings: Any, context: Context) -> HybridProposer:
    """proposer=hybrid."""
    return HybridProposer(drafter(settings, context), retrieval(settings, context))


def jacobi(settings: Any, context: Context) -> JacobiProposer:
    """proposer=jacobi."""
    return JacobiProposer(settings.depth)


def merged(settings: Any, context: Context) -> MergedProposer:
    """proposer=merged."""

    def source(name: str) -> DraftsChunks:
        part = find("proposer", name)
        own: Any = part.settings(kind=name)
        if isinstance(own, RetrievalProposerSettings):
            own = RetrievalProposerSettings(neighbours=settings.neighbours, nodes=settings.nodes)
        built: DraftsChunks = part.built(own, context)
        return built

    sources, fallback = ([source(name) for name in names] for names in (settings.sources, settings.fallback))
    return MergedProposer(sources, settings.nodes, fallback)


def predictor(name: str, context: Context) -> Predictor:
    """A kinematic predictor over the target's chunk; a filter's noise comes from the calibration."""
    target = context.target
    if find("predictor", name).traits.get("fitted"):
        return context.calibration.predictor(name, horizon=target.chunk)
    least = LEAST_HISTORY.get(name, MINIMUM)
    return build_predictor(name, target.actions.is_strict, {}, least, horizon=target.chunk)


def compensation(settings: Any, context: Context) -> Compensation:
    """rectifier=compensate."""
    return Compensation(settings, predictor("hold" if settings.predictor == DRAFT else settings.predictor, context))


def acceptance(settings: Any, context: Context) -> Acceptance:
    """All acceptance rules."""
    return Acceptance(
        context.target.actions,
        settings.kind,
        getattr(settings, "strict_dofs", True),
        getattr(settings, "group_limit", 0),
        getattr(settings, "token_limit", 0),
    )


def threshold(settings: Any, context: Context) -> thresholds.Threshold:
    """All thresholds; K_S is the task's, from the calibration, where none is given.

    Raises:
        UsageError: a radius above the largest distance of two tokens.
    """
    most, name = context.target.actions.tokens - 1, "r" if settings.kind == "fixed" else "r_max"
    if getattr(settings, name) > most:
        raise UsageError(f"threshold.{name}={getattr(settings, name)}: bins from 0 to {most}")
    if settings.kind == "fixed":
        return thresholds.Fixed(settings.r)
    if settings.kind == "schedule":
        return thresholds.Schedule(settings.r_min, settings.r_max, settings.phi, settings.tau)
    k_s = settings.k_s if settings.k_s is not None else context.calibration.k_s(context.task)
    kind = thresholds.Kinematic if settings.kind == "kinematic" else thresholds.Change
    return kind(settings.r_min, settings.r_max, settings.phi, k_s)


def boundary(settings: Any, context: Context) -> boundaries.Boundary:
    """All boundaries that choose."""
    if settings.kind == "random":
        return boundaries.Random(settings.p, settings.seed)
    if settings.kind == "fused":
        ranges = context.calibration.ranges(settings.window)
        return boundaries.Fused(ranges, settings.alpha, settings.window, settings.f_star)
    return boundaries.Always("retrieval" if settings.kind == "always_retrieval" else "drafter")


def always_skip(settings: Any, context: Context) -> AlwaysSkip:
    """skip=always."""
    return AlwaysSkip(context.built["prefill_draft"])


def parallel_pass(settings: Any, context: Context) -> ParallelPass:
    """skip=parallel."""
    return ParallelPass(context.target)


def streak_skip(settings: Any, context: Context) -> StreakSkip:
    """skip=streak."""
    return StreakSkip(settings, _drafts_chunks(context))


def risk_skip(settings: Any, context: Context) -> RiskSkip:
    """skip=risk.

    Raises:
        CheckpointError: the recording does not know the source or the score, or is too small to certify anything.
    """
    source = _drafts_chunks(context)
    score = find("score", settings.score).built(NoSettings(settings.score), context)
    if settings.level is not None:
        return RiskSkip(settings, source, score, settings.level, LOSS_SCALE)
    recording: RiskRecording = context.artifact("risk")
    recording.check_size(source.name, settings.epsilon, settings.delta)
    level = recording.certified(source.name, settings.score, settings.epsilon, settings.delta).level
    return RiskSkip(settings, source, score, level, recording.manifest.scale)


def _drafts_chunks(context: Context) -> DraftsChunks:
    """What drafts whole chunks before the prefill: the in-prefill draft, of a merged one its first source; without one,
    what the proposer retrieves."""
    draft: Any = context.built["prefill_draft"]
    if draft is None:
        return _retrieval_of(context)
    first: DraftsChunks = draft.sources[0] if isinstance(draft, MergedProposer) else draft
    return first


def _retrieval_of(context: Context) -> RetrievalProposer:
    """The retrieval of the method's proposer, where that retrieves; else one of its own."""
    own: Proposer | None = context.built["proposer"]
    found = own.sides["retrieval"] if isinstance(own, HybridProposer) else own
    if isinstance(found, RetrievalProposer):
        return found
    return RetrievalProposer(context.artifact("datastore"), context.target, 1, 1)


def similarity_skip(settings: Any, context: Context) -> VerifySkip:
    """skip=similarity; it shares the retrieval of the method's proposer, where that retrieves."""
    found = _retrieval_of(context)
    if settings.s_min is not None:
        return VerifySkip(settings, found, SkipLevels(settings.s_min, settings.s_min, settings.s_min))
    levels = context.calibration.skip_levels(context.task, found.datastore.content)
    return VerifySkip(settings, found, SkipLevels(*levels))
