"""What an EAGLE-style drafter learns from: the frozen target's greedy decodes of demonstrations (docs/methods.md §2.2).

The target decodes the *observations* of the demonstrations, not the expert's answers. The drafter imitates its hidden
states and tokens, with the mask and the positions that decoding uses.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.batched import greedy
from kerv_cli.engine.protocol import Target
from kerv_cli.targets.observations import Rows, held_out_every, observations_of, prompts_of, steps_of
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress

VALIDATED = 60
"""Held-out observations that a validation decodes."""


@dataclass(frozen=True)
class TeacherStates(Rows):
    """The target's greedy decodes of n observations whose prompts are equally long."""

    prompt: Tensor  # (n, P, E) float16
    hidden: Tensor  # (n, P + N − 1, E) float16
    tokens: Tensor  # (n, N) int64


@dataclass(frozen=True)
class StatesByLength:
    """Teacher states in a group per length of the prompt. Rows are counted through all groups."""

    groups: tuple[TeacherStates, ...]

    def __len__(self) -> int:
        return sum(map(len, self.groups))

    def parts(self, indices: Tensor) -> list[TeacherStates]:
        """Return the rows at `indices` (B,), in batches of one prompt length."""
        batches, first = [], 0
        for group in self.groups:
            rows = indices[(indices >= first) & (indices < first + len(group))] - first
            if len(rows):
                batches.append(group.where(rows))
            first += len(group)
        return batches

    def prompts(self) -> list[Tensor]:
        """Return all prompts (1, P, E)."""
        return [prompt for group in self.groups for prompt in group.prompt.split(1)]


@torch.inference_mode()
def decode_demonstrations(
    target: Target, dataset: DemoDataset, limit: int, held_out: float, on_progress: OnProgress
) -> tuple[StatesByLength, StatesByLength]:
    """Return (training, held out) by whole episodes: the target's decodes of at most `limit` observations.

    Raises:
        CheckpointError: A single episode, or a damaged one.
    """
    every = held_out_every(len(dataset.episodes), held_out)
    rows: tuple[list[tuple[int, int]], ...] = ([], [])
    for index in range(len(dataset.episodes)):
        steps = steps_of(dataset.load(index), bool(target.cameras))
        rows[index % every == every - 1].extend((index, int(t)) for t in steps)
    states = _decodes(target, dataset, rows[0], limit, on_progress)
    return states, _decodes(target, dataset, rows[1], VALIDATED, lambda done, total: None)


def _decodes(
    target: Target,
    dataset: DemoDataset,
    rows: Sequence[tuple[int, int]],
    limit: int,
    on_progress: OnProgress,
) -> StatesByLength:
    """Return the decodes of at most `limit` of the rows (episode, control step), evenly spread."""
    chosen = [rows[i] for i in torch.linspace(0, len(rows) - 1, min(limit, len(rows))).long().tolist()]
    groups, done = defaultdict[int, list[TeacherStates]](list), 0

    def observations() -> Iterator[Observation]:
        for index, group in itertools.groupby(chosen, lambda row: row[0]):
            steps = np.array([step for _, step in group])
            yield from observations_of(target, dataset.load(index), steps, dataset.manifest.observation)

    for prompt in prompts_of(target, observations()):
        tokens, hidden = greedy(target, prompt)
        groups[prompt.shape[1]].append(TeacherStates(prompt.half().cpu(), hidden.half().cpu(), tokens.cpu()))
        done += len(prompt)
        on_progress(done, len(chosen))
    return StatesByLength(tuple(map(TeacherStates.joined, groups.values())))
