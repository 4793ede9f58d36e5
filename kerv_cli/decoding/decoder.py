"""The one decode loop: propose, verify, accept, commit, rectify (METHODS §2). Methods are compositions of its parts."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from kerv_cli.decoding.acceptance import Rule, acceptance_rule, limits_of
from kerv_cli.decoding.record import PHASES, DecodeRecord, Round
from kerv_cli.decoding.thresholds import Threshold, build_threshold
from kerv_cli.drafting.tree import TokenTree, verify_mask
from kerv_cli.errors import UnknownName
from kerv_cli.settings import MethodSettings
from kerv_cli.vla.action_tokens import GRIPPER, values_of
from kerv_cli.vla.target import Target
from kerv_cli.vla.trunk import Cache


class Clock:
    """Seconds by phase between two synchronised ends."""

    def __init__(self, device: torch.device) -> None:
        self.cuda = device.type == "cuda"
        self.phases = dict.fromkeys(PHASES, 0.0)
        self.began = self.last = self._now()

    def _now(self) -> float:
        if self.cuda:
            torch.cuda.synchronize()
        return time.perf_counter()

    def lap(self, phase: str) -> None:
        """Everything since the last lap belongs to `phase`."""
        now = self._now()
        self.phases[phase] += now - self.last
        self.last = now

    def stop(self) -> float:
        self.lap("other")
        return self.last - self.began


@dataclass
class Chunk:
    """The chunk being decoded. The cache holds the prompt and every committed token but the last."""

    prompt: Tensor  # (1, P, E)
    prompt_hidden: Tensor  # (1, P, E)
    size: int  # N
    cache: Cache
    tokens: list[int] = field(default_factory=list)  # committed
    rounds: list[Round] = field(default_factory=list)
    forwards: int = 0
    biases: list[int] = field(default_factory=list)  # (draft − verdict) of compared positions, as bins
    variability: float = 0.0

    @property
    def left(self) -> int:
        return self.size - len(self.tokens)


class Proposer(Protocol):
    """Drafts a tree behind the committed tokens. `name` goes into the record."""

    name: str

    def begin(self, chunk: Chunk) -> None:
        """The prompt is encoded and token 0 is committed."""

    def propose(self, chunk: Chunk, depth: int) -> TokenTree:
        """A tree of depth ≤ `depth`; an empty one means that nothing is drafted this round."""

    def committed(self, chunk: Chunk, first: int, hidden: Tensor) -> None:
        """Tokens were committed behind chunk index `first`, the last token before them; hidden (1, T, E) are the
        target's states at chunk indices first … first + T − 1."""


class Decoder:
    """A target and the parts of a method. One episode at a time, batch of one.

    decode() times itself: from the observation handed in to the actions handed back, synchronised at both ends.
    """

    def __init__(self, target: Target, method: MethodSettings, proposer: Proposer | None = None) -> None:
        self.target, self.method, self.proposer = target, method, proposer
        if method.rectifier.kind != "reinfer":
            raise UnknownName("rectifier.kind", method.rectifier.kind, ["reinfer"])
        if method.boundary.kind != "always":
            raise UnknownName("boundary.kind", method.boundary.kind, ["always"])
        self.rule: Rule = acceptance_rule(method.acceptance)
        self.threshold: Threshold = build_threshold(method.threshold)
        capacity = target.prompt_length + target.tokens_per_chunk + method.proposer.nodes + 1
        self.cache = target.trunk.new_cache(1, capacity)
        self.words: Tensor | None = None

    @property
    def needs_frame(self) -> bool:
        return self.target.needs_frame

    def reset(self, task: str, instruction: str) -> None:
        """A new episode begins."""
        self.words = self.target.words_of(instruction)
        self.threshold.reset()

    def observe(self, action: np.ndarray, end_effector: np.ndarray) -> None:
        """An action (D,) was executed; the end effector is now at (3,) metres."""

    def finish(self, success: bool) -> None:
        """The episode ended."""

    @torch.inference_mode()
    def decode(self, frame: np.ndarray | None, state: np.ndarray) -> DecodeRecord:
        """frame (s, s, 3) uint8 or None, state (39,) -> the chunk's actions and the record of its decode."""
        assert self.words is not None, "reset() begins an episode"
        target = self.target
        clock = Clock(target.device)
        inputs = target.inputs(frame, state, self.words)
        clock.lap("preprocess")
        prompt, _ = target.encode(inputs)
        clock.lap("vision")
        chunk = self.decode_prompt(prompt, clock)
        actions = target.actions.decode(np.array(chunk.tokens).reshape(-1, target.settings.dofs)).astype(np.float32)
        variability = chunk.variability if any(r.drafted for r in chunk.rounds) else None
        self.threshold.update(variability)
        seconds = clock.stop()
        return DecodeRecord(
            tokens=tuple(chunk.tokens),
            actions=actions,
            forwards=chunk.forwards,
            rounds=tuple(chunk.rounds),
            mode=self.proposer.name if self.proposer is not None else "ar",
            seconds=seconds,
            phases=clock.phases,
            variability=variability,
        )

    @torch.inference_mode()
    def decode_prompt(self, prompt: Tensor, clock: Clock | None = None) -> Chunk:
        """prompt (1, P, E) -> a complete chunk."""
        clock = clock or Clock(prompt.device)
        chunk = self.start(prompt)
        clock.lap("prefill")
        if self.proposer is not None and chunk.left > 1:
            self.proposer.begin(chunk)
            clock.lap("propose")
        while chunk.left:
            self.round(chunk, clock)
        return chunk

    def start(self, prompt: Tensor) -> Chunk:
        """Prefill: the first forward; it commits token 0."""
        hidden = self.target.prefill(prompt, self.cache)
        chunk = Chunk(prompt, hidden, self.target.tokens_per_chunk, self.cache)
        token = int(self.target.head(hidden[:, -1]).argmax())
        chunk.tokens.append(token)
        chunk.forwards = 1
        chunk.rounds.append(Round("prefill", "none", 0, (), (token,), 0, 1, 0, ()))
        return chunk

    def round(self, chunk: Chunk, clock: Clock) -> None:
        """One draft, one forward, one decision. Without a draft it decodes one token."""
        tree = EMPTY
        if self.proposer is not None and chunk.left > 1:
            # one token less than is left: the bonus fills the last place whether or not everything is accepted
            tree = self.proposer.propose(chunk, chunk.left - 1)
            clock.lap("propose")
        hidden, verdicts = self.verify(chunk, tree)
        clock.lap("verify")
        first = len(chunk.tokens) - 1
        path = self.accept(chunk, tree, verdicts)
        clock.lap("accept")
        rows = torch.tensor([0, *(i + 1 for i in path)], device=hidden.device)
        if len(tree):
            chunk.cache.keep(self.target.prompt_length + first, self.target.prompt_length + first + rows)
        if self.proposer is not None and chunk.left > 1:
            self.proposer.committed(chunk, first, hidden[:, rows])
        clock.lap("propose")

    def verify(self, chunk: Chunk, tree: TokenTree) -> tuple[Tensor, list[int]]:
        """Forward [last committed token, tree] -> hidden (1, 1 + n, E) and the argmax behind each of them."""
        device = self.target.device
        at = self.target.prompt_length + len(chunk.tokens) - 1
        tokens = torch.tensor([[chunk.tokens[-1], *tree.tokens]], device=device)
        positions = torch.tensor([at, *(at + 1 + d for d in tree.depths)], device=device)
        mask = verify_mask(tree, chunk.cache.length, chunk.prompt)
        hidden = self.target.step(tokens, positions, chunk.cache, mask)
        chunk.forwards += 1
        return hidden, self.target.head(hidden)[0].argmax(-1).tolist()

    def accept(self, chunk: Chunk, tree: TokenTree, verdicts: Sequence[int]) -> tuple[int, ...]:
        """Commit the best accepted path and the bonus; record the round -> nodes of the path."""
        start, dofs = len(chunk.tokens), self.target.settings.dofs
        if not len(tree):
            chunk.tokens.append(verdicts[0])
            chunk.rounds.append(Round("decode", "none", start, (), (verdicts[0],), 0, 1, 0, ()))
            return ()
        limits = limits_of(self.method.acceptance, self.threshold.radius(), dofs, GRIPPER)
        verdict = self.rule(tree, verdicts, start, limits)
        path = verdict.path
        judged = path if verdict.rejected is None else (*path, verdict.rejected)
        seen = [verdicts[tree.parents[i] + 1] for i in judged]
        drafted = [tree.tokens[i] for i in judged]
        bonus = verdicts[path[-1] + 1 if path else 0]
        chunk.tokens += [tree.tokens[i] for i in path] + [bonus]
        chunk.variability += float(np.abs(values_of(np.array(drafted)) - values_of(np.array(seen))).sum())
        assert self.proposer is not None
        chunk.rounds.append(
            Round(
                mode="verify",
                proposer=self.proposer.name,
                start=start,
                drafted=tuple(drafted),
                verdicts=(*seen, bonus) if verdict.rejected is None else tuple(seen),
                accepted=len(path),
                committed=len(path) + 1,
                tree_size=len(tree),
                threshold=limits,
            )
        )
        return path


EMPTY = TokenTree((), (), ())
