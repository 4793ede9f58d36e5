"""Training losses of targets and drafters.

Shapes: B samples, N tokens of a chunk, V possible tokens, K places (object, goal, …) whose positions are estimated.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from kerv_cli.base.spaces import ActionSpace


def soft_labels(tokens: int, sigma: float) -> Tensor:
    """Return the probabilities (V, V) that a model should predict: row i is a Gaussian around the true token i.

    Args:
        sigma: Standard deviation in bins. If 0, the true token has the probability 1.
    """
    bins = torch.arange(tokens, dtype=torch.float32)
    if sigma <= 0:
        return torch.eye(tokens)
    return torch.softmax(-((bins[:, None] - bins) ** 2) / (2 * sigma**2), -1)


def labels_of(actions: ActionSpace, sigma: float) -> Tensor:
    """Return `soft_labels` for an action space. `sigma` has no effect on FAST tokens, which have no distances."""
    return soft_labels(actions.tokens, sigma if actions.code is None else 0.0)


def token_loss(logits: Tensor, tokens: Tensor, labels: Tensor, counted: Tensor | None = None) -> Tensor:
    """Return the mean cross-entropy between predictions and soft labels.

    Args:
        logits: (B, N, V) predictions.
        tokens: (B, N) true tokens.
        labels: (V, V) result of `soft_labels`.
        counted: (B, N) bool, the tokens to average over. If None, average over all tokens.
    """
    losses = -(labels[tokens] * F.log_softmax(logits.float(), -1)).sum(-1)
    return losses.mean() if counted is None else losses[counted].mean()


def within_chunk(tokens: Tensor, end: int | None) -> Tensor:
    """Return which tokens belong to their chunks, (B, N) bool: all up to and including the first `end`."""
    ends = tokens == (-1 if end is None else end)
    return ends.cumsum(1) - ends.long() == 0


def position_loss(estimated: Tensor, places: Tensor) -> Tensor:
    """Return half the smooth L1 loss of 3D positions (B, K, 3) in metres. Errors are measured in units of 2 cm."""
    return F.smooth_l1_loss(estimated / 0.02, places / 0.02, beta=1.0) * 0.5
