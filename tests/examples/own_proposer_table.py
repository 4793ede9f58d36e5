"""The class that `own_proposer` registers, with its network and what drafts with it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from examples.own_proposer import FollowDrafterSettings, FollowSettings
from torch import Tensor, nn

from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.methods.context import Context
from kerv_cli.methods.drafters import Metrics, TrainableDrafter
from kerv_cli.targets.samples import Rows, split
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress


class FollowTable(nn.Module):
    """Of every DoF and token the logits (V,) of the token one control step later; fresh: itself."""

    def __init__(self, dofs: int, tokens: int) -> None:
        super().__init__()
        self.dofs, self.tokens = dofs, tokens
        self.logits = nn.Parameter(0.1 * torch.eye(tokens).repeat(dofs, 1, 1))

    @classmethod
    def fit(cls, episodes: Iterable[np.ndarray], space: ActionSpace) -> FollowTable:
        """The table of how often every token followed. episodes: (T, D) tokens each."""
        table = cls(space.dofs, space.tokens)
        with torch.no_grad():
            for tokens in episodes:
                for before, after in itertools.pairwise(tokens):
                    table.logits[np.arange(space.dofs), before, after] += 1
        return table

    @property
    def follows(self) -> Tensor:
        """(D, V) int64: the most probable token behind each."""
        return self.logits.argmax(-1)

    def forward(self, before: Tensor) -> Tensor:
        """tokens (B, D) -> logits (B, D, V) of those one control step later."""
        return self.logits[torch.arange(self.dofs), before]


class FollowProposer(ChainProposer):
    """Goes on from the action before, step by step. Nothing is drafted before an action was executed."""

    name = "follow"

    def __init__(self, table: FollowTable, depth: int = 0) -> None:
        self.follows, self.depth = table.follows.cpu().numpy(), depth

    def chains(self, chunk: Chunk, depth: int) -> list[list[int]]:
        history, first = chunk.episode.history(), len(chunk.tokens)
        if not len(history):
            return []
        known = [*chunk.space.bins_of(history[-1]).tolist(), *chunk.tokens]  # the same DoF a step before lies D back
        for at in range(first, chunk.size):
            known.append(int(self.follows[at % chunk.dofs, known[at]]))
        return [known[chunk.dofs + first :][: min(depth, self.depth or depth)]]


@dataclass(frozen=True)
class Pairs(Rows):
    """n control steps of demonstrations."""

    before: Tensor  # (n, D) tokens
    after: Tensor  # (n, D) tokens, one control step later
    episodes: Tensor  # (n,)


class FollowDrafter(TrainableDrafter):
    """Trains, saves, loads and proposes."""

    kind, noun = "follow", "table"
    settings = FollowDrafterSettings
    any_chunk = True  # it drafts for any H

    def network(self, settings: FollowDrafterSettings, target: Any) -> FollowTable:
        return FollowTable(target.actions.dofs, target.actions.tokens)

    def examples(
        self, target: Any, dataset: DemoDataset, settings: FollowDrafterSettings, held_out: float, progress: OnProgress
    ) -> tuple[Pairs, Pairs]:
        space, count, pairs = target.actions, len(dataset.episodes), []
        for index in range(count):
            labels = dataset.load(index).labels
            tokens = torch.from_numpy(space.encode(labels[: math.ceil(len(labels) * settings.share)]))
            pairs.append(Pairs(tokens[:-1], tokens[1:], torch.full((len(tokens) - 1,), index)))
            progress(index + 1, count)
        return split(Pairs.joined(pairs), held_out)

    def loss(self, network: FollowTable, target: Any, batch: Pairs, step: int, settings: Any) -> tuple[Tensor, Metrics]:
        return F.cross_entropy(network(batch.before).flatten(0, 1), batch.after.flatten()), {}

    def validate(self, network: FollowTable, target: Any, held_out: Pairs, settings: Any) -> Metrics:
        right = network(held_out.before).argmax(-1) == held_out.after
        return {"score": float(right.float().mean())}

    @classmethod
    def proposer(cls, settings: FollowSettings, context: Context) -> FollowProposer:
        return FollowProposer(context.artifact(cls.kind), settings.depth)
