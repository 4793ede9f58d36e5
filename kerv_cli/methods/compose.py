"""A method: which parts fit together, what they need, and the decoder that is made of them (docs/methods.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.registry import METHOD_KINDS, PREFILL, Part, part_of
from kerv_cli.engine.chunk import steps_of
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.protocol import Target
from kerv_cli.methods.context import Context
from kerv_cli.methods.parallel import ParallelPass

_BATCHED = {
    ("none", "none", "none"): "ar",
    ("early", "none", "always"): "early_unverified",
    ("none", "none", "parallel"): "parallel",
}
"""Kinds of prefill_draft, proposer and skip -> the method that is made of them."""


def check(method: Mapping[str, Any], chunk: int, trained: int, parallel: bool = False) -> None:
    """Refuses parts that do not belong together, and numbers out of range, before anything heavy is loaded.

    method: kind -> settings, for every kind of METHOD_KINDS. chunk: H of the method, 0 for the target's.
    trained: H of the target. parallel: whether the target decodes all tokens at once.

    Raises:
        UnknownName: no such part. UsageError: a composition that cannot work, or a number out of range.
    """
    parts = {kind: part_of(kind, method[kind].kind) for kind in METHOD_KINDS}
    for kind, part in parts.items():
        if not isinstance(method[kind], part.settings):
            raise UsageError(f"{kind}.kind={part.name}: choose {kind}={part.name}, each has settings of its own")
        part.check_settings(method[kind], kind)
    steps_of(chunk, trained)
    proposer, boundary, draft = parts["proposer"], parts["boundary"], parts["prefill_draft"]
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
    check_parallel(parts, parallel)
    skip = parts["skip"].traits
    joined = bool(skip.get("merges")) and draft.name == "merged"
    retrieved = bool(skip.get("retrieves")) and draft.name == "none" and proposer.name in ("hybrid", "retrieval")
    if skip.get("takes_draft") and not draft.traits.get("chains") and not joined and not retrieved:
        raise UsageError(
            f"skip={parts['skip'].name} with prefill_draft={draft.name}: it executes what one source drafts before "
            "the prefill, e.g. prefill_draft=early"
        )


def check_parallel(parts: Mapping[str, Part], parallel: bool) -> None:
    """A parallel target has one way to decode, and no other target has it.

    Raises:
        UsageError: the method and the target differ, or a part would never be used.
    """
    has_pass = bool(parts["skip"].traits.get("parallel"))
    if has_pass and not parallel:
        raise UsageError(
            "skip=parallel: this target decodes token by token; policy=parallel is the shipped one that does not, "
            "kerv train target target.parallel=true trains one"
        )
    if parallel and not has_pass:
        raise UsageError("this target decodes all tokens at once and nothing else: use method=parallel")
    idle = [kind for kind in ("prefill_draft", "proposer") if parts[kind].name != "none"]
    if has_pass and idle:
        raise UsageError(f"skip=parallel with {idle[0]}={parts[idle[0]].name}: nothing is drafted, leave it out")


def check_batch(parts: Mapping[str, Any], method: str, batch: int) -> None:
    """Refuses more than one episode at a time for methods that cannot be batched. parts: kind -> settings.

    Raises:
        UsageError: another method, or a threshold that follows one episode.
    """
    kinds = parts["prefill_draft"].kind, parts["proposer"].kind, parts["skip"].kind
    if batch == 1:
        return
    if kinds not in _BATCHED:
        *names, last = _BATCHED.values()
        raise UsageError(
            f"rollout.batch={batch} with method={method}: {', '.join(names)} and {last} alone decode several episodes "
            "at once, leave it out"
        )
    if kinds[0] != "none" and parts["threshold"].kind != "fixed":
        raise UsageError(
            f"rollout.batch={batch} with threshold={parts['threshold'].kind}: its radius follows one episode's "
            "decodes, use threshold=fixed"
        )


def check_unwatched(method: Mapping[str, Any], where: str, why: str) -> None:
    """Refuses a method that looks at the world while a chunk is executed, where that is impossible. where, why: for the
    message.

    Raises:
        UsageError: it is one.
    """
    name = method["skip"].kind
    if part_of("skip", name).traits.get("watches"):
        raise UsageError(f"skip={name} with {where}: {why}")


def is_parallel(target: Any) -> bool:
    """Whether a target decodes all tokens at once; see `targets.protocol.ParallelTarget`."""
    return bool(getattr(target, "parallel", False))


def needs(method: Mapping[str, Any]) -> tuple[str, ...]:
    """The kinds of artifacts that a method's parts read, each once, in the order of its parts."""
    kinds = (need for kind in METHOD_KINDS for need in part_of(kind, method[kind].kind).needs(method[kind]))
    return tuple(dict.fromkeys(kinds))


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
