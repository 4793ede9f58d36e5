"""Parallel decoding, as in OpenVLA-OFT (docs/methods.md §6)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.registry import NoSettings, Part, SkipPart
from kerv_cli.engine.decisions import SkipDecision
from kerv_cli.engine.parts import Skip

if TYPE_CHECKING:
    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.decoder import Decoder
    from kerv_cli.engine.protocol import ParallelTarget
    from kerv_cli.methods.context import Context


@SkipPart("parallel", colour=0x17BECF, verifies=False, batchable=True)
class ParallelPass(Skip):
    """Decodes all tokens of a chunk in one bidirectional forward of a parallel target.

    Each token is chosen without knowing the others, and no token is verified.
    """

    phase = "prefill"

    def __init__(self, target: ParallelTarget) -> None:
        self.target = target

    @classmethod
    def build(cls, settings: NoSettings, context: Context) -> ParallelPass:
        """Build the part that the setting `skip=parallel` chooses."""
        return cls(context.target)

    def take(self, chunk: Chunk) -> SkipDecision:
        """Decode all tokens of the chunk in one forward of the target."""
        from kerv_cli.engine.record import PARALLEL

        hidden = self.target.parallel_pass(chunk.target.prompt, chunk.target.cache)
        return SkipDecision(self.target.head(hidden[0, : chunk.size]).argmax(-1).tolist(), PARALLEL)


def is_parallel(target: object) -> bool:
    """Return whether a target decodes all tokens of a chunk in one forward (`engine.protocol.ParallelTarget`)."""
    return bool(getattr(target, "parallel", False))


def check_parallel(parts: Mapping[str, Part], parallel: bool) -> None:
    """Refuse skip=parallel for a target that decodes token by token, and every other method for a parallel target.

    A method that has skip=parallel and also drafts is refused, too.

    Args:
        parts: All parts of the method, by kind.
        parallel: Whether the target decodes all tokens in one forward.

    Raises:
        UsageError: The method cannot be used with the target.
    """
    has_pass = parts["skip"].name == "parallel"
    if has_pass and not parallel:
        raise UsageError(
            "skip=parallel: this target decodes token by token. Use policy=parallel, or train a parallel target with "
            "kerv train target target.parallel=true"
        )
    if parallel and not has_pass:
        raise UsageError("this target decodes all tokens at once and nothing else: use method=parallel")
    drafting = [f"{kind}={parts[kind].name}" for kind in ("prefill_draft", "proposer") if not parts[kind].absent]
    if has_pass and drafting:
        raise UsageError(f"skip=parallel with {drafting[0]}: nothing is drafted, leave it out")


def native_decoder(target: Any) -> Decoder:
    """Return a decoder without drafts. A parallel target decodes all tokens in one forward, others token by token."""
    from kerv_cli.engine.decoder import Decoder, Parts

    return Decoder(target, Parts(skip=ParallelPass(target)) if is_parallel(target) else None)
