"""Does a target keep the protocol? Checks that need nothing but the target and one observation of its kind.

They are what speculative decoding relies on: a token's hidden state depends on what it sees alone, however the tokens
are cut into forwards. `kerv doctor target=NAME` runs them on a folder, `check_target` on any object.

Shapes: P prompt tokens, T tokens, E width, V action tokens.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.findings import Failed, Finding, run
from kerv_cli.base.spaces import ActionSpace, Observation
from kerv_cli.engine.batched import greedy
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.protocol import Cache, Target

TOLERANCE = {torch.float64: 1e-6, torch.float32: 2e-4, torch.bfloat16: 0.2, torch.float16: 0.05}
"""Largest difference of logits relative to their spread, by number format: products are summed in other orders."""
MEMBERS = ("actions", "chunk", "cameras", "width", "max_prompt", "device")
METHODS = ("encode", "embed", "new_cache", "forward", "head")
TREE = Draft.of([0] * 7, [-1, 0, 0, 1, 1, 2, 4])
"""The shape of a draft tree; its tokens are drawn anew for every check."""


@torch.inference_mode()
def check_target(target: Target, observation: Observation) -> list[Finding]:
    """One finding per check. observation: one that the target can encode."""
    findings = run([("members", lambda: _members(target))])
    if not findings[0].ok:
        return findings
    trial = Trial(target, observation)
    findings += run([("encode", trial.encode), ("embed and head", trial.embed_and_head)])
    if not all(finding.ok for finding in findings):
        return findings
    checks: list[tuple[str, Callable[[], str]]] = [
        ("causality", trial.causality),
        ("cache, token by token", lambda: trial.pieces([1] * 6, "token by token")),
        ("cache, several tokens", lambda: trial.pieces([1, 5, 3], "several tokens")),
        ("tree attention", trial.tree),
        ("commit of a path", trial.commit),
        ("draft in the prefill", trial.prefill_draft),
        ("cache used again", trial.reused_cache),
        ("batch", trial.batch),
        ("greedy chunk", trial.greedy_chunk),
    ]
    return findings + run(checks)


def _members(target: Target) -> str:
    missing = [name for name in (*MEMBERS, *METHODS) if not hasattr(target, name)]
    if missing:
        raise Failed(f"{type(target).__name__} lacks {', '.join(missing)} (kerv_cli/engine/protocol.py)")
    if not isinstance(target.actions, ActionSpace):
        raise Failed(f"actions is {type(target.actions).__name__}, must be an ActionSpace")
    if target.chunk < 1 or target.width < 1 or target.max_prompt < 1:
        raise Failed(f"chunk {target.chunk}, width {target.width}, max_prompt {target.max_prompt}: at least 1 each")
    if isinstance(target.cameras, str):
        raise Failed(f"cameras is the text '{target.cameras}', must be a tuple of names")
    size = target.chunk * target.actions.dofs
    return (
        f"{type(target).__name__}: D={target.actions.dofs}, N={size}, {target.actions.tokens} tokens, E={target.width}"
    )


@dataclass
class Trial:
    """One observation's checks. Every check compares with `plain`: one causal forward without a cache."""

    target: Target
    observation: Observation

    def __post_init__(self) -> None:
        self.worst = 0.0
        self.random = torch.Generator().manual_seed(0)
        size = max(len(TREE), self.target.chunk * self.target.actions.dofs) + 2
        self.capacity = self.target.max_prompt + size + len(TREE)

    def encode(self) -> str:
        """The prompt: shape, length, finite, the same twice."""
        prompt = self.target.encode(self.observation)
        if prompt.ndim != 3 or len(prompt) != 1 or prompt.shape[2] != self.target.width:
            raise Failed(f"encode gives {tuple(prompt.shape)}, must be (1, P, {self.target.width})")
        if not 1 <= prompt.shape[1] <= self.target.max_prompt:
            raise Failed(f"a prompt of {prompt.shape[1]} tokens, max_prompt is {self.target.max_prompt}")
        if not torch.isfinite(prompt).all():
            raise Failed("the prompt holds numbers that are not finite")
        if not torch.equal(prompt, self.target.encode(self.observation)):
            raise Failed("the same observation gives another prompt the second time: a module is in training mode?")
        self.prompt = prompt
        self.tokens = torch.randint(self.target.actions.tokens, (1, 9), generator=self.random).to(prompt.device)
        return f"P={prompt.shape[1]} of at most {self.target.max_prompt}, {str(prompt.dtype).removeprefix('torch.')}"

    def embed_and_head(self) -> str:
        """Shapes and formats of `embed`, `forward` and `head`, for the first and the last token."""
        width, count = self.target.width, self.target.actions.tokens
        tokens = torch.tensor([[0, count - 1]], device=self.prompt.device)
        embedded = self.target.embed(tokens)
        if embedded.shape != (1, 2, width) or embedded.dtype != self.prompt.dtype:
            raise Failed(
                f"embed gives {tuple(embedded.shape)} {embedded.dtype}, (1, 2, {width}) {self.prompt.dtype} wanted"
            )
        hidden = self.plain(self.tokens)
        if hidden.shape != (1, self.prompt.shape[1] + 9, width):
            raise Failed(f"forward of (1, {self.prompt.shape[1] + 9}, {width}) gives {tuple(hidden.shape)}")
        logits = self.target.head(hidden)
        if logits.shape != (*hidden.shape[:-1], count) or not torch.isfinite(logits).all():
            raise Failed(f"head gives {tuple(logits.shape)}, finite (1, T, {count}) are wanted")
        return f"{count} action tokens"

    def plain(self, tokens: Tensor) -> Tensor:
        """Hidden states (1, P + T, E) of prompt and tokens (1, T), forwarded at once without a cache."""
        x = torch.cat([self.prompt, self.target.embed(tokens)], 1) if tokens.shape[1] else self.prompt
        return self.target.forward(x, torch.arange(x.shape[1], device=x.device))

    def compare(self, hidden: Tensor, expected: Tensor, what: str) -> None:
        """Compares hidden states (…, E) by their logits.

        Raises:
            Failed: they differ by more than rounding.
        """
        a, b = self.target.head(hidden).double(), self.target.head(expected).double()
        gap = float((a - b).abs().max() / b.std().clamp_min(1e-9))
        self.worst = max(self.worst, gap)
        if not gap <= TOLERANCE.get(self.prompt.dtype, 2e-4):
            raise Failed(f"{what}: logits differ by {gap:.2g} of their spread, rounding explains less")

    def largest_gap(self) -> str:
        """The largest difference of logits so far, in words."""
        return f"logits within {self.worst:.1g} of their spread"

    def causality(self) -> str:
        """A token must not see what comes after it."""
        length = self.prompt.shape[1]
        whole = self.plain(self.tokens)
        self.compare(self.plain(self.tokens[:, :4])[:, : length + 4], whole[:, : length + 4], "a token sees later ones")
        return self.largest_gap()

    def cached(self, lengths: Sequence[int]) -> tuple[Cache, list[Tensor]]:
        """Prompt, then the tokens in pieces of these lengths -> the cache and the pieces' hidden states."""
        cache, length = self.target.new_cache(1, self.capacity), self.prompt.shape[1]
        if cache.capacity < self.capacity or cache.length:
            raise Failed(f"new_cache(1, {self.capacity}) has capacity {cache.capacity} and length {cache.length}")
        self.target.forward(self.prompt, torch.arange(length, device=self.prompt.device), cache)
        if cache.length != length:
            raise Failed(f"the cache has length {cache.length} after a prompt of {length} tokens")
        hidden, first = [], 0
        for tokens in lengths:
            positions = torch.arange(length + first, length + first + tokens, device=self.prompt.device)
            piece = self.target.embed(self.tokens[:, first : first + tokens])
            hidden.append(self.target.forward(piece, positions, cache))
            first += tokens
        return cache, hidden

    def pieces(self, lengths: Sequence[int], what: str) -> str:
        """Tokens behind a cache, in pieces as decoding and verifying forward them, equal one forward."""
        _, hidden = self.cached(lengths)
        size = sum(lengths)
        self.compare(torch.cat(hidden, 1), self.plain(self.tokens[:, :size])[:, -size:], f"{what} behind a cache")
        return self.largest_gap()

    def draw_tokens(self) -> Tensor:
        """Random tokens (1, n) for the nodes of TREE."""
        drawn = torch.randint(self.target.actions.tokens, (1, len(TREE)), generator=self.random)
        return drawn.to(self.prompt.device)

    def forward_tree(self, cache: Cache) -> tuple[Tensor, Tensor]:
        """Forwards the third token, behind two cached ones, and a tree behind it -> the tree's tokens (1, n), hidden
        (1, 1 + n, E)."""
        drafted = self.draw_tokens()
        positions = TREE.positions(self.prompt.shape[1] + 2, 1, self.prompt.device)
        x = self.target.embed(torch.cat([self.tokens[:, 2:3], drafted], 1))
        return drafted, self.target.forward(x, positions, cache, TREE.visible(1))

    def tree(self) -> str:
        """Every node of a tree equals the last token of its own path, forwarded alone."""
        cache, _ = self.cached([1, 1])
        drafted, hidden = self.forward_tree(cache)
        for node in range(len(TREE)):
            tokens = torch.cat([self.tokens[:, :3], drafted[:, TREE.tree.path_to(node)]], 1)
            self.compare(
                hidden[:, node + 1], self.plain(tokens)[:, -1], f"node {node} of a tree sees others than its ancestors"
            )
        return self.largest_gap()

    def commit(self) -> str:
        """Decoding goes on behind a committed path."""
        cache, _ = self.cached([1, 1])
        drafted, _ = self.forward_tree(cache)
        path = TREE.tree.path_to(6)
        start = self.prompt.shape[1] + 2
        slots = torch.tensor([start, *(start + 1 + node for node in path)], device=self.prompt.device)
        cache.compact(start, slots)
        if cache.length != start + 1 + len(path):
            raise Failed(f"compact({start}, {len(slots)} slots) leaves length {cache.length}, not {start + len(slots)}")
        position = torch.tensor([cache.length], device=self.prompt.device)
        hidden = self.target.forward(self.target.embed(self.tokens[:, 3:4]), position, cache)
        tokens = torch.cat([self.tokens[:, :3], drafted[:, path], self.tokens[:, 3:4]], 1)
        self.compare(hidden, self.plain(tokens)[:, -1:], "a token behind a committed path")
        return self.largest_gap()

    def prefill_draft(self) -> str:
        """Prompt and a tree in one forward, as methods that draft before the prefill do."""
        length, drafted = self.prompt.shape[1], self.draw_tokens()
        visible = TREE.visible(length)
        positions = TREE.positions(0, length, self.prompt.device)
        x = torch.cat([self.prompt, self.target.embed(drafted)], 1)
        hidden = self.target.forward(x, positions, self.target.new_cache(1, self.capacity), visible)
        for node in (1, 3, 6):
            expected = self.plain(drafted[:, TREE.tree.path_to(node)])[:, -1]
            self.compare(hidden[:, length + node], expected, f"node {node} of a tree in the prefill")
        return self.largest_gap()

    def reused_cache(self) -> str:
        """A cache that is set back to length 0 holds nothing of before."""
        cache, _ = self.cached([5])
        cache.length = 0
        positions = torch.arange(self.prompt.shape[1], device=self.prompt.device)
        self.compare(
            self.target.forward(self.prompt, positions, cache), self.plain(self.tokens[:, :0]), "a reused cache"
        )
        return self.largest_gap()

    def batch(self) -> str:
        """Two prompts at once, as training a drafter does."""
        prompts = torch.cat([self.prompt, self.prompt.flip(1)])
        positions = torch.arange(prompts.shape[1], device=prompts.device)
        hidden = self.target.forward(prompts, positions, self.target.new_cache(2, self.capacity))
        for row in range(2):
            self.compare(
                hidden[row : row + 1], self.target.forward(prompts[row : row + 1], positions), "a batch of two"
            )
        return self.largest_gap()

    def greedy_chunk(self) -> str:
        """Greedy decoding with a cache gives the tokens of greedy decoding without."""
        size, device = self.target.chunk * self.target.actions.dofs, self.prompt.device
        tokens = torch.zeros(1, 0, dtype=torch.long, device=device)
        for _ in range(size):
            tokens = torch.cat([tokens, self.target.head(self.plain(tokens)[:, -1]).argmax(-1)[None]], 1)
        decoded = greedy(self.target, self.prompt, self.target.new_cache(1, self.capacity))[0][0].tolist()
        if decoded != tokens[0].tolist() and self.prompt.dtype in (torch.float32, torch.float64):
            raise Failed(f"greedy decoding gives {decoded} with a cache and {tokens[0].tolist()} without")
        values = self.target.actions.decode(np.array(decoded).reshape(-1, self.target.actions.dofs))
        return f"{size} tokens, the first action {np.array2string(values[0], precision=3)}"
