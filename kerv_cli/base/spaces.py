"""Action and observation spaces as data: constants of a robot or simulator stand in environments alone.

An environment has an `ActionSpace` and an `ObservationSpace`, and every artifact made from it stores them: target,
drafter, datastore, calibration. Artifacts of different action spaces are refused together (`check_same`).

Notation (docs/methods.md §0): D degrees of freedom (DoFs) per control step, H control steps per chunk, N = H · D
tokens; token j is control step j // D, DoF j % D.
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
    """A kinematic group: neighbouring DoFs that are drafted and accepted together, e.g. position or rotation."""

    name: str
    size: int  # DoFs


@dataclass(frozen=True)
class ActionSpace:
    """The actions of one control step, and their tokens.

    names: of the D DoFs, in the tokens' order. groups: kinematic groups, in order; their sizes add up to D. strict: the
    DoFs whose draft tokens must equal the target's and which are held, never extrapolated (a gripper opens or closes).
    control_hz: control steps per second. low, high: (D,) in environment units, what -1 and 1 of the normalised range
    mean; an environment gives its limits, a policy the 1st and 99th percentile of its demonstrations. bins: edges on
    [-1, 1]; a token is the index of one of the bins - 1 intervals (OpenVLA: 256 edges, 255 centres). end_token: there
    is one token more, for the upper end itself, which decodes like the last interval (published OpenVLA checkpoints
    were trained with it: a value of exactly 1 has an id of its own).

    Raises:
        ValueError: numbers that do not fit together.
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
        """Plain values for JSON; `end_token` only where it is set, so that other spaces are written as ever."""
        plain = asdict(self)
        if not self.end_token:
            del plain["end_token"]
        return plain

    @property
    def dofs(self) -> int:
        """D."""
        return len(self.names)

    @property
    def tokens(self) -> int:
        """Size of the vocabulary: one token per bin, and the end token where there is one."""
        return self.bins - 1 + self.end_token

    @cached_property
    def edges(self) -> np.ndarray:
        """(bins,) on [-1, 1]."""
        return np.linspace(-1.0, 1.0, self.bins)

    @cached_property
    def centres(self) -> np.ndarray:
        """(tokens,) normalised value of every token."""
        inner = (self.edges[:-1] + self.edges[1:]) / 2
        return np.append(inner, inner[-1]) if self.end_token else inner

    @cached_property
    def middle(self) -> np.ndarray:
        """(D,) environment units, the middle of every DoF's limits."""
        return (np.asarray(self.high) + np.asarray(self.low)) / 2

    @cached_property
    def half(self) -> np.ndarray:
        """(D,) environment units, half of every DoF's range."""
        return (np.asarray(self.high) - np.asarray(self.low)) / 2

    @cached_property
    def is_strict(self) -> np.ndarray:
        """(D,) bool."""
        return np.array([name in self.strict for name in self.names])

    @cached_property
    def bounds(self) -> tuple[tuple[int, int], ...]:
        """Per DoF: the first DoF of its group, and one past the last."""
        ranges, first = [], 0
        for group in self.groups:
            ranges += [(first, first + group.size)] * group.size
            first += group.size
        return tuple(ranges)

    def dofs_of(self, name: str) -> slice:
        """The DoFs of a kinematic group.

        Raises:
            KervError: no such group.
        """
        first = 0
        for group in self.groups:
            if group.name == name:
                return slice(first, first + group.size)
            first += group.size
        raise KervError(f"the actions have no group '{name}'")

    def segments(self, start: int, stop: int) -> Iterator[tuple[int, int, bool]]:
        """Chunk indices [first, last) of every group between `start` and `stop`, and whether all its DoFs are strict.
        A group that lies partly outside is cut."""
        while start < stop:
            step, dof = divmod(start, self.dofs)
            first, end = self.bounds[dof]
            last = min(stop, step * self.dofs + end)
            yield start, last, bool(self.is_strict[first:end].all())
            start = last

    def strict_tokens(self, size: int) -> np.ndarray:
        """(size,) bool: which of a chunk's first `size` tokens belong to a strict DoF."""
        return np.resize(self.is_strict, size)

    def normalise(self, actions: np.ndarray) -> np.ndarray:
        """(..., D) environment units -> [-1, 1], clipped."""
        low, high = np.asarray(self.low), np.asarray(self.high)
        return np.clip(2.0 * (actions - low) / (high - low) - 1.0, -1.0, 1.0)

    def unnormalise(self, values: np.ndarray) -> np.ndarray:
        """(..., D) in [-1, 1] -> environment units."""
        low, high = np.asarray(self.low), np.asarray(self.high)
        return (values + 1.0) / 2.0 * (high - low) + low

    def bins_of(self, values: np.ndarray) -> np.ndarray:
        """Normalised values -> int64 tokens of the same shape. Both ends belong to the outermost bins; with an end
        token the upper end is that."""
        return np.clip(np.digitize(values, self.edges) - 1, 0, self.tokens - 1).astype(np.int64)

    def values_of(self, tokens: np.ndarray) -> np.ndarray:
        """Tokens -> normalised values of the same shape, the bins' centres."""
        return self.centres[np.asarray(tokens)]

    def encode(self, actions: np.ndarray) -> np.ndarray:
        """(..., D) environment units -> (..., D) int64 tokens."""
        return self.bins_of(self.normalise(actions))

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        """(..., D) tokens -> (..., D) environment units; the centre of each bin."""
        return self.unnormalise(self.values_of(tokens))

    def fitted(self, actions: np.ndarray) -> ActionSpace:
        """This space, normalised by the 1st and 99th percentile of actions (n, D) in environment units."""
        low, high = action_limits(*np.percentile(actions, [1, 99], axis=0))
        return replace(self, low=low, high=high)

    def check_same(self, other: ActionSpace, here: str, there: str, statistics: bool = False) -> None:
        """Refuses another action space: names, groups, strict DoFs, bins and control rate; with `statistics` the
        normalisation too, without which the same token is another action. here, there: names of the two owners for
        the message.

        Raises:
            CheckpointError: they differ; the message names the first difference.
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
    """The limits of an ActionSpace from `low` and `high` (D,) of its actions: a DoF that never moves gets a unit to
    either side of its value."""
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

    proprioception: names of its numbers; the first three are the end effector's position in metres. state: how many
    privileged numbers there are. places: positions in the state that a policy may estimate from images, e.g. object and
    goal; all others are only for a policy that is given the state. extra: further indices of the state that such a
    policy reads as they are. previous: (how many numbers, first index of the step before's copy of them), or None; such
    a policy reads their differences. centre: metres, the middle of the workspace.
    """

    proprioception: tuple[str, ...]
    state: int
    places: tuple[Place, ...]
    centre: tuple[float, float, float]
    extra_places: tuple[Place, ...] = ()
    extra: tuple[int, ...] = ()
    previous: tuple[int, int] | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Observation:
    """One observation, the input of a decode.

    proprioception: (p,) float64, the robot's own measurements. state: (s,) float64, privileged. instruction: the task
    in words. images: camera name -> (h, w, 3) uint8, only those that were requested.
    """

    proprioception: np.ndarray
    state: np.ndarray
    instruction: str = ""
    images: Mapping[str, np.ndarray] = field(default_factory=dict)

    def with_images(self, images: Mapping[str, np.ndarray]) -> Observation:
        """A copy of the observation with these images."""
        return replace(self, images=images)
