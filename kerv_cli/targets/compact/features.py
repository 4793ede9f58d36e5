"""Features of the scene and of the privileged state, scaled to about 1 (docs/methods.md §0.1).

A place is a position that the task is about: of the object or of the goal, for example. The privileged state is what
only the simulator knows.

Shapes: B batch, p numbers of proprioception, K places, s numbers of privileged state.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from kerv_cli.base.spaces import ObservationSpace, Place

COARSE, FINE = 0.1, 0.02  # metres: a vector is divided by COARSE, and before a tanh by FINE
STEP = 0.01  # metres (or units of the state) per control step: velocities are divided by it


def mlp(*widths: int) -> nn.Sequential:
    """Return linear layers from each width to the next, with SiLU between them."""
    parts: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        parts += [nn.Linear(inputs, outputs), nn.SiLU()]
    return nn.Sequential(*parts[:-1])


def relative(vector: Tensor) -> Tensor:
    """Return the features (…, 6) of vectors (…, 3) in metres.

    The first three are vector / 0.1 m, the others tanh(vector / 0.02 m).
    """
    return torch.cat([vector / COARSE, torch.tanh(vector / FINE)], -1)


def hand_features(proprioception: Tensor, centre: Tensor) -> Tensor:
    """Return the proprioception (B, p) with the end effector's position relative to the centre, in units of 0.1 m.

    Args:
        proprioception: (B, p), its first three numbers are the end effector's position in metres.
        centre: (3,) middle of the workspace in metres.
    """
    return torch.cat([(proprioception[:, :3] - centre) / COARSE, proprioception[:, 3:]], -1)


def scene_features(proprioception: Tensor, places: Tensor, centre: Tensor) -> Tensor:
    """Return the scene features (B, p + 15 K − 6).

    They hold all positions, the vectors from the hand to every place, and the vectors from each place to the next.

    Args:
        proprioception: (B, p).
        places: (B, K, 3) positions in metres.
        centre: (3,) middle of the workspace in metres.
    """
    vectors = torch.cat([places - proprioception[:, None, :3], places[:, 1:] - places[:, :-1]], 1)
    positions = ((places - centre) / COARSE).flatten(1)
    return torch.cat([hand_features(proprioception, centre), positions, relative(vectors).flatten(1)], -1)


def scene_width(space: ObservationSpace) -> int:
    """Return the number of columns of `scene_features`."""
    return len(space.proprioception) + 15 * len(space.places) - 6


def privileged_features(proprioception: Tensor, states: Tensor, space: ObservationSpace) -> Tensor:
    """Return the features (B, `privileged_width`) that only a policy with access to the simulator's state reads.

    They hold the state's extra numbers, its velocities, and two vectors for each extra place: from the hand to this
    place, and from this place to the last of `space.places`.

    Args:
        proprioception: (B, p).
        states: (B, s) privileged states.
        space: Says where the state has its extra numbers, velocities and extra places.
    """
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
    """Return the number of columns of `privileged_features`."""
    return len(space.extra) + (space.previous[0] if space.previous else 0) + 12 * len(space.extra_places)


def position(states: Tensor, place: Place) -> Tensor:
    """Return the position (B, 3) of one place in metres, read from states (B, s)."""
    return states[:, place.first : place.first + 3]


def places_of(states: Tensor, space: ObservationSpace) -> Tensor:
    """Return the positions (B, K, 3) of all places in metres, read from states (B, s)."""
    return torch.stack([position(states, place) for place in space.places], 1)
