"""How far a draft is from the target's tokens: the loss of executing it unverified."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.chunk import Chunk


def chunk_loss(space: ActionSpace, drafted: Sequence[int], targets: Sequence[int], scale: float) -> float:
    """ℓ in [0, 1] of a draft's tokens against the target's, from a chunk's first token on: 1 where a strict DoF's token
    differs, else the mean absolute difference in normalised action units ÷ `scale`, at most 1."""
    tokens, others = np.array(drafted), np.array(targets)
    if (tokens != others)[space.strict_tokens(len(tokens))].any():
        return 1.0
    off = np.abs(space.values_of(tokens) - space.values_of(others)).mean()
    return min(1.0, float(off) / scale)


def judged_tokens(chunk: Chunk, chain: Sequence[int]) -> list[int] | None:
    """The target's tokens along `chain`, from the first verification of the chunk; None where it judged another draft,
    or less than all but the last token of the chain.

    Call it before the next round, which forgets what lay behind the rejection.
    """
    if not chunk.rounds:
        return None
    verification, rejection = chunk.rounds[-1], chunk.rejection
    path = [*verification.drafted, *rejection.draft]
    if verification.start or len(path) < chunk.size - 1 or path != list(chain[: len(path)]):
        return None
    return [*verification.target_tokens[: len(verification.drafted)], *rejection.target[: len(rejection.draft)]]
