"""The one decode loop: propose, verify, accept, commit, rectify (METHODS §2). Methods are compositions of its parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kerv_cli.decoding.acceptance import acceptance_rule, judging, limits_of
from kerv_cli.decoding.boundary import Boundary, episode_generator
from kerv_cli.decoding.chunk import Chunk, Clock, Proposer, Situation, steps_of
from kerv_cli.decoding.proposers import EMPTY
from kerv_cli.decoding.record import DecodeRecord, Round
from kerv_cli.decoding.rectify import Compensation
from kerv_cli.decoding.thresholds import Threshold, build_threshold
from kerv_cli.decoding.verify_skip import VerifySkip
from kerv_cli.drafting.kinematics import ActionHistory
from kerv_cli.drafting.tree import TokenTree
from kerv_cli.errors import UsageError
from kerv_cli.settings import MethodSettings
from kerv_cli.spaces import GRIPPER, Observation
from kerv_cli.targets.protocol import Target


@dataclass(frozen=True)
class Parts:
    """What a method is made of besides its rules.

    opening: drafts before the prefill, which then verifies them (METHODS §5). proposer: drafts behind committed
    tokens. compensation: ends a chunk after a rejection; without it the target decodes on. boundary: chooses between
    the sides of a hybrid proposer. skip: executes a retrieved chunk unverified.
    """

    opening: Proposer | None = None
    proposer: Proposer | None = None
    compensation: Compensation | None = None
    boundary: Boundary | None = None
    skip: VerifySkip | None = None


class Decoder:
    """A target and the parts of a method. One episode at a time, batch of one.

    decode() times itself: from the observation handed in to the actions handed back, synchronised at both ends.
    """

    def __init__(self, target: Target, method: MethodSettings, parts: Parts | None = None) -> None:
        self.target, self.method, self.parts = target, method, parts or Parts()
        if self.parts.opening is not None and self.parts.opening.needs_states:
            raise UsageError(f"opening '{self.parts.opening.name}' needs the target's states, which come after it")
        self.size = steps_of(method.chunk, target.chunk) * target.actions.dofs
        acceptance_rule(method.acceptance)
        self.threshold: Threshold = build_threshold(method.threshold)
        nodes = max(method.proposer.nodes, method.opening.nodes, self.size)
        self.cache = target.new_cache(1, target.max_prompt + self.size + nodes + 1)
        self.situation = Situation("", ActionHistory(target.actions.dofs))

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the images that the target reads."""
        return self.target.cameras

    def reset(self, task: str, instruction: str, seed: int = 0) -> None:
        """A new episode begins."""
        random = episode_generator(self.method.boundary, task, seed)
        self.situation = Situation(task, ActionHistory(self.target.actions.dofs), random=random)
        self.threshold.reset()
        for part in (self.parts.compensation, self.parts.skip):
            if part is not None:
                part.reset()

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        """An action (D,) was executed; the end effector is now at (3,) metres."""
        self.situation.history.append(self.target.actions.normalise(action))
        self.situation.path.append(np.asarray(end_effector))

    def finish(self, success: bool) -> None:
        """The episode ended."""
        if self.parts.skip is not None:
            self.parts.skip.finish(success)

    @torch.inference_mode()
    def decode(self, observation: Observation) -> DecodeRecord:
        """What is known now -> the chunk's actions and the record of its decode."""
        clock = Clock(self.target.device)
        prompt = self.target.encode(observation)
        clock.lap("vision")
        chunk = self.decode_prompt(prompt, clock)
        actions, compensated = self.actions_of(chunk)
        compared = any(r.drafted and r.mode != "skip" for r in chunk.rounds)
        variability = chunk.variability if compared else None
        self.threshold.update(variability)
        if self.parts.compensation is not None:
            self.parts.compensation.next_decode()
        seconds = clock.stop()
        return DecodeRecord(
            tokens=tuple(chunk.tokens),
            actions=actions,
            size=chunk.size,
            forwards=chunk.forwards,
            rounds=tuple(chunk.rounds),
            mode=next((r.mode if r.mode == "skip" else r.proposer for r in chunk.rounds if r.drafted), "ar"),
            seconds=seconds,
            phases=clock.phases,
            compensated=compensated,
            variability=variability,
            skipped=any(r.mode == "skip" for r in chunk.rounds),
            similarity=chunk.similarity,
            metric=chunk.choice.metric if chunk.choice is not None else None,
        )

    def actions_of(self, chunk: Chunk) -> tuple[np.ndarray, int]:
        """(steps, D) float32 in environment units, and how many of its numbers were predicted."""
        tokenizer = self.target.actions
        if chunk.closed is None:
            return tokenizer.decode(np.array(chunk.tokens).reshape(-1, chunk.dofs)).astype(np.float32), 0
        predicted = max(0, chunk.closed.size - len(chunk.tokens))
        return tokenizer.unnormalise(chunk.closed).astype(np.float32), predicted

    @torch.inference_mode()
    def decode_prompt(self, prompt: Tensor, clock: Clock | None = None) -> Chunk:
        """prompt (1, P, E) -> a complete chunk, or one that the rectifier closed."""
        clock = clock or Clock(prompt.device)
        chunk = Chunk(prompt, self.size, self.target.actions.dofs, self.cache, self.situation)
        chunk.limits = limits_of(self.method.acceptance, self.threshold.radius(), chunk.dofs, GRIPPER)
        if self.parts.boundary is not None:
            chunk.choice = self.parts.boundary.choose(np.array(self.situation.path), self.situation.random)
        skipped = self.parts.skip is not None and self.parts.skip.take(chunk)
        clock.lap("propose")
        if skipped:
            return chunk
        self.open(chunk, clock)
        if self.parts.proposer is not None and chunk.left > 1:
            self.parts.proposer.begin(chunk)
            clock.lap("propose")
        while chunk.left:
            self.round(chunk, clock)
        return chunk

    def open(self, chunk: Chunk, clock: Clock) -> None:
        """The first forward: encodes the prompt and, with an opening draft, verifies that too."""
        tree, prompt, target = EMPTY, chunk.prompt, self.target
        if self.parts.opening is not None and chunk.size > 1:
            # as in a round: the bonus fills the last place
            tree = self.parts.opening.propose(chunk, chunk.size - 1)
            clock.lap("propose")
        chunk.forwards = 1
        length = prompt.shape[1]
        if not len(tree):
            chunk.cache.length = 0
            chunk.hidden = target.forward(prompt, torch.arange(length, device=prompt.device), chunk.cache)
            token = int(target.head(chunk.hidden[:, -1]).argmax())
            chunk.tokens.append(token)
            chunk.rounds.append(Round("prefill", "none", 0, (), (token,), 0, 1, 0, ()))
            clock.lap("prefill")
            return
        x = torch.cat([prompt, target.embed(torch.tensor([tree.tokens], device=prompt.device))], 1)
        positions = torch.tensor([*range(length), *(length + d for d in tree.depths)], device=prompt.device)
        chunk.cache.length = 0
        hidden = target.forward(x, positions, chunk.cache, None if tree.is_chain else tree.seen(length))
        target_tokens = target.head(hidden[0, length - 1 :]).argmax(-1).tolist()
        clock.lap("prefill")
        path = self.accept(chunk, tree, target_tokens, self.parts.opening)
        clock.lap("accept")
        rows = torch.tensor([length + i for i in path], device=prompt.device, dtype=torch.long)
        chunk.cache.compact(length, rows)
        chunk.hidden = torch.cat([hidden[:, :length], hidden[:, rows]], 1)
        clock.lap("prefill")
        self.rectify(chunk)
        clock.lap("rectify")

    def round(self, chunk: Chunk, clock: Clock) -> None:
        """One draft, one forward, one decision. Without a draft it decodes one token."""
        tree, proposer = EMPTY, self.parts.proposer
        if proposer is not None and chunk.left > 1:
            # one token less than is left: the bonus fills the last place whether or not everything is accepted
            tree = proposer.propose(chunk, min(self.method.proposer.depth, chunk.left - 1))
            clock.lap("propose")
        hidden, target_tokens = self.verify(chunk, tree)
        clock.lap("verify")
        first = len(chunk.tokens) - 1
        path = self.accept(chunk, tree, target_tokens, proposer)
        clock.lap("accept")
        rows = torch.tensor([0, *(i + 1 for i in path)], device=hidden.device)
        if len(tree):
            at = chunk.prompt.shape[1] + first
            chunk.cache.compact(at, at + rows)
            clock.lap("accept")
            self.rectify(chunk)
            clock.lap("rectify")
        if proposer is not None and chunk.left > 1:
            proposer.committed(chunk, first, hidden[:, rows], target_tokens)
            clock.lap("propose")

    def verify(self, chunk: Chunk, tree: TokenTree) -> tuple[Tensor, list[int]]:
        """Forward [last committed token, tree] -> hidden (1, 1 + n, E) and the argmax behind each of them."""
        device = self.target.device
        at = chunk.prompt.shape[1] + len(chunk.tokens) - 1
        tokens = torch.tensor([[chunk.tokens[-1], *tree.tokens]], device=device)
        positions = torch.tensor([at, *(at + 1 + d for d in tree.depths)], device=device)
        hidden = self.target.forward(self.target.embed(tokens), positions, chunk.cache, tree.seen(1))
        chunk.forwards += 1
        return hidden, self.target.head(hidden)[0].argmax(-1).tolist()

    def accept(
        self, chunk: Chunk, tree: TokenTree, target_tokens: Sequence[int], proposer: Proposer | None
    ) -> tuple[int, ...]:
        """Commit the best accepted path and, where a place is left, the bonus; record the round -> the path's nodes."""
        start = len(chunk.tokens)
        if not len(tree) or proposer is None:
            chunk.tokens.append(target_tokens[0])
            chunk.rounds.append(Round("decode", "none", start, (), (target_tokens[0],), 0, 1, 0, ()))
            return ()
        acceptance = judging(self.method.acceptance, proposer.name)
        limits = limits_of(acceptance, self.threshold.radius(), chunk.dofs, GRIPPER)
        verdict = acceptance_rule(acceptance)(tree, target_tokens, start, limits)
        path = verdict.path
        behind = [] if verdict.rejected is None else tree.down_from(verdict.rejected)
        chunk.unverified = [tree.tokens[i] for i in behind[1:]]
        chunk.guesses = [target_tokens[i + 1] for i in behind]
        judged = path if verdict.rejected is None else (*path, verdict.rejected)
        seen = [target_tokens[tree.parents[i] + 1] for i in judged]
        drafted = [tree.tokens[i] for i in judged]
        bonus = [target_tokens[path[-1] + 1 if path else 0]] if start + len(path) < chunk.size else []
        chunk.tokens += [tree.tokens[i] for i in path] + bonus
        values = self.target.actions.values_of
        chunk.variability += float(np.abs(values(np.array(drafted)) - values(np.array(seen))).sum())
        chunk.rounds.append(
            Round(
                mode="verify",
                proposer=proposer.name,
                start=start,
                drafted=tuple(drafted),
                target_tokens=tuple(seen) if verdict.rejected is not None else (*seen, *bonus),
                accepted=len(path),
                committed=len(path) + len(bonus),
                tree_size=len(tree),
                threshold=limits,
            )
        )
        return path

    def rectify(self, chunk: Chunk) -> None:
        """After a rejection: let the compensation end the chunk, if there is one and it can."""
        last, compensation = chunk.rounds[-1], self.parts.compensation
        if compensation is None or last.accepted == len(last.drafted):
            return
        complete = not chunk.left  # the verdict filled the last place: nothing is missing, if it may be used
        if complete and self.method.rectifier.use_verdict:
            return
        if compensation.close(chunk) and not self.method.rectifier.use_verdict:
            chunk.rounds[-1] = last.without_bonus()
