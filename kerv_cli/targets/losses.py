"""Losses that targets and drafters share."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def soft_labels(tokens: int, sigma: float) -> Tensor:
    """Return a row per true bin (V, V): a discrete Gaussian of `sigma` bins. The identity for sigma 0.

    Args:
        tokens: V, number of bins.
        sigma: Standard deviation in bins.
    """
    bins = torch.arange(tokens, dtype=torch.float32)
    if sigma <= 0:
        return torch.eye(tokens)
    return torch.softmax(-((bins[:, None] - bins) ** 2) / (2 * sigma**2), -1)


def token_loss(logits: Tensor, tokens: Tensor, labels: Tensor) -> Tensor:
    """Return the mean cross-entropy of logits (B, N, V) with the soft labels of tokens (B, N)."""
    return -(labels[tokens] * F.log_softmax(logits.float(), -1)).sum(-1).mean()


def position_loss(estimated: Tensor, places: Tensor) -> Tensor:
    """Return the smooth L1 loss of estimated positions (B, K, 3) in metres, in units of 2 cm."""
    return F.smooth_l1_loss(estimated / 0.02, places / 0.02, beta=1.0) * 0.5
