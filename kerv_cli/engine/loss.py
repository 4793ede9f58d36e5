"""How far a draft is from the target's tokens: the loss of executing it unverified (docs/methods.md §4.6)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.protocol import Target
from kerv_cli.engine.transfer import upload

BAD = 0.5  # a draft with a larger loss is one that should have been verified


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
    played, rejection = chunk.rounds[-1], chunk.rejection
    path = [*played.drafted, *rejection.draft]
    if played.start or len(path) < chunk.size - 1 or path != list(chain[: len(path)]):
        return None
    return [*played.target_tokens[: len(played.drafted)], *rejection.target[: len(rejection.draft)]]


def executed_loss(chunk: Chunk, chain: Sequence[int], scale: float) -> float:
    """ℓ of a draft against what a complete chunk executes, for drafts that no verification judged along their path."""
    space, n = chunk.space, len(chunk.tokens)
    if chunk.closed is None:
        return chunk_loss(space, chain[:n], chunk.tokens, scale)
    values = chunk.closed.reshape(-1)
    if n and chunk_loss(space, chain[:n], chunk.tokens, scale) == 1.0:
        return 1.0
    off = np.abs(space.values_of(np.array(chain[: values.size])) - values).mean()
    return min(1.0, float(off) / scale)


def auc(scores: np.ndarray, bad: np.ndarray) -> float:
    """Probability that a bad draft scores below a good one, ties counting half; NaN where all are alike. scores (n,),
    bad (n,) bool."""
    low, high = np.sort(scores[bad]), scores[~bad]
    if not low.size or not high.size:
        return math.nan
    below, not_above = (np.searchsorted(low, high, side) for side in ("left", "right"))
    return float((below + not_above).mean() / (2 * low.size))


@torch.inference_mode()
def target_tokens(target: Target, chunk: Chunk, chain: Sequence[int]) -> list[int]:
    """The target's argmax token at every index of the chunk, given the chain's tokens before it: one forward. The
    chunk's cache is overwritten; a prefill afterwards begins it anew."""
    device, length = chunk.prompt.device, chunk.prompt_length
    drafted = target.embed(upload([list(chain[: chunk.size - 1])], device))
    x = torch.cat([chunk.prompt, drafted], 1)
    chunk.cache.length = 0
    hidden = target.forward(x, torch.arange(x.shape[1], device=device), chunk.cache, None)
    tokens: list[int] = target.head(hidden[0, length - 1 :]).argmax(-1).tolist()
    chunk.cache.length = 0
    return tokens
