"""Training the drafter on the frozen target's own greedy decodes (docs/methods.md §2.2).

The teacher decodes the demonstrations' *observations* (the prompt, not the expert's answer); its hidden states, prompt
embeddings and tokens are what the drafter imitates, under the same causal mask and positions as at inference.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.batched import greedy
from kerv_cli.engine.decoder import Decoder, Parts
from kerv_cli.engine.parts import Fixed
from kerv_cli.engine.protocol import ReadableTarget, Target
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.drafter import Drafter, DrafterArtifact, DrafterProposer
from kerv_cli.methods.spec_vla import RelaxedRule
from kerv_cli.targets.observations import Rows, held_out_every, observations_of, prompts_of, steps_of
from kerv_cli.training.loop import Metrics
from kerv_cli.training.settings import TrainDrafterSettings
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress


@dataclass(frozen=True)
class TeacherStates(Rows):
    """The target's greedy decodes of n observations whose prompts are equally long."""

    prompt: Tensor  # (n, P, E) float16
    hidden: Tensor  # (n, P + N − 1, E) float16
    tokens: Tensor  # (n, N) int64

    def prompts(self, count: int) -> list[Tensor]:
        """At most `count` prompts (1, P, E), evenly spread."""
        chosen = torch.linspace(0, len(self) - 1, min(count, len(self))).long().tolist()
        return [self.prompt[i : i + 1] for i in chosen]


@dataclass(frozen=True)
class StatesByLength:
    """Teacher states: a group per length of the prompt, rows counted through all groups."""

    groups: tuple[TeacherStates, ...]

    def __len__(self) -> int:
        return sum(map(len, self.groups))

    def parts(self, indices: Tensor) -> list[TeacherStates]:
        """The rows at `indices` (B,), in batches of one prompt length."""
        batches, first = [], 0
        for group in self.groups:
            rows = indices[(indices >= first) & (indices < first + len(group))] - first
            if len(rows):
                batches.append(group.where(rows))
            first += len(group)
        return batches

    def prompts(self, count: int) -> list[Tensor]:
        """About `count` prompts (1, P, E): from every group in proportion to its rows, evenly spread."""
        return [x for group in self.groups for x in group.prompts(max(1, round(count * len(group) / len(self))))]


@torch.inference_mode()
def teach(
    target: Target, dataset: DemoDataset, limit: int, held_out: float, on_progress: OnProgress
) -> tuple[StatesByLength, StatesByLength]:
    """The target's greedy decodes of at most `limit` observations, evenly spread -> (training, held out) by whole
    episodes, as `split` divides them.

    Raises:
        CheckpointError: a single episode, or a damaged one.
    """
    every = held_out_every(len(dataset.episodes), held_out)
    sides: tuple[list[tuple[int, int]], ...] = ([], [])
    for index in range(len(dataset.episodes)):
        steps = steps_of(dataset.load(index), bool(target.cameras))
        sides[index % every == every - 1].extend((index, int(t)) for t in steps)
    states = _decodes(target, dataset, sides[0], limit, on_progress)
    return states, _decodes(target, dataset, sides[1], max(60, limit // 50), lambda done, total: None)


def _decodes(
    target: Target,
    dataset: DemoDataset,
    rows: Sequence[tuple[int, int]],
    limit: int,
    on_progress: OnProgress,
) -> StatesByLength:
    """The decodes of at most `limit` of the rows, (episode, control step), evenly spread."""
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


class Distillation:
    """Loss and validation of one drafter run. The target stays frozen."""

    def __init__(
        self,
        drafter: Drafter,
        target: Target,
        states: StatesByLength,
        held_out: StatesByLength,
        settings: DrafterSettings,
    ) -> None:
        self.module, self.target, self.settings = drafter, target, settings
        self.states, self.held_out = states, held_out
        self.device = target.device

    def __len__(self) -> int:
        return len(self.states)

    def loss(self, indices: Tensor, step: int) -> tuple[Tensor, Metrics]:
        """Mean loss over the unrolled passes for the states at `indices` (B,), and the token loss of each pass."""
        losses: list[Tensor] = []
        metrics: Metrics = {}
        for states in self.states.parts(indices):
            loss, measured = self.unrolled(states)
            losses.append(loss * len(states) / len(indices))
            metrics |= measured
        return torch.stack(losses).sum(), metrics

    def unrolled(self, states: TeacherStates) -> tuple[Tensor, Metrics]:
        """Mean loss over the unrolled passes for states of one prompt length, and the token loss of each pass."""
        prompt, hidden = states.prompt.to(self.device).float(), states.hidden.to(self.device).float()
        tokens = states.tokens.to(self.device)
        total, metrics = hidden.new_zeros(()), {}
        inputs = hidden[:, :-1]
        for number in range(self.settings.unroll):
            predicted = self.predict(prompt, inputs, tokens)
            state_loss, token_loss = self.compare(predicted, hidden, prompt.shape[1])
            total = total + self.settings.state_weight * state_loss + self.settings.token_weight * token_loss
            metrics[f"token_loss_{number}"] = float(token_loss.detach())
            # next pass: behind the first drafted position the drafter sees its own predictions, as in drafting
            start = prompt.shape[1]
            inputs = torch.cat([inputs[:, :start], predicted[:, start - 1 : -1]], 1)
        return total / self.settings.unroll, metrics

    def predict(self, prompt: Tensor, hidden: Tensor, tokens: Tensor) -> Tensor:
        """hidden (B, P + N − 2, E) at positions 0 … -> predictions of positions 1 … P + N − 2, same shape."""
        following = torch.cat([prompt[:, 1:], self.target.embed(tokens[:, :-1])], 1)
        positions = torch.arange(hidden.shape[1], device=hidden.device)
        predicted: Tensor = self.module(following, hidden, positions)
        return predicted

    def compare(self, predicted: Tensor, hidden: Tensor, length: int) -> tuple[Tensor, Tensor]:
        """Smooth L1 of states and soft cross-entropy of tokens, over the positions that tokens 1 … N − 1 need; length:
        P."""
        guess, truth = predicted[:, length - 1 :], hidden[:, length:]
        teacher = self.target.head(truth).softmax(-1)
        cross_entropy = -(teacher * F.log_softmax(self.target.head(guess), -1)).sum(-1).mean()
        return F.smooth_l1_loss(guess, truth), cross_entropy

    @torch.no_grad()
    def validate(self, module: nn.Module, observations: int = 60) -> Metrics:
        """Real decodes of held-out observations: tokens committed per verification, strict and at r = 9."""
        assert isinstance(module, Drafter)
        prompts = [prompt.to(self.device).float() for prompt in self.held_out.prompts(observations)]
        strict = acceptance_length(self.target, module, prompts, 0)
        relaxed = acceptance_length(self.target, module, prompts, 9)
        return {"score": relaxed + strict, "acceptance_length_strict": strict, "acceptance_length_r9": relaxed}


def acceptance_length(target: Target, drafter: Drafter, prompts: list[Tensor], r: int) -> float:
    """AL (docs/methods.md §7) of decoding `prompts` with a chain of up to 5 drafts at radius r."""
    proposer = DrafterProposer(drafter, target, depth=5, top_k=1, nodes=5)
    decoder = Decoder(target, Parts(RelaxedRule(target.actions), Fixed(r), proposer=proposer))
    chunks = [decoder.decode_prompt(prompt) for prompt in prompts]
    rounds = [r for c in chunks for r in c.rounds if r.tree_size]
    return sum(r.committed for r in rounds) / max(1, len(rounds))


class EagleTraining:
    """`kerv train drafter`: the EAGLE-style drafter."""

    artifact = DrafterArtifact()

    def objective(
        self, target: ReadableTarget, dataset: DemoDataset, settings: TrainDrafterSettings, progress: OnProgress
    ) -> Distillation:
        """Decode the demonstrations with the target and make a fresh drafter."""
        states, held_out = teach(target, dataset, settings.drafter.samples, settings.train.held_out, progress)
        torch.manual_seed(settings.train.seed)
        drafter = Drafter.beside(settings.drafter, target).to(target.device)
        return Distillation(drafter, target, states, held_out, settings.drafter)
