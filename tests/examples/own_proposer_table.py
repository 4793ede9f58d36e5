"""The weights of `own_proposer`, as safetensors and JSON, and the proposer that drafts with them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from examples.own_proposer import FollowSettings
from torch import Tensor, nn

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.methods.artifacts import Weights, WeightsDescription
from kerv_cli.methods.context import Context


class FollowTable(nn.Module):
    """follows (D, V) int64: of every DoF, the token one control step after each token."""

    follows: Tensor

    def __init__(self, dofs: int, tokens: int) -> None:
        super().__init__()
        self.register_buffer("follows", torch.arange(tokens).repeat(dofs, 1))

    @classmethod
    def fit(cls, episodes: Iterable[np.ndarray], space: ActionSpace) -> FollowTable:
        """episodes: (T, D) tokens each. A token that was never seen is followed by itself."""
        table, counts = (
            cls(space.dofs, space.tokens),
            np.zeros((space.dofs, space.tokens, space.tokens), dtype=np.int64),
        )
        for tokens in episodes:
            for before, after in itertools.pairwise(tokens):
                counts[np.arange(space.dofs), before, after] += 1
        seen = torch.from_numpy(counts.sum(2) > 0)
        table.follows[seen] = torch.from_numpy(counts.argmax(2))[seen]
        return table


class FollowArtifact(Weights[WeightsDescription]):
    """The table's files: its weights and what every JSON of weights has."""

    kind, noun = "follow", "table"
    again = "run 'kerv train drafter drafter=follow'"
    schema = WeightsDescription
    any_chunk = True

    def module(self, description: WeightsDescription, target: Any) -> FollowTable:
        return FollowTable(description.actions.dofs, description.actions.tokens)


class FollowProposer(ChainProposer):
    """Goes on from the action before, step by step. Nothing is drafted before an action was executed."""

    name = "follow"

    def __init__(self, table: FollowTable, depth: int = 0) -> None:
        self.follows, self.depth = table.follows.numpy(), depth

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        history, first = chunk.situation.history.values(), len(chunk.tokens)
        if not len(history):
            return []
        known = [*chunk.space.bins_of(history[-1]).tolist(), *chunk.tokens]  # the same DoF a step before lies D back
        for at in range(first, chunk.size):
            known.append(int(self.follows[at % chunk.dofs, known[at]]))
        return [known[chunk.dofs + first :][: min(depth, self.depth or depth)]]


def build(settings: FollowSettings, context: Context) -> Any:
    """proposer=follow."""
    return FollowProposer(context.artifact("follow"), settings.depth)
