"""Features of the scene and of the privileged state, scaled to about 1 (docs/methods.md §0.1), and ids of words.

A place is a position that the task is about: of the object or of the goal, for example. The privileged state is what
only the simulator knows.

Shapes: B batch, p numbers of proprioception, K places, s numbers of privileged state.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor, nn

from kerv_cli.base.errors import UsageError
from kerv_cli.base.spaces import ObservationSpace, Place

COARSE, FINE = 0.1, 0.02  # metres: a vector is divided by COARSE, and before a tanh by FINE
PAD, UNKNOWN = 0, 1  # ids of words
STEP = 0.01  # metres (or units of the state) per control step: velocities are divided by it


def mlp(*widths: int) -> nn.Sequential:
    """Return linear layers from each width to the next, with SiLU between them."""
    parts: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        parts += [nn.Linear(inputs, outputs), nn.SiLU()]
    return nn.Sequential(*parts[:-1])


def relative(vector: Tensor) -> Tensor:
    """Return the features (…, 6) of vectors (…, 3) in metres.

    The first three features are vector / 0.1 m, the last three tanh(vector / 0.02 m).
    """
    return torch.cat([vector / COARSE, torch.tanh(vector / FINE)], -1)


def hand_features(proprioception: Tensor, centre: Tensor) -> Tensor:
    """Return the proprioception (B, p), in which (position − centre) / 0.1 m replaces the end effector's position.

    Args:
        proprioception: (B, p), its first three numbers are the end effector's position in metres.
        centre: (3,) middle of the workspace in metres.
    """
    return torch.cat([(proprioception[:, :3] - centre) / COARSE, proprioception[:, 3:]], -1)


def scene_features(proprioception: Tensor, places: Tensor, centre: Tensor) -> Tensor:
    """Return the scene features (B, p + 15 K − 6).

    They hold `hand_features` (p numbers), the K places relative to the centre (3 K), and 2 K − 1 vectors: from the hand
    to each place, and from each place to the next. `relative` turns each vector into 6 numbers.

    Args:
        proprioception: (B, p).
        places: (B, K, 3) positions of the task's places (object, goal, …) in metres.
        centre: (3,) middle of the workspace in metres.
    """
    vectors = torch.cat([places - proprioception[:, None, :3], places[:, 1:] - places[:, :-1]], 1)
    positions = ((places - centre) / COARSE).flatten(1)
    return torch.cat([hand_features(proprioception, centre), positions, relative(vectors).flatten(1)], -1)


def scene_width(space: ObservationSpace) -> int:
    """Return the number of columns of `scene_features`."""
    return len(space.proprioception) + 15 * len(space.places) - 6


def privileged_features(proprioception: Tensor, states: Tensor, space: ObservationSpace) -> Tensor:
    """Return features (B, `privileged_width`) for a policy that reads the simulator's state.

    They hold the state's extra numbers, its velocities, and two vectors for each extra place: from the hand to the
    extra place, and from there to the last of `space.places`. `relative` turns each vector into 6 numbers.

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
    """Return the 3D position (B, 3) of a place, such as the object, in metres. It is read from states (B, s)."""
    return states[:, place.first : place.first + 3]


def places_of(states: Tensor, space: ObservationSpace) -> Tensor:
    """Return the 3D positions (B, K, 3) of `space.places`, such as object and goal, in metres, from states (B, s)."""
    return torch.stack([position(states, place) for place in space.places], 1)


@dataclass(frozen=True)
class WordTokenizer:
    """A fixed vocabulary of whole words, which turns an instruction into one id per word, padded to a fixed length.

    The vocabulary is stored in the checkpoint. It is built from all instructions of the environment, so a policy
    trained on ten tasks can be fine-tuned on fifty without a new embedding.

    Attributes:
        words: The known words. `words[i]` has id i + 2. Id 0 is padding, id 1 stands for any unknown word.
    """

    words: tuple[str, ...]

    @classmethod
    def build(cls, sentences: Iterable[str]) -> WordTokenizer:
        """Return a tokenizer for all lower-case words of the sentences, in alphabetical order."""
        return cls(tuple(sorted({word for s in sentences for word in s.lower().split()})))

    @property
    def size(self) -> int:
        """Number of ids: one per word, one for padding, and one for unknown words."""
        return len(self.words) + 2

    @cached_property
    def index(self) -> dict[str, int]:
        """Map from a word to its id."""
        return {word: i + 2 for i, word in enumerate(self.words)}

    def encode(self, sentence: str, length: int) -> list[int]:
        """Return exactly `length` ids for a sentence, with padding at the end.

        Raises:
            UsageError: The sentence has more than `length` words. It is not cut, because a decisive word could be lost.
        """
        ids = [self.index.get(word, UNKNOWN) for word in sentence.lower().split()]
        if len(ids) > length:
            raise UsageError(f"instruction '{sentence}' has {len(ids)} words, the policy takes {length}: shorten it")
        return ids + [PAD] * (length - len(ids))
