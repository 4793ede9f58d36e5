"""The weights of `own_proposer`, as safetensors and JSON, and the proposer that drafts with them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from examples.own_proposer import FollowSettings
from torch import Tensor, nn

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.chunk import Chunk
from kerv_cli.engine.proposer import ChainProposer
from kerv_cli.methods.artifacts import Artifact, Request, artifact_folder
from kerv_cli.methods.context import Context
from kerv_cli.targets.checkpoint import Description, TargetDescription, load_state, read_description, save_module


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


@dataclass(frozen=True)
class FollowDescription(Description):
    """The JSON beside the weights. target: SHA-256 of the target's weights."""

    target: str
    actions: ActionSpace


def save(folder: Path, table: FollowTable, target: TargetDescription) -> str:
    """Writes weights and description -> SHA-256 of the weights."""
    return save_module(folder, "follow", table, {"target": target.sha256, "actions": target.actions.as_dict()})


def described(folder: Path, request: Request) -> FollowDescription:
    """Raises CheckpointError: missing, damaged, or another target's."""
    own, target = read_description(folder, "follow", FollowDescription), request.description
    own.actions.check_same(target.actions, f"the table in {folder}", "the target", statistics=True)
    if own.target != target.sha256:
        raise CheckpointError(f"the table in {folder} is of target {own.target[:12]}, not of {target.sha256[:12]}")
    return own


def load(folder: Path, request: Request) -> FollowTable:
    """The weights; errors as `described`."""
    actions = described(folder, request).actions
    table = FollowTable(actions.dofs, actions.tokens)
    load_state(table, folder, "follow")
    return table


ARTIFACT = Artifact(
    "follow", artifact_folder("follow"), lambda folder, request: described(folder, request).sha256, load
)


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
