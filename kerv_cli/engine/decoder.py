"""The decode loop of all methods: propose, verify, accept, commit, rectify (docs/methods.md §2).

Shapes: B prompts, P prompt tokens, N tokens of a chunk, E width of the target's embeddings and hidden states.
"""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.acceptance import Accepted, DistanceRule, StrictRule
from kerv_cli.engine.chunk import Chunk, Follower, TargetSide, chunk_steps
from kerv_cli.engine.decisions import Judged, TokenTree
from kerv_cli.engine.draft import EMPTY, Draft, read, upload
from kerv_cli.engine.parts import Boundary, Fixed, Rectifier, Skip, Threshold
from kerv_cli.engine.proposer import Proposer
from kerv_cli.engine.protocol import ContinuesGreedily, PredictsTokens, Seen, Target
from kerv_cli.engine.record import MEAN, PHASES, DecodeRecord, Round, variability


class Stopwatch:
    """Measures the seconds that each phase of one decode takes (`PHASES`).

    On CUDA it records events in the stream. The CPU waits for the GPU only at the start and at the end.

    Attributes:
        laps: After `stop`: phase and seconds of every lap, in order.
    """

    def __init__(self, device: torch.device) -> None:
        self.on_cuda = device.type == "cuda"
        self.phases, self.laps = dict.fromkeys(PHASES, 0.0), list[tuple[str, float]]()
        if self.on_cuda:
            torch.cuda.synchronize()
        self.began = time.perf_counter()
        self._marks = [("", self._mark())]

    def lap(self, phase: str) -> None:
        self._marks.append((phase, self._mark()))

    def stop(self) -> float:
        self.lap("other")
        if self.on_cuda:
            torch.cuda.synchronize()
        total = time.perf_counter() - self.began
        for (_, begin), (phase, end) in itertools.pairwise(self._marks):
            self.laps.append((phase, begin.elapsed_time(end) / 1000.0 if self.on_cuda else end - begin))
        self.laps.append(("other", max(0.0, total - sum(seconds for _, seconds in self.laps))))
        for phase, seconds in self.laps:
            self.phases[phase] += seconds
        return total

    def _mark(self) -> Any:
        if not self.on_cuda:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event


@dataclass(frozen=True)
class Parts:
    """The parts of a decoding method (docs/methods.md §2). With the defaults, the target decodes autoregressively."""

    acceptance: DistanceRule | None = None  # None: draft tokens must equal the target's
    threshold: Threshold | None = None  # None: r = 0
    prefill_draft: Proposer | None = None  # drafts before the prefill, which then verifies the draft (§5)
    proposer: Proposer | None = None  # drafts in every later round
    rectifier: Rectifier | None = None  # ends a chunk after a rejection; None: the target decodes on
    boundary: Boundary | None = None  # chooses between retrieval and drafter
    skip: Skip | None = None  # may execute a draft without verification


class Verified(NamedTuple):
    """Result of one verification, a forward of the target over a draft of n nodes.

    Attributes:
        hidden: The target's hidden states (1, before + n, E). The first `before` belong to tokens that were not in the
            cache yet: the prompt, or the newest committed tokens. The other n belong to the draft's nodes.
        tree: The draft's n nodes, on the CPU.
        target_tokens: 1 + n tokens, on the CPU: the target's prediction after the last committed token, then its
            prediction after each node.
        levels: Number of levels of the drafted tree. 0 for a chain.
    """

    hidden: Tensor
    tree: TokenTree
    target_tokens: list[int]
    levels: int


class Decoder(Follower):
    """Decodes chunks of actions with one target and one method, one episode at a time."""

    def __init__(self, target: Target, parts: Parts | None = None, chunk: int = 0) -> None:
        super().__init__(target.actions, target.cameras)
        self.target, self.device, self.parts = target, target.device, parts or Parts()
        self.predicts: PredictsTokens | None = target if isinstance(target, PredictsTokens) else None
        self.continues = target if isinstance(target, ContinuesGreedily) else None
        self.steps = chunk_steps(chunk, target.chunk)
        self.acceptance: DistanceRule = self.parts.acceptance or StrictRule(target.actions)
        self.threshold: Threshold = self.parts.threshold or Fixed(0)
        # a parallel target always decodes as many tokens as it was trained for
        size = target.actions.longest(target.chunk if getattr(target, "parallel", False) else self.steps)
        proposers = filter(None, (self.parts.prefill_draft, self.parts.proposer))
        nodes = max(size, *(proposer.nodes for proposer in proposers), 0)
        self.cache = target.new_cache(1, target.max_prompt + size + nodes + 1)
        self.r = 0  # the acceptance radius of this decode, bins
        self.decodes = 0  # in this episode
        self.deviation_every = 0  # every this many decodes, measure the deviation from autoregressive actions; 0: never

    @functools.cached_property
    def autoregressive(self) -> Decoder:
        return Decoder(self.target, chunk=self.steps)

    def reset(self, task: str, seed: int, end_effector: np.ndarray) -> None:
        super().reset(task, seed, end_effector)
        self.decodes = 0
        parts = self.parts
        if parts.boundary is not None:
            parts.boundary.reset(task, seed)
        for part in (self.threshold, parts.rectifier, parts.prefill_draft, parts.proposer):
            if part is not None:
                part.reset()
        if parts.skip is not None:
            parts.skip.begin(task, seed)

    def finish(self, success: bool) -> None:
        if self.parts.skip is not None:
            self.parts.skip.finish(success)

    @torch.inference_mode()
    def decode(self, observation: Observation) -> DecodeRecord:
        stopwatch = Stopwatch(self.device)

        def encode() -> Tensor:
            stopwatch.lap("propose")  # time until now was spent by the part that reads the prompt first
            prompt = self.target.encode(observation)
            stopwatch.lap("vision")
            return prompt

        chunk = self.decode_prompt(encode, stopwatch)
        values = chunk.values(self.target.chunk)
        actions = chunk.actions(values)
        self.decoded.append(chunk.tokens)
        self.planned = [*values]
        measure = self.threshold.measure
        self.threshold.update(chunk.variability if measure == MEAN else variability(chunk.rounds, self.space, measure))
        if self.parts.rectifier is not None:
            self.parts.rectifier.next_decode()
        record = chunk.record(actions, stopwatch.stop(), stopwatch.phases)
        self.decodes += 1
        if not self.deviation_every or self.decodes % self.deviation_every:
            return record
        autoregressive = self.autoregressive.decode(observation).actions[: len(actions)]
        gap = self.space.normalise(actions) - self.space.normalise(autoregressive)
        return replace(record, deviation=float(np.abs(gap).mean()))

    @torch.inference_mode()
    def decode_prompt(self, prompt: Tensor | Callable[[], Tensor], stopwatch: Stopwatch | None = None) -> Chunk:
        """Return the complete chunk for one prompt.

        Args:
            prompt: The prompt's embeddings (1, P, E), or a function that computes them when they are first needed.
        """
        stopwatch = stopwatch or Stopwatch(self.device)
        chunk, skip = self._new_chunk(prompt), self.parts.skip
        stopwatch.lap("propose")
        if skip is not None:
            chunk.take(skip.take(chunk))
            stopwatch.lap(skip.phase)
        if not chunk.remaining:
            return chunk
        self.round(chunk, stopwatch)
        while chunk.remaining:
            (self.round if self.parts.proposer else self.decode_plainly)(chunk, stopwatch)
        return chunk

    def _new_chunk(self, prompt: Tensor | Callable[[], Tensor]) -> Chunk:
        self.cache.length, choice, boundary = 0, None, self.parts.boundary
        if boundary is not None:
            choice = boundary.choose(self.path)
        self.r = self.threshold.radius()
        limits = self.acceptance.limits(self.r)
        target = TargetSide(prompt if callable(prompt) else lambda: prompt, self.cache)
        return Chunk(self.steps, self.space, self, target, limits, choice)

    def round(self, chunk: Chunk, stopwatch: Stopwatch) -> None:
        """Run one round: propose, verify, accept, commit, rectify.

        The first round is the prefill. Its forward reads the prompt and verifies the prefill draft, if there is one.
        """
        parts, is_first, last = self.parts, not chunk.tokens, len(chunk.tokens) - 1
        drafter, proposer = parts.prefill_draft if is_first else parts.proposer, parts.proposer
        draft = self.propose(chunk, drafter, stopwatch)
        verified = self.verify(chunk, draft)
        stopwatch.lap("prefill" if is_first else "verify")
        accepted = self.accept(chunk, verified, drafter)
        hidden = self.commit(chunk, verified, accepted, drafter)
        if is_first and parts.skip is not None:
            parts.skip.verified(chunk)
        stopwatch.lap("accept")
        hidden = self.rectify(chunk, hidden, stopwatch)
        if is_first:
            chunk.target.hidden = hidden
        if proposer is None or chunk.remaining < 2:
            return
        if is_first:
            proposer.begin(chunk)
        else:
            proposer.committed(chunk, last, hidden, verified.target_tokens)
        stopwatch.lap("propose")

    def decode_plainly(self, chunk: Chunk, stopwatch: Stopwatch) -> None:
        """Decode the remaining tokens without drafts: in one call if the target is a `ContinuesGreedily`."""
        tokens = None
        if self.continues is not None:
            tokens = self.continues.continue_greedily(
                chunk.tokens[-1], chunk.remaining, chunk.target.cache, self.space.end
            )
        tokens = self.forward_singly(chunk, stopwatch) if tokens is None else tokens
        stopwatch.lap("verify")
        for token in tokens:
            chunk.commit_token(token)
        stopwatch.lap("accept")

    def forward_singly(self, chunk: Chunk, stopwatch: Stopwatch) -> list[int]:
        """Decode the remaining tokens with one forward each. The CPU reads all tokens after the last forward.

        If an end token can end the chunk, the CPU reads each token right after its forward.
        """
        cache, first = chunk.target.cache, chunk.target.cache.length
        positions = torch.arange(first, first + chunk.remaining, device=self.device).split(1)
        tokens = [upload(chunk.tokens[-1:], self.device)]
        for position in positions:
            tokens.append(self.predict(tokens[-1], position, cache, None)[0])
            stopwatch.lap("verify")
            if self.space.end is not None and int(tokens[-1]) == self.space.end:
                break
        return torch.cat(tokens[1:]).tolist()

    def predict(self, tokens: Tensor, positions: Tensor, cache: Any, seen: Seen) -> tuple[Tensor, Tensor]:
        if self.predicts is not None:
            return self.predicts.predict(tokens, positions, cache, seen)
        hidden = self.target.forward(self.target.embed(tokens[None]), positions, cache, seen)
        return self.target.head(hidden[0]).argmax(-1), hidden

    def propose(self, chunk: Chunk, proposer: Proposer | None, stopwatch: Stopwatch) -> Draft:
        if proposer is None or chunk.remaining < 2:
            return EMPTY
        depth = chunk.remaining - 1  # the target itself gives the chunk's last token
        draft = proposer.propose(chunk, depth)
        draft.check(self.space.tokens, proposer.name, depth)
        stopwatch.lap("propose")
        return draft

    def verify(self, chunk: Chunk, draft: Draft) -> Verified:
        """Run the target once, over the draft and the tokens before it that are not cached yet, such as the prompt."""
        target, cache, uncached = self.target, chunk.target.cache, chunk.target.uncached(chunk.tokens)
        before = len(uncached) or chunk.target.prompt_length
        positions, seen = draft.positions(cache.length, before, self.device), draft.visible(before)
        if uncached:
            found, hidden = self.predict(draft.tokens_after(uncached, self.device), positions, cache, seen)
            predicted = found[before - 1 :]
        else:
            x = chunk.target.prompt
            if len(draft):
                x = torch.cat([x, target.embed(draft.tokens_after([], self.device)[None])], 1)
            hidden = target.forward(x, positions, cache, seen)
            predicted = target.head(hidden[0, before - 1 :]).argmax(-1)
        # nowhere else in a round does the CPU wait for the GPU
        targets, *remote = read(predicted, *draft.remote)
        tree = draft.judged(remote)
        return Verified(hidden, tree, targets.astype(np.int64, copy=False).tolist(), draft.levels or tree.levels)

    def accept(self, chunk: Chunk, verified: Verified, proposer: Proposer | None) -> Accepted:
        if proposer is None:
            return Accepted((), None)
        rule = self.acceptance.of_drafts_from(proposer.name)
        path, rejected = rule.judge_after(chunk.tokens, verified.tree, verified.target_tokens, self.r)
        kept = chunk.until_end([verified.tree.tokens[node] for node in path])
        ended = bool(kept) and kept[-1] == self.space.end
        return Accepted(path[: len(kept)], None if ended else rejected)

    def commit(self, chunk: Chunk, verified: Verified, accepted: Accepted, proposer: Proposer | None) -> Tensor:
        """Commit the accepted path and, if the chunk has room, the bonus: the target's next token.

        Returns the hidden states (1, b + a, E): of the b tokens before the draft in the verified forward, and of the
        a accepted draft tokens.
        """
        tree, target_tokens, (path, rejected) = verified.tree, verified.target_tokens, accepted
        if proposer is None or not len(tree):
            chunk.commit_token(target_tokens[0])
            return self._keep(chunk, verified, [])
        start, nodes = len(chunk.tokens), path if rejected is None else (*path, rejected)
        is_full = start + len(path) == chunk.size or (bool(path) and tree.tokens[path[-1]] == self.space.end)
        bonus = [] if is_full else [target_tokens[path[-1] + 1 if path else 0]]
        targets = [target_tokens[tree.parents[node] + 1] for node in nodes]
        record = Round(
            mode="verify",
            proposer=proposer.name,
            start=start,
            drafted=tuple(tree.tokens[node] for node in nodes),
            target_tokens=tuple(targets if rejected is not None else targets + bonus),
            accepted=len(path),
            committed=len(path) + len(bonus),
            tree_size=len(tree),
            threshold=self.acceptance.of_drafts_from(proposer.name).limits(self.r),
            levels=verified.levels,
        )
        judged = Judged(tree, target_tokens, rejected)
        chunk.commit(record, [tree.tokens[node] for node in path] + bonus, judged)
        return self._keep(chunk, verified, list(path))

    def _keep(self, chunk: Chunk, verified: Verified, rows: list[int]) -> Tensor:
        # removes the rejected draft tokens from the cache
        cache, hidden = chunk.target.cache, verified.hidden
        end, before = cache.length - len(verified.tree), hidden.shape[1] - len(verified.tree)
        if rows == list(range(len(rows))):  # the first nodes of a chain are already in their slots
            cache.length = end + len(rows)
            return hidden[:, : before + len(rows)]
        cache.compact(end, upload([end + row for row in rows], hidden.device))
        return hidden.index_select(1, upload([*range(before), *(before + row for row in rows)], hidden.device))

    def rectify(self, chunk: Chunk, hidden: Tensor, stopwatch: Stopwatch) -> Tensor:
        """After a rejection, let the rectifier predict the missing values of the rejected token's control step.

        If the target has several unread tokens afterwards and the chunk is not complete, one more forward reads these
        tokens and gives the next token. Returns `hidden`, followed by the hidden states of that forward.
        """
        last, rectifier = chunk.rounds[-1], self.parts.rectifier
        if rectifier is None or last.accepted == len(last.drafted):
            return hidden
        # a full chunk whose last token is the target's is complete, unless the rectifier may not use that token
        if chunk.remaining or not rectifier.uses_target_token:
            found = rectifier.rectify(chunk)
            if found is not None:
                chunk.rectify(found, rectifier.uses_target_token)
        stopwatch.lap("rectify")
        if chunk.remaining and len(chunk.target.uncached(chunk.tokens)) > 1:
            hidden = torch.cat([hidden, self.commit(chunk, self.verify(chunk, EMPTY), Accepted((), None), None)], 1)
            stopwatch.lap("verify")
        return hidden


@torch.inference_mode()
def greedy(target: Target, prompt: Tensor) -> tuple[Tensor, Tensor]:
    """Decode a batch of prompts autoregressively.

    Args:
        prompt: The prompts' embeddings (B, P, E).

    Returns:
        The decoded tokens (B, N), where N is the largest number of tokens in a chunk: end tokens fill shorter chunks.
        The hidden states (B, P + N − 1, E) of the prompt and of all decoded tokens but the last.
    """
    length, size = prompt.shape[1], target.actions.longest(target.chunk)
    cache = target.new_cache(len(prompt), length + size)
    positions = torch.arange(length + size - 1, device=prompt.device)
    hidden = [target.forward(prompt, positions[:length], cache)]
    tokens = [target.head(hidden[0][:, -1]).argmax(-1)]
    for position in positions[length:].split(1):
        hidden.append(target.forward(target.embed(tokens[-1][:, None]), position, cache))
        tokens.append(target.head(hidden[-1][:, -1]).argmax(-1))
    found, end = torch.stack(tokens, 1), target.actions.end
    if end is not None:
        is_end = (found == end).long()
        found = found.masked_fill(is_end.cumsum(1) > is_end, end)
    return found, torch.cat(hidden, 1)
