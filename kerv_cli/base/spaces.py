"""Action and observation spaces, which describe a robot as data. Only environments contain robot-specific numbers.

An environment has an `ActionSpace` and an `ObservationSpace`. Every artifact that is made from it stores them: target,
drafter, datastore, calibration. Artifacts with different action spaces cannot be used together (`check_same`).

Notation (docs/methods.md §0): D degrees of freedom (DoFs) per control step, H control steps per chunk, N = H · D
tokens; token j belongs to control step j // D and DoF j % D. With FAST tokens, which encode whole chunks, N is the
largest number of tokens, and a token belongs to no single step or DoF.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from kerv_cli.base.codes import FastCode
from kerv_cli.base.errors import CheckpointError, KervError


@dataclass(frozen=True)
class Group:
    """A kinematic group: neighbouring DoFs that are drafted and accepted together, such as position or rotation.

    Args:
        name: Name of the group.
        size: Number of DoFs in it.
    """

    name: str
    size: int


@dataclass(frozen=True)
class ActionSpace:
    """The actions of one control step, and their tokens.

    Args:
        names: Names of the D DoFs, in the order of the tokens.
        groups: Kinematic groups in order. Their sizes add up to D.
        strict: Names of the strict DoFs, such as a gripper. Their drafted tokens must equal the target's, and a
            prediction repeats their last value instead of extrapolating it.
        control_hz: Control steps per second.
        low: (D,) action in environment units that the normalised value -1 stands for: the environment's limit, or for a
            policy the 1st percentile of its demonstrations.
        high: (D,) action that the normalised value 1 stands for: the environment's limit, or the 99th percentile.
        bins: Number of edges on [-1, 1]. A token is the index of one of the bins - 1 intervals (OpenVLA: 256 edges).
        end_token: Whether there is one more token for the value 1. It decodes to the centre of the last interval.
            Published OpenVLA checkpoints were trained with it.
        code: The code of FAST tokens, which encode whole chunks. None if each number of an action is a token of its
            own, the index of its bin.

    Raises:
        ValueError: The fields contradict each other.
    """

    names: tuple[str, ...]
    groups: tuple[Group, ...]
    strict: tuple[str, ...]
    control_hz: float
    low: tuple[float, ...]
    high: tuple[float, ...]
    bins: int = 256
    end_token: bool = False
    code: FastCode | None = None

    def __post_init__(self) -> None:
        if not self.names or len(set(self.names)) != len(self.names):
            raise ValueError(f"DoFs need names of their own: {self.names}")
        sizes = [group.size for group in self.groups]
        if sum(sizes) != self.dofs or min(sizes) < 1:
            raise ValueError(f"groups {self.groups} do not cover the {self.dofs} DoFs in order")
        if not set(self.strict) <= set(self.names):
            raise ValueError(f"strict {self.strict} names a DoF that is not there: {self.names}")
        if len(self.low) != self.dofs or len(self.high) != self.dofs:
            raise ValueError(f"low and high need {self.dofs} numbers each")
        if not np.isfinite([self.low, self.high]).all() or (np.asarray(self.low) >= self.high).any():
            raise ValueError(f"low {self.low} must lie below high {self.high}")
        if self.bins < 3 or not 0 < self.control_hz < np.inf:
            raise ValueError(f"bins {self.bins} must be at least 3, control_hz {self.control_hz} above 0")

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as values for JSON. `end_token` and `code` are left out if they are false or None."""
        plain = asdict(self)
        for name in ("end_token", "code"):
            if not plain[name]:
                del plain[name]
        return plain

    @property
    def dofs(self) -> int:
        return len(self.names)

    @property
    def tokens(self) -> int:
        return self.code.tokens if self.code else self.bins - 1 + self.end_token

    @property
    def kinds(self) -> int:
        """Number of kinds of tokens: D, one kind per DoF. All FAST tokens are of the same kind."""
        return 1 if self.code else self.dofs

    @property
    def end(self) -> int | None:
        """The FAST token that ends a chunk. None for other tokens, because then every chunk has N tokens."""
        return self.code.end if self.code else None

    @cached_property
    def edges(self) -> np.ndarray:
        """(bins,) normalised values at which the tokens' intervals begin and end, from -1 to 1."""
        return np.linspace(-1.0, 1.0, self.bins)

    @cached_property
    def centres(self) -> np.ndarray:
        """(tokens,) normalised value that each token decodes to, the centre of its interval."""
        inner = (self.edges[:-1] + self.edges[1:]) / 2
        return np.append(inner, inner[-1]) if self.end_token else inner

    @cached_property
    def middle(self) -> np.ndarray:
        """(D,) middle between `low` and `high`, environment units."""
        return (np.asarray(self.high) + np.asarray(self.low)) / 2

    @cached_property
    def half(self) -> np.ndarray:
        """(D,) half the distance between `low` and `high`, environment units."""
        return (np.asarray(self.high) - np.asarray(self.low)) / 2

    @cached_property
    def is_strict(self) -> np.ndarray:
        """(D,) bool: which DoFs are strict, so that their tokens must equal the target's."""
        return np.isin(self.names, self.strict)

    @cached_property
    def bounds(self) -> tuple[tuple[int, int], ...]:
        """For each DoF, the range of its kinematic group: (index of the group's first DoF, index after its last)."""
        ranges, first = [], 0
        for group in self.groups:
            ranges += [(first, first + group.size)] * group.size
            first += group.size
        return tuple(ranges)

    def dofs_of(self, name: str) -> slice:
        first = 0
        for group in self.groups:
            if group.name == name:
                return slice(first, first + group.size)
            first += group.size
        raise KervError(f"the actions have no group '{name}'")

    def segments(self, start: int, stop: int) -> Iterator[tuple[int, int, bool]]:
        """Divide a chunk's tokens from `start` to before `stop` into kinematic groups, which may be cut at the ends.

        Yields:
            For each group: index of its first token, index after its last token, whether all its DoFs are strict.
            Every FAST token is a group of its own that is not strict.
        """
        if self.code is not None:  # no token belongs to one DoF
            for token in range(start, stop):
                yield token, token + 1, False
            return
        while start < stop:
            step, dof = divmod(start, self.dofs)
            first, end = self.bounds[dof]
            last = min(stop, step * self.dofs + end)
            yield start, last, bool(self.is_strict[first:end].all())
            start = last

    def strict_tokens(self, size: int) -> np.ndarray:
        """Return which of a chunk's first `size` tokens belong to strict DoFs, (size,) bool.

        All FAST tokens count as strict.
        """
        return np.resize(self.is_strict, size) if self.code is None else np.ones(size, dtype=bool)

    def normalise(self, actions: np.ndarray) -> np.ndarray:
        """Map actions (..., D) from environment units to [-1, 1]. Values outside are clipped."""
        low, span = self._low_and_span
        return np.clip(2.0 * (actions - low) / span - 1.0, -1.0, 1.0)

    def unnormalise(self, values: np.ndarray) -> np.ndarray:
        low, span = self._low_and_span
        return (values + 1.0) / 2.0 * span + low

    @cached_property
    def _low_and_span(self) -> tuple[np.ndarray, np.ndarray]:
        low = np.asarray(self.low)
        return low, np.asarray(self.high) - low

    def bins_of(self, values: np.ndarray) -> np.ndarray:
        """Return the int64 tokens of normalised values. Values outside [-1, 1] get the first or last token."""
        return np.clip(np.digitize(values, self.edges) - 1, 0, self.tokens - 1).astype(np.int64)

    def values_of(self, tokens: np.ndarray) -> np.ndarray:
        return self.centres[np.asarray(tokens)]

    def encode(self, actions: np.ndarray) -> np.ndarray:
        """Return the tokens (..., D) int64 of actions (..., D) in environment units."""
        return self.bins_of(self.normalise(actions))

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        """Return the actions (..., D) of tokens (..., D): the centres of the tokens' bins, in environment units."""
        return self.unnormalise(self.values_of(tokens))

    def longest(self, steps: int) -> int:
        return self.code.longest if self.code else steps * self.dofs

    def chunk_tokens(self, chunks: np.ndarray) -> np.ndarray:
        """Return the tokens (n, N) int64 of chunks (n, H, D) in environment units.

        With FAST tokens, a chunk may have fewer than N tokens. Its row is then filled up with end tokens.
        """
        return self.normalised_tokens(self.normalise(chunks))

    def normalised_tokens(self, chunks: np.ndarray) -> np.ndarray:
        """Return the tokens (n, N) int64, like `chunk_tokens`, of chunks (n, H, D) of normalised actions."""
        if self.code is None:
            return self.bins_of(chunks).reshape(len(chunks), -1)
        return self.code.encode(self.code.coefficients(chunks))

    def chunk_values(self, tokens: Sequence[int], steps: int) -> np.ndarray:
        """Return the normalised actions (h, D) of a chunk's tokens.

        h is len(tokens) / D. For FAST tokens, h is `steps`, also if tokens are missing.
        """
        if self.code is None:
            return self.values_of(np.asarray(tokens)).reshape(-1, self.dofs)
        return self.code.values(self.code.decode(tokens))[:steps]

    def fitted(self, actions: np.ndarray) -> ActionSpace:
        low, high = action_limits(*np.percentile(actions, [1, 99], axis=0))
        return replace(self, low=low, high=high)

    def check_same(self, other: ActionSpace, here: str, there: str, statistics: bool = False) -> None:
        """Refuse an action space that differs in names, groups, strict DoFs, bins or control rate.

        With `statistics`, `low`, `high`, `end_token` and `code` must be equal, too, or a token would mean another
        action. `here` and `there` say in the error message what the two spaces belong to.
        """
        normalisation = ("low", "high", "end_token", "code") if statistics else ()
        for name in ("names", "groups", "strict", "bins", "control_hz", *normalisation):
            mine, theirs = getattr(self, name), getattr(other, name)
            if mine != theirs:
                raise CheckpointError(
                    f"{here} has an action space with {name} {_text(mine)}, {there} one with {_text(theirs)}: "
                    "they were made for different actions and cannot be used together"
                )


def action_limits(low: np.ndarray, high: np.ndarray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return `low` and `high` of an ActionSpace from the lowest and highest actions, (D,) each.

    For a DoF with a constant value, the limits are value - 1 and value + 1.
    """
    still = high - low < 1e-6
    low, high = np.where(still, low - 1.0, low), np.where(still, high + 1.0, high)
    return tuple(low.tolist()), tuple(high.tolist())


def _text(value: Any) -> str:
    if isinstance(value, FastCode):
        return f"FAST with {len(value.merges)} merges"
    if isinstance(value, tuple):
        return ("+" if value and isinstance(value[0], Group) else ", ").join(map(_text, value)) or "none"
    if isinstance(value, Group):
        return f"{value.name} {value.size}"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Place:
    """A 3D position that matters to the task, such as the object's. It is `state[first : first + 3]` of the simulator.

    Args:
        name: Name of the place.
        first: Index of the place's x coordinate in the state. x, y and z are in metres.
    """

    name: str
    first: int


@dataclass(frozen=True)
class ObservationSpace:
    """The numbers that an environment observes besides images: proprioception and privileged state.

    Only the simulator knows the privileged state. A policy that reads images does not see it.

    Args:
        proprioception: Names of the numbers of proprioception, the robot's own measurements. The first three are the
            end effector's position in metres.
        state: Number of values in the privileged state. The first ones are the proprioception.
        places: Points in space, such as object and goal, that the state holds and a policy can estimate from images.
        centre: Middle of the workspace in metres.
        extra_places: Further points in space, read only by a policy that gets the state.
        extra: Indices of further numbers in the state, read only by a policy that gets the state.
        previous: (count, index) if `state[index : index + count]` repeats the first `count` numbers of the state one
            control step earlier. A policy that gets the state reads the differences as velocities. None if the state
            holds no earlier numbers.
    """

    proprioception: tuple[str, ...]
    state: int
    places: tuple[Place, ...]
    centre: tuple[float, float, float]
    extra_places: tuple[Place, ...] = ()
    extra: tuple[int, ...] = ()
    previous: tuple[int, int] | None = None

    def without_state(self, places: tuple[Place, ...] = ()) -> ObservationSpace:
        """Return this space as the robot alone sees it: the state is the proprioception, without object positions.

        Args:
            places: Positions that the policy estimates. The new space names them, although its state does not contain
                them.
        """
        return ObservationSpace(self.proprioception, len(self.proprioception), places, self.centre)


@dataclass(frozen=True)
class Observation:
    """What a policy observes before it decodes a chunk of actions.

    Args:
        proprioception: (p,) float64, the robot's own measurements.
        state: (s,) float64, the simulator's privileged state.
        instruction: The task in words.
        images: Images (h, w, 3) uint8, by camera. Only cameras that the policy reads are included.
        readings: The robot's own measurements by name, such as `position` (3,), for policies behind a server. Empty if
            the environment names none.
    """

    proprioception: np.ndarray
    state: np.ndarray
    instruction: str = ""
    images: Mapping[str, np.ndarray] = field(default_factory=dict)
    readings: Mapping[str, np.ndarray] = field(default_factory=dict)

    def with_images(self, images: Mapping[str, np.ndarray]) -> Observation:
        return replace(self, images=images)
