"""Action and observation spaces as data. Numbers of a robot or simulator stand in environments only.

An environment has an `ActionSpace` and an `ObservationSpace`. Every artifact made from it stores them: target, drafter,
datastore, calibration. Artifacts of different action spaces cannot be used together (`check_same`).

Notation (docs/methods.md §0): D degrees of freedom (DoFs) per control step, H control steps per chunk, N = H · D
tokens; token j belongs to control step j // D and DoF j % D.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from kerv_cli.base.errors import CheckpointError, KervError


@dataclass(frozen=True)
class Group:
    """A kinematic group: neighbouring DoFs that are drafted and accepted together, such as position or rotation."""

    name: str
    size: int  # DoFs


@dataclass(frozen=True)
class ActionSpace:
    """The actions of one control step, and their tokens.

    Args:
        names: Names of the D DoFs, in the order of the tokens.
        groups: Kinematic groups in order. Their sizes add up to D.
        strict: DoFs whose drafted tokens must equal the target's. They are held, never extrapolated: a gripper opens or
            closes.
        control_hz: Control steps per second.
        low: (D,) environment units; the action that -1 of the normalised range means. An environment gives its limits,
            a policy the 1st percentile of its demonstrations.
        high: (D,) environment units; the action that 1 means, or the 99th percentile.
        bins: Number of edges on [-1, 1]. A token is the index of one of the bins - 1 intervals (OpenVLA: 256 edges).
        end_token: Whether the upper end has a token of its own, which decodes like the last interval. Published OpenVLA
            checkpoints were trained with it.

    Raises:
        ValueError: The numbers do not fit together.
    """

    names: tuple[str, ...]
    groups: tuple[Group, ...]
    strict: tuple[str, ...]
    control_hz: float
    low: tuple[float, ...]
    high: tuple[float, ...]
    bins: int = 256
    end_token: bool = False

    def __post_init__(self) -> None:
        if not self.names or len(set(self.names)) != len(self.names):
            raise ValueError(f"DoFs need names of their own: {self.names}")
        if sum(group.size for group in self.groups) != self.dofs or any(group.size < 1 for group in self.groups):
            raise ValueError(f"groups {self.groups} do not cover the {self.dofs} DoFs in order")
        if not set(self.strict) <= set(self.names):
            raise ValueError(f"strict {self.strict} names a DoF that is not there: {self.names}")
        if len(self.low) != self.dofs or len(self.high) != self.dofs:
            raise ValueError(f"low and high need {self.dofs} numbers each")
        if not all(low < high < np.inf and low > -np.inf for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"low {self.low} must lie below high {self.high}")
        if self.bins < 3 or not 0 < self.control_hz < np.inf:
            raise ValueError(f"bins {self.bins} must be at least 3, control_hz {self.control_hz} above 0")

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; `end_token` only if it is set."""
        plain = asdict(self)
        if not self.end_token:
            del plain["end_token"]
        return plain

    @property
    def dofs(self) -> int:
        """Number of degrees of freedom, D."""
        return len(self.names)

    @property
    def tokens(self) -> int:
        """Size of the vocabulary."""
        return self.bins - 1 + self.end_token

    @cached_property
    def edges(self) -> np.ndarray:
        """(bins,) edges of the bins on [-1, 1]."""
        return np.linspace(-1.0, 1.0, self.bins)

    @cached_property
    def centres(self) -> np.ndarray:
        """(tokens,) normalised value of every token."""
        inner = (self.edges[:-1] + self.edges[1:]) / 2
        return np.append(inner, inner[-1]) if self.end_token else inner

    @cached_property
    def middle(self) -> np.ndarray:
        """(D,) middle of every DoF's limits, environment units."""
        return (np.asarray(self.high) + np.asarray(self.low)) / 2

    @cached_property
    def half(self) -> np.ndarray:
        """(D,) half of every DoF's range, environment units."""
        return (np.asarray(self.high) - np.asarray(self.low)) / 2

    @cached_property
    def is_strict(self) -> np.ndarray:
        """(D,) bool, which DoFs are strict."""
        return np.array([name in self.strict for name in self.names])

    @cached_property
    def bounds(self) -> tuple[tuple[int, int], ...]:
        """For each DoF, the first DoF of its group and one past the last."""
        ranges, first = [], 0
        for group in self.groups:
            ranges += [(first, first + group.size)] * group.size
            first += group.size
        return tuple(ranges)

    def dofs_of(self, name: str) -> slice:
        """Return the DoFs of a kinematic group.

        Raises:
            KervError: No such group.
        """
        first = 0
        for group in self.groups:
            if group.name == name:
                return slice(first, first + group.size)
            first += group.size
        raise KervError(f"the actions have no group '{name}'")

    def segments(self, start: int, stop: int) -> Iterator[tuple[int, int, bool]]:
        """Yield the groups between two chunk indices: first index, one past the last, whether all are strict.

        A group that lies partly outside is cut.
        """
        while start < stop:
            step, dof = divmod(start, self.dofs)
            first, end = self.bounds[dof]
            last = min(stop, step * self.dofs + end)
            yield start, last, bool(self.is_strict[first:end].all())
            start = last

    def strict_tokens(self, size: int) -> np.ndarray:
        """Return (size,) bool: which of a chunk's first `size` tokens belong to a strict DoF."""
        return np.resize(self.is_strict, size)

    def normalise(self, actions: np.ndarray) -> np.ndarray:
        """Map (..., D) actions in environment units to [-1, 1], clipped."""
        low, high = np.asarray(self.low), np.asarray(self.high)
        return np.clip(2.0 * (actions - low) / (high - low) - 1.0, -1.0, 1.0)

    def unnormalise(self, values: np.ndarray) -> np.ndarray:
        """Map (..., D) values in [-1, 1] to environment units."""
        low, high = np.asarray(self.low), np.asarray(self.high)
        return (values + 1.0) / 2.0 * (high - low) + low

    def bins_of(self, values: np.ndarray) -> np.ndarray:
        """Return the int64 tokens of normalised values. Values at the ends belong to the outermost tokens."""
        return np.clip(np.digitize(values, self.edges) - 1, 0, self.tokens - 1).astype(np.int64)

    def values_of(self, tokens: np.ndarray) -> np.ndarray:
        """Return the normalised values of tokens: the centres of their bins."""
        return self.centres[np.asarray(tokens)]

    def encode(self, actions: np.ndarray) -> np.ndarray:
        """Return the (..., D) int64 tokens of actions in environment units."""
        return self.bins_of(self.normalise(actions))

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        """Return the (..., D) actions of tokens in environment units: the centres of their bins."""
        return self.unnormalise(self.values_of(tokens))

    def fitted(self, actions: np.ndarray) -> ActionSpace:
        """Return this space with the 1st and 99th percentile of actions (n, D) as its limits."""
        low, high = action_limits(*np.percentile(actions, [1, 99], axis=0))
        return replace(self, low=low, high=high)

    def check_same(self, other: ActionSpace, here: str, there: str, statistics: bool = False) -> None:
        """Refuse another action space: names, groups, strict DoFs, bins and control rate.

        Args:
            other: The other space.
            here: Name of this space's owner in the message.
            there: Name of the other's owner.
            statistics: Compare the normalisation too. With another one, the same token is another action.

        Raises:
            CheckpointError: They differ. The message names the first difference.
        """
        normalisation = ("low", "high", "end_token") if statistics else ()
        for name in ("names", "groups", "strict", "bins", "control_hz", *normalisation):
            mine, theirs = getattr(self, name), getattr(other, name)
            if mine != theirs:
                if name == "groups":
                    mine, theirs = ("+".join(f"{g.name} {g.size}" for g in x) for x in (mine, theirs))
                raise CheckpointError(
                    f"{here} has an action space with {name} {_text(mine)}, {there} one with {_text(theirs)}: "
                    "they were made for different actions and cannot be used together"
                )


def action_limits(low: np.ndarray, high: np.ndarray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the limits of an ActionSpace from the lowest and highest actions, (D,) each.

    A DoF that never moves gets one unit to either side of its value.
    """
    still = high - low < 1e-6
    low, high = np.where(still, low - 1.0, low), np.where(still, high + 1.0, high)
    return tuple(low.tolist()), tuple(high.tolist())


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(f"{x:.6g}" if isinstance(x, float) else str(x) for x in value) or "none"
    return str(value)


@dataclass(frozen=True)
class Place:
    """A position in the privileged state: `state[first : first + 3]`, metres."""

    name: str
    first: int


@dataclass(frozen=True)
class ObservationSpace:
    """The observations of an environment besides images.

    Args:
        proprioception: Names of its numbers. The first three are the end effector's position in metres.
        state: Number of privileged numbers.
        places: Positions in the state that a policy can estimate from images, such as object and goal.
        centre: Middle of the workspace, metres.
        extra_places: Further positions, only for a policy that is given the state.
        extra: Further indices of the state that such a policy reads as they are.
        previous: (how many numbers, first index of their copy from the step before), or None. Such a policy reads the
            differences.
    """

    proprioception: tuple[str, ...]
    state: int
    places: tuple[Place, ...]
    centre: tuple[float, float, float]
    extra_places: tuple[Place, ...] = ()
    extra: tuple[int, ...] = ()
    previous: tuple[int, int] | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Observation:
    """One observation, the input of a decode.

    Args:
        proprioception: (p,) float64, the robot's own measurements.
        state: (s,) float64, privileged.
        instruction: The task in words.
        images: Camera name -> (h, w, 3) uint8, only those that were requested.
    """

    proprioception: np.ndarray
    state: np.ndarray
    instruction: str = ""
    images: Mapping[str, np.ndarray] = field(default_factory=dict)

    def with_images(self, images: Mapping[str, np.ndarray]) -> Observation:
        """Return a copy with these images."""
        return replace(self, images=images)
