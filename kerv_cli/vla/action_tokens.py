"""Actions <-> tokens, and what every token of a chunk means.

Tokens are ordered step by step, DoF by DoF: token j is control step j // D, DoF j % D (METHODS §0). The bins are
OpenVLA's: 256 edges on [-1, 1], 255 centres; a token is the index of its bin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

EDGES = np.linspace(-1.0, 1.0, 256)
CENTRES = (EDGES[:-1] + EDGES[1:]) / 2
VOCABULARY = len(CENTRES)  # 255
DOF_NAMES = ("dx", "dy", "dz", "gripper")
GRIPPER = 3


@dataclass(frozen=True)
class ActionTokenizer:
    """Normalise per DoF with the demonstrations' 1st / 99th percentile, then bin.

    low, high: (D,) in environment units; they map to -1 and 1.
    """

    low: np.ndarray
    high: np.ndarray

    @classmethod
    def fit(cls, actions: np.ndarray) -> ActionTokenizer:
        """actions (n, D), environment units. A DoF that never moves gets a unit range around its value."""
        low, high = np.percentile(actions, [1, 99], axis=0)
        still = high - low < 1e-6
        return cls(np.where(still, low - 1.0, low), np.where(still, high + 1.0, high))

    @property
    def dofs(self) -> int:
        return len(self.low)

    def normalise(self, actions: np.ndarray) -> np.ndarray:
        """(..., D) environment units -> [-1, 1]."""
        return np.clip(2.0 * (actions - self.low) / (self.high - self.low) - 1.0, -1.0, 1.0)

    def unnormalise(self, values: np.ndarray) -> np.ndarray:
        """(..., D) in [-1, 1] -> environment units."""
        return (values + 1.0) / 2.0 * (self.high - self.low) + self.low

    def encode(self, actions: np.ndarray) -> np.ndarray:
        """(..., D) environment units -> (..., D) int64 tokens in [0, 254]."""
        return bins_of(self.normalise(actions))

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        """(..., D) tokens -> (..., D) environment units; the centre of each bin."""
        return self.unnormalise(values_of(tokens))


def bins_of(values: np.ndarray) -> np.ndarray:
    """Normalised values -> tokens. Both ends belong to the outermost bins."""
    return np.clip(np.digitize(values, EDGES) - 1, 0, VOCABULARY - 1).astype(np.int64)


def values_of(tokens: np.ndarray) -> np.ndarray:
    """Tokens -> normalised values, the bins' centres."""
    return CENTRES[np.asarray(tokens)]
