"""Features of the scene and of the privileged state, as numbers of order one, and the layers that read them.

Shapes: B batch, p numbers of proprioception, K places, s numbers of privileged state.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch
from torch import Tensor, nn

from kerv_cli.base.spaces import ObservationSpace, Place

COARSE, FINE = 0.1, 0.02  # metres per unit of the linear and of the saturating features of a vector
STEP = 0.01  # metres (or units of the state) per control step that count as a velocity of one

Saturate = Callable[[Tensor], Tensor]


def mlp(*widths: int) -> nn.Sequential:
    """Linear layers from each width to the next, with SiLU between them."""
    parts: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        parts += [nn.Linear(inputs, outputs), nn.SiLU()]
    return nn.Sequential(*parts[:-1])


def relative(vector: Tensor, saturate: Saturate = torch.tanh) -> Tensor:
    """vector (…, 3) metres -> (…, 6): it in coarse units, and in fine units that saturate."""
    return torch.cat([vector / COARSE, saturate(vector / FINE)], -1)


def hand_features(proprioception: Tensor, centre: Tensor) -> Tensor:
    """proprioception (B, p) -> (B, p): the end effector relative to the workspace's centre, the rest unchanged."""
    return torch.cat([(proprioception[:, :3] - centre) / COARSE, proprioception[:, 3:]], -1)


def scene_features(proprioception: Tensor, places: Tensor, centre: Tensor, saturate: Saturate = torch.tanh) -> Tensor:
    """proprioception (B, p), places (B, K, 3) metres -> (B, p + 15 K − 6): positions, vectors from the hand to every
    place and from each place to the next. Affine except for `saturate`."""
    vectors = torch.cat([places - proprioception[:, None, :3], places[:, 1:] - places[:, :-1]], 1)
    positions = ((places - centre) / COARSE).flatten(1)
    return torch.cat([hand_features(proprioception, centre), positions, relative(vectors, saturate).flatten(1)], -1)


def scene_width(space: ObservationSpace) -> int:
    """Number of columns of `scene_features`."""
    return len(space.proprioception) + 15 * len(space.places) - 6


def saturating_columns(space: ObservationSpace) -> list[int]:
    """Indices of the columns of `scene_features` that saturate."""
    first = len(space.proprioception) + 3 * len(space.places)
    return [first + 6 * vector + 3 + axis for vector in range(2 * len(space.places) - 1) for axis in range(3)]


def privileged_features(proprioception: Tensor, states: Tensor, space: ObservationSpace) -> Tensor:
    """proprioception (B, p), states (B, s) -> (B, `privileged_width`): further numbers of the state, velocities, and
    the extra places relative to hand and last place."""
    hand, last = proprioception[:, :3], position(states, space.places[-1])
    parts = [states[:, list(space.extra)]]
    if space.previous is not None:
        count, first = space.previous
        velocity = (states[:, :count] - states[:, first : first + count]) / STEP
        parts.append(velocity.clamp(-3, 3))
    for place in space.extra_places:
        extra = position(states, place)
        parts += [relative(extra - hand), relative(last - extra)]
    return torch.cat(parts, -1)


def privileged_width(space: ObservationSpace) -> int:
    """Number of columns of `privileged_features`."""
    return len(space.extra) + (space.previous[0] if space.previous else 0) + 12 * len(space.extra_places)


def position(states: Tensor, place: Place) -> Tensor:
    """Position of one place, from states (B, s) -> (B, 3) metres."""
    return states[:, place.first : place.first + 3]


def places_of(states: Tensor, space: ObservationSpace) -> Tensor:
    """Positions of the space's places, from states (B, s) -> (B, K, 3) metres."""
    return torch.stack([position(states, place) for place in space.places], 1)
