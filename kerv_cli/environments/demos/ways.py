"""Ways: experts that pass left or right of the straight line to what they go to, or above it, so that demonstrations
solve the same task in distinct ways (docs/stress.md)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kerv_cli.environments.spec import EnvironmentSpec, Expert
from kerv_cli.environments.vectors import length
from kerv_cli.errors import UnknownName, UsageError
from kerv_cli.spaces import Observation

Array = NDArray[np.float64]
WAYS = ("left", "right", "above")
NEAR = 0.02
"""Metres from the way point within which it counts as passed."""
ASIDE = 0.04, 0.1
"""Metres: least distance of the way point ahead of the hand and from the straight line, largest one from the line."""
_PATIENCE = 4
"""After this part of the environment's horizon the scripted expert takes over wherever the hand is."""


def check_ways(ways: Sequence[str], spec: EnvironmentSpec) -> None:
    """Refuses ways that do not exist or that an environment's experts cannot take.

    Raises:
        UnknownName: no such way. UsageError: one is named twice, the actions have no group `position`, or the
            observations name no place.
    """
    for way in ways:
        if way not in WAYS:
            raise UnknownName("way", way, WAYS)
    if len(set(ways)) < len(ways):
        raise UsageError(f"ways=[{','.join(ways)}]: name each once")
    if ways and not any(group.name == "position" for group in spec.actions.groups):
        raise UsageError(f"ways: not possible in {spec.name}: its actions have no group 'position'")
    if ways and not spec.observation.places:
        raise UsageError(f"ways: not possible in {spec.name}: its observations name no place to go to")


def way_of(task: str, seed: int, ways: Sequence[str]) -> str:
    """The way of an episode, drawn from task and seed alone; each has the same chance."""
    random = np.random.default_rng([seed, *f"way {task}".encode()])
    return ways[int(random.integers(len(ways)))]


class Detour:
    """The scripted expert of one episode, with a way point before it.

    Until the hand has passed the way point, the position group goes straight there at the highest speed; all else is
    the scripted expert's, and so is everything behind it. The way point lies halfway between the hand's first position
    and the place at which the scripted expert's first action points best, seen from above, and half of that distance to
    the left or right (horizontally, seen in that direction) or above; ASIDE bounds both distances.
    """

    def __init__(self, expert: Expert, spec: EnvironmentSpec, way: str) -> None:
        self.expert, self.spec, self.way = expert, spec, way
        self._dofs = spec.actions.dofs_of("position")
        low, high = (np.array(limit)[self._dofs] for limit in (spec.actions.low, spec.actions.high))
        self._half, self._middle = (high - low) / 2, (high + low) / 2
        self.point: Array | None = None  # (3,) metres, from the first observation on
        self._begin = self._along = np.zeros(3)
        self._ahead = 0.0
        self._left = spec.horizon // _PATIENCE  # control steps in which the way point has to be passed

    def __call__(self, observation: Observation) -> Array:
        """The action (D,), as `Expert`. To be called for every control step of the episode, in order."""
        action = self.expert(observation)
        hand = np.array(observation.proprioception[:3], dtype=np.float64)
        if self.point is None:
            self.point = self._plan(hand, action, observation)
        if self._left and not self._passed(hand, self.point):
            self._left -= 1
            action = action.copy()
            action[self._dofs] = self._middle + self._straight(self.point - hand)
        else:
            self._left = 0
        return action

    def _plan(self, hand: Array, action: Array, observation: Observation) -> Array:
        """The way point (3,), metres."""
        first = ((action[self._dofs] - self._middle) / self._half)[:2]
        places = [observation.state[place.first : place.first + 2] for place in self.spec.observation.places]
        offsets = [place - hand[:2] for place in places]
        aim = max(offsets, key=lambda offset: float(first @ offset) / max(length(offset), 1e-9))
        distance = length(aim)
        along = np.array([*aim / distance, 0.0]) if distance > NEAR else np.array([0.0, 1.0, 0.0])
        left = np.array([-along[1], along[0], 0.0])
        aside = {"left": left, "right": -left, "above": np.array([0.0, 0.0, 1.0])}[self.way]
        ahead = max(distance / 2, ASIDE[0])
        self._begin, self._along, self._ahead = hand, along, ahead
        point: Array = hand + ahead * along + min(ahead, ASIDE[1]) * aside
        return point

    def _passed(self, hand: Array, point: Array) -> bool:
        """Whether the hand is at the way point, or as far along as it."""
        on = float((hand - self._begin) @ self._along)
        return length(point - hand) < NEAR or on > self._ahead

    def _straight(self, offset: Array) -> Array:
        """The largest action in the direction of an offset (3,), metres."""
        return np.asarray(offset / max(float(np.abs(offset / self._half).max()), 1e-9))
