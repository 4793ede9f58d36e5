"""The one decode loop: propose, verify, accept, commit, rectify (docs/methods.md §2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.spaces import ActionSpace, Observation
from kerv_cli.engine.acceptance import Acceptance, StrictRule
from kerv_cli.engine.chunk import ActionHistory, Chunk, Clock, Rejection, Situation, steps_of
from kerv_cli.engine.draft import EMPTY, Draft
from kerv_cli.engine.parts import Boundary, Fixed, Rectifier, Skip, Threshold
from kerv_cli.engine.proposer import Proposer
from kerv_cli.engine.protocol import Target
from kerv_cli.engine.record import PARALLEL, DecodeRecord, Round
from kerv_cli.engine.transfer import read, upload
from kerv_cli.engine.tree import TokenTree


@dataclass(frozen=True)
class Parts:
    """The parts of a method; the defaults are autoregressive decoding.

    prefill_draft: makes the in-prefill draft, which the prefill verifies (§5). proposer: drafts behind committed
    tokens. rectifier: ends a chunk after a rejection; without one the target decodes on. boundary: chooses between the
    sides of a hybrid proposer. skip: executes a chunk without verification.
    """

    acceptance: Acceptance | None = None  # None: strict
    threshold: Threshold | None = None  # None: r = 0
    prefill_draft: Proposer | None = None
    proposer: Proposer | None = None
    rectifier: Rectifier | None = None
    boundary: Boundary | None = None
    skip: Skip | None = None


@dataclass(frozen=True)
class Verified:
    """What a forward verified, on the host. tree: of n nodes. rows: (n,) the row of each among those forwarded.
    target_tokens: 1 + n, as `accept_by_distance` takes them."""

    tree: TokenTree
    rows: Sequence[int]
    target_tokens: list[int]

    def rows_of(self, path: Sequence[int]) -> list[int]:
        """Rows of a path's nodes."""
        return [self.rows[node] for node in path]


class Decoder:
    """Decodes chunks with one target and one method; one episode at a time, batch of one.

    decode() times itself, from the observation to the actions, with the device synchronised at both ends.
    """

    def __init__(self, target: Target, parts: Parts | None = None, chunk: int = 0) -> None:
        """chunk: H, control steps decoded at once; 0: as many as the target was trained for.

        Raises:
            UsageError: a longer chunk.
        """
        self.target, self.parts = target, parts or Parts()
        draft = self.parts.prefill_draft
        self.steps = steps_of(chunk, target.chunk)
        self.acceptance: Acceptance = self.parts.acceptance or StrictRule(target.actions)
        self.threshold: Threshold = self.parts.threshold or Fixed(0)
        size = self.steps * target.actions.dofs
        nodes = max((p.nodes for p in (draft, self.parts.proposer) if p is not None), default=0)
        self.cache = target.new_cache(1, target.max_prompt + size + max(nodes, size) + 1)
        self.situation = Situation("", ActionHistory(target.actions.dofs))
        # set from outside: decodes every `every`-th observation of an episode too, outside the timing
        self.reference: Decoder | None = None
        self.every = self.decodes = 0

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the images that an observation must hold."""
        return self.target.cameras

    def reset(self, task: str, seed: int, end_effector: np.ndarray) -> None:
        """A new episode begins, with the end effector at (3,) metres."""
        self.decodes, boundary = 0, self.parts.boundary
        random = boundary.numbers(task, seed) if boundary is not None else np.random.default_rng(seed)
        history = ActionHistory(self.target.actions.dofs)
        self.situation = Situation(task, history, [np.asarray(end_effector)], random)
        for part in (self.threshold, self.parts.rectifier, self.parts.prefill_draft, self.parts.proposer):
            if part is not None:
                part.reset()
        if self.parts.skip is not None:
            self.parts.skip.begin(task, seed)

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
        """The chunk's actions and the record of its decode."""
        clock = Clock(self.target.device)
        chunk = self.decode_prompt(self._encoding(observation, clock), clock, observation)
        actions, predicted = self.actions_of(chunk)
        self.threshold.update(chunk.variability)
        if self.parts.rectifier is not None:
            self.parts.rectifier.next_decode()
        record = record_of(chunk, actions, clock.stop(), clock.phases, predicted)
        self.decodes += 1
        if self.reference is None or self.decodes % self.every:
            return record
        autoregressive = self.reference.decode(observation).actions
        return replace(record, deviation=deviation(self.target.actions, actions, autoregressive))

    def _encoding(self, observation: Observation, clock: Clock) -> Callable[[], Tensor]:
        """A function that encodes the observation; its seconds are added to the phase `vision`."""

        def encode() -> Tensor:
            clock.lap("propose")  # the first part that reads the prompt drafts from it
            prompt = self.target.encode(observation)
            clock.lap("vision")
            return prompt

        return encode

    def actions_of(self, chunk: Chunk) -> tuple[np.ndarray, int]:
        """The chunk's actions (steps, D) float32 in environment units, and how many of their numbers were predicted."""
        space = self.target.actions
        if chunk.closed is None:
            return actions_of(space, chunk.tokens), 0
        predicted = max(0, chunk.closed.size - len(chunk.tokens))
        return space.unnormalise(chunk.closed).astype(np.float32), predicted

    @torch.inference_mode()
    def decode_prompt(
        self,
        prompt: Tensor | Callable[[], Tensor],
        clock: Clock | None = None,
        observation: Observation | None = None,
    ) -> Chunk:
        """prompt (1, P, E), or what encodes it -> a complete chunk, or one that the rectifier closed. observation: for
        drafts that look at it themselves."""
        clock, parts = clock or Clock(self.target.device), self.parts
        choice = None
        if parts.boundary is not None:
            choice = parts.boundary.choose(np.array(self.situation.path), self.situation.random)
        limits = self.acceptance.limits(self.threshold.radius())
        space = self.target.actions
        chunk = Chunk(prompt, self.steps, space, self.cache, self.situation, limits, choice, observation)
        clock.lap("propose")
        if parts.skip is not None:
            skipped = parts.skip.take(chunk)
            clock.lap(parts.skip.phase)
            if skipped:
                return chunk
        self.prefill(chunk, clock)
        if parts.proposer is not None and chunk.remaining > 1:
            parts.proposer.begin(chunk)
            clock.lap("propose")
        if parts.proposer is None and chunk.remaining:
            self.decode_alone(chunk, clock)
        while chunk.remaining:
            self.round(chunk, clock)
        return chunk

    def prefill(self, chunk: Chunk, clock: Clock) -> None:
        """The first forward: the prompt and, where there is an in-prefill draft, the draft behind it, to verify it."""
        target, parts = self.target, self.parts
        draft = EMPTY
        if parts.prefill_draft is not None and chunk.size > 1:
            # one token less than the chunk has, as in a round: the bonus is its last token
            draft = parts.prefill_draft.propose(chunk, chunk.size - 1)
            clock.lap("propose")
        if parts.proposer is not None and chunk.size > 1:
            parts.proposer.prepare(chunk)
        x, length = chunk.prompt, chunk.prompt_length
        if len(draft):
            x = torch.cat([x, target.embed(draft.tokens_on(x.device)[None])], 1)
        chunk.cache.length = 0
        hidden = self.forward(x, draft, 0, length, chunk)
        chunk.hidden = hidden
        verified = self.read(chunk, draft, target.head(hidden[0, length - 1 :]).argmax(-1))
        clock.lap("prefill")
        path = self.accept(chunk, verified.tree, verified.target_tokens, parts.prefill_draft)
        if parts.skip is not None:
            parts.skip.verified(chunk)
        clock.lap("accept")
        if not len(draft):
            return
        chunk.hidden = self.keep(chunk, hidden, 0, length, verified.rows_of(path))
        clock.lap("prefill")
        self.rectify(chunk)
        clock.lap("rectify")

    def round(self, chunk: Chunk, clock: Clock) -> None:
        """One round: propose, verify, accept, commit, rectify. Without a draft the forward decodes one token."""
        draft, proposer = EMPTY, self.parts.proposer
        if proposer is not None and chunk.remaining > 1:
            # one token less than the chunk lacks: the bonus is its last token whether or not everything is accepted
            draft = proposer.propose(chunk, chunk.remaining - 1)
            clock.lap("propose")
        hidden, verified = self.verify(chunk, draft)
        clock.lap("verify")
        first = len(chunk.tokens) - 1
        path = self.accept(chunk, verified.tree, verified.target_tokens, proposer)
        clock.lap("accept")
        if len(draft):
            hidden = self.keep(chunk, hidden, chunk.prompt_length + first, 1, verified.rows_of(path))
            clock.lap("accept")
            self.rectify(chunk)
            clock.lap("rectify")
        if proposer is not None and chunk.remaining > 1:
            proposer.committed(chunk, first, hidden, verified.target_tokens)
            clock.lap("propose")

    def decode_alone(self, chunk: Chunk, clock: Clock) -> None:
        """The chunk's remaining tokens, one forward each, without a proposer. Each goes from the device into the next
        forward; all are read behind the last one."""
        target, first = self.target, chunk.prompt_length + len(chunk.tokens) - 1
        positions = torch.arange(first, first + chunk.remaining, device=target.device).split(1)
        tokens = [upload(chunk.tokens[-1:], target.device)]
        for position in positions:
            hidden = target.forward(target.embed(tokens[-1][None]), position, chunk.cache, None)
            tokens.append(target.head(hidden)[0].argmax(-1))
            clock.lap("verify")
        numbers = torch.cat(tokens[1:]).tolist()
        clock.lap("verify")
        for token in numbers:
            self.accept(chunk, EMPTY.tree, [token], None)
        clock.lap("accept")

    def verify(self, chunk: Chunk, draft: Draft) -> tuple[Tensor, Verified]:
        """Forwards the last committed token and the draft's n rows -> hidden (1, 1 + n, E), and the draft with its
        target tokens on the host."""
        tokens = draft.tokens_behind(chunk.tokens[-1], self.target.device)
        start = chunk.prompt_length + len(chunk.tokens) - 1
        hidden = self.forward(self.target.embed(tokens[None]), draft, start, 1, chunk)
        return hidden, self.read(chunk, draft, self.target.head(hidden)[0].argmax(-1))

    def forward(self, x: Tensor, draft: Draft, start: int, before: int, chunk: Chunk) -> Tensor:
        """x (1, before + n, E): tokens from position `start` on, and a draft behind them -> hidden states."""
        return self.target.forward(x, draft.positions(start, before, x.device), chunk.cache, draft.visible(before))

    def read(self, chunk: Chunk, draft: Draft, argmax: Tensor) -> Verified:
        """argmax (1 + n,) behind the last token before the draft and behind each of its rows -> the tree and its target
        tokens. A round waits for the device nowhere else."""
        remote = draft.remote
        reads, chunk.reads = chunk.reads, []
        targets, *vectors = read(argmax, *remote, *(tensor for tensor, _ in reads))
        for (_, receive), vector in zip(reads, vectors[len(remote) :], strict=True):
            receive(vector)
        tokens = targets.astype(np.int64).tolist()
        if draft.choose is not None:
            tree, rows = draft.choose()
            return Verified(tree, rows, [tokens[0], *(tokens[1 + row] for row in rows)])
        numbers = (vector.astype(np.int64).tolist() for vector in vectors[: len(remote)])
        return Verified(TokenTree.build(*numbers) if remote else draft.tree, range(len(draft)), tokens)

    def keep(self, chunk: Chunk, hidden: Tensor, start: int, before: int, rows: list[int]) -> Tensor:
        """Commits the cache's entries of a forward that began at slot `start`: `before` tokens and the draft's `rows`
        -> their states (1, before + rows, E). A chain's rows lie where they belong."""
        length = before + len(rows)
        if rows == list(range(len(rows))):
            chunk.cache.length = start + length
            return hidden[:, :length]
        slots = upload([before + row for row in rows], hidden.device)
        chunk.cache.compact(start + before, start + slots)
        return torch.cat([hidden[:, :before], hidden[:, slots]], 1)

    def accept(
        self, chunk: Chunk, tree: TokenTree, target_tokens: Sequence[int], proposer: Proposer | None
    ) -> tuple[int, ...]:
        """Commits the best accepted path and, where the chunk has room, the bonus -> the path's nodes."""
        start = len(chunk.tokens)
        if not len(tree) or proposer is None:
            token = target_tokens[0]
            chunk.commit(Round("decode" if start else "prefill", "none", start, (), (token,), 0, 1, 0, ()), [token])
            return ()
        acceptance, r = self.acceptance.of_drafts_from(proposer.name), self.threshold.radius()
        accepted = acceptance.judge(tree, target_tokens, start, r)
        path, rejected = accepted.path, accepted.rejected
        behind = [] if rejected is None else tree.down_from(rejected)
        nodes = path if rejected is None else (*path, rejected)
        targets = [target_tokens[tree.parents[i] + 1] for i in nodes]
        bonus = [target_tokens[path[-1] + 1 if path else 0]] if start + len(path) < chunk.size else []
        record = Round(
            mode="verify",
            proposer=proposer.name,
            start=start,
            drafted=tuple(tree.tokens[i] for i in nodes),
            target_tokens=tuple(targets) if rejected is not None else (*targets, *bonus),
            accepted=len(path),
            committed=len(path) + len(bonus),
            tree_size=len(tree),
            threshold=acceptance.limits(r),
        )
        rejection = Rejection(tuple(tree.tokens[i] for i in behind[1:]), tuple(target_tokens[i + 1] for i in behind))
        chunk.commit(record, [tree.tokens[i] for i in path] + bonus, rejection)
        return path

    def rectify(self, chunk: Chunk) -> None:
        """After a rejection: ends the chunk by the rectifier, if there is one and it can predict what is missing."""
        last, rectifier = chunk.rounds[-1], self.parts.rectifier
        if rectifier is None or last.accepted == len(last.drafted):
            return
        # where the target's token is the last of the chunk nothing is missing, if it may be used
        if chunk.remaining or not rectifier.uses_target_token:
            rectifier.close(chunk)


def record_of(
    chunk: Chunk, actions: np.ndarray, seconds: float, phases: dict[str, float], compensated: int
) -> DecodeRecord:
    """The record of a complete chunk. actions (H, D), seconds, phases, compensated: as in `DecodeRecord`."""
    return DecodeRecord(
        tokens=tuple(chunk.tokens),
        actions=actions,
        size=chunk.size,
        forwards=chunk.forwards,
        rounds=tuple(chunk.rounds),
        mode=mode_of(chunk.rounds),
        seconds=seconds,
        phases=phases,
        compensated=compensated,
        variability=chunk.variability,
        skipped=any(record.mode == "skip" for record in chunk.rounds),
        similarity=chunk.similarity,
        metric=chunk.choice.metric if chunk.choice is not None else None,
        reason=chunk.reason,
    )


def actions_of(space: ActionSpace, tokens: Sequence[int]) -> np.ndarray:
    """The tokens of whole control steps -> actions (steps, D) float32 in environment units."""
    return space.decode(np.array(tokens).reshape(-1, space.dofs)).astype(np.float32)


def deviation(space: ActionSpace, actions: np.ndarray, autoregressive: np.ndarray) -> float:
    """Mean absolute difference of actions (h, D) to the first h ≤ H of autoregressive decoding's (H, D), in normalised
    action units."""
    gap = space.normalise(actions) - space.normalise(autoregressive[: len(actions)])
    return float(np.abs(gap).mean())


def mode_of(rounds: Sequence[Round]) -> str:
    """`DecodeRecord.mode` of a chunk's rounds."""
    for record in rounds:
        if record.mode in ("skip", PARALLEL):
            return record.mode
        if record.drafted:
            return record.proposer
    return "ar"
