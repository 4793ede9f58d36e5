"""Check that a target behaves as the engine requires. The checks need the target and one observation.

Speculative decoding relies on this: a token's hidden state depends only on the tokens that it attends to, however the
tokens are divided into forwards. `kerv doctor target=NAME` checks a stored target, `check_target` any object.

Shapes: P prompt tokens, T tokens, E width, V action tokens.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.batched import greedy
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.protocol import Cache, Target
from kerv_cli.worlds.findings import Finding, find, need

TOLERANCE = {torch.float64: 1e-6, torch.float32: 2e-4, torch.bfloat16: 0.2, torch.float16: 0.05}
"""Number format -> largest allowed difference of logits, in units of their standard deviation. A difference of this
size can come from rounding."""
MEMBERS = ("actions", "chunk", "cameras", "width", "max_prompt", "device")
METHODS = ("encode", "embed", "new_cache", "forward", "head")
TREE = Draft.of([0] * 7, [-1, 0, 0, 1, 1, 2, 4])
"""A draft tree, of which only the shape is used. Checks draw random tokens for its nodes."""
Pairs = Iterable[tuple[Tensor, Tensor]]
"""Pairs of hidden states (…, E): computed as the engine does it, and as expected. Their logits must be equal."""


@torch.inference_mode()
def check_target(target: Target, observation: Observation) -> list[Finding]:
    """Run all checks, and return one finding per check.

    Args:
        target: The target.
        observation: An observation that the target can encode. Its values do not matter.
    """
    trial, findings = Trial(target, observation), []
    for what, fault, check in CHECKS:
        findings.append(find(what, functools.partial(trial.compare, fault, check)))
        if not fault and not findings[-1].ok:
            break
    return findings


class Trial:
    """The checks of one target on one observation.

    Most of them compare the result of a computation with that of `plain`, one causal forward without a cache.
    """

    def __init__(self, target: Target, observation: Observation) -> None:
        self.target, self.observation = target, observation
        self.random = torch.Generator().manual_seed(0)

    def compare(self, fault: str, check: Callable[[Trial], Pairs]) -> str:
        """Run a check and compare the logits of its pairs.

        Args:
            fault: What is wrong if they differ, text for the error message.
            check: The check.

        Returns:
            The largest difference, as text.
        """
        worst = 0.0
        for hidden, expected in check(self):
            a, b = self.target.head(hidden).double(), self.target.head(expected).double()
            gap = float((a - b).abs().max() / b.std().clamp_min(1e-9))
            allowed = gap <= TOLERANCE.get(self.prompt.dtype, 2e-4)
            need(allowed, f"{fault}: logits differ by {gap:.2g} of their spread, rounding explains less")
            worst = max(worst, gap)
        return f"logits within {worst:.1g} of their spread" if worst else "as declared"

    def members(self) -> Pairs:
        """Check that the target has all required attributes and methods."""
        missing = [name for name in (*MEMBERS, *METHODS) if not hasattr(self.target, name)]
        need(not missing, f"{type(self.target).__name__} lacks {', '.join(missing)} (kerv_cli/engine/protocol.py)")
        need(not isinstance(self.target.cameras, str), "cameras is a text, must be a tuple of names")
        self.size = self.target.chunk * self.target.actions.dofs
        self.capacity = self.target.max_prompt + max(len(TREE), self.size) + 2 + len(TREE)
        return ()

    def encode(self) -> Pairs:
        """Check that a prompt has the right shape and finite numbers, and is the same when encoded again."""
        prompt, width, longest = self.target.encode(self.observation), self.target.width, self.target.max_prompt
        right = prompt.ndim == 3 and len(prompt) == 1 and prompt.shape[2] == width
        need(right, f"encode gives {tuple(prompt.shape)}, must be (1, P, {width})")
        self.prompt, self.length = prompt, prompt.shape[1]
        need(1 <= self.length <= longest, f"a prompt of {self.length} tokens, max_prompt is {longest}")
        need(torch.isfinite(prompt).all(), "the prompt holds numbers that are not finite")
        same = torch.equal(prompt, self.target.encode(self.observation))
        need(same, "the same observation gives another prompt the second time: a module is in training mode?")
        self.tokens = self.draw(9)
        return ()

    def embed_and_head(self) -> Pairs:
        """Check the shapes and number formats that `embed`, `forward` and `head` return."""
        width, count, dtype = self.target.width, self.target.actions.tokens, self.prompt.dtype
        embedded = self.target.embed(torch.tensor([[0, count - 1]], device=self.prompt.device))
        right = embedded.shape == (1, 2, width) and embedded.dtype == dtype
        need(right, f"embed gives {tuple(embedded.shape)} {embedded.dtype}, (1, 2, {width}) {dtype} wanted")
        hidden, shape = self.plain(self.tokens), (1, self.length + 9, width)
        need(hidden.shape == shape, f"forward of {shape} gives {tuple(hidden.shape)}")
        logits = self.target.head(hidden)
        right = logits.shape == (*shape[:2], count) and bool(torch.isfinite(logits).all())
        need(right, f"head gives {tuple(logits.shape)}, finite (1, T, {count}) are wanted")
        return ()

    def draw(self, count: int) -> Tensor:
        """Return random tokens (1, count)."""
        return torch.randint(self.target.actions.tokens, (1, count), generator=self.random).to(self.prompt.device)

    def positions(self, first: int, count: int) -> Tensor:
        """Return the positions first, first + 1, … (count,)."""
        return torch.arange(first, first + count, device=self.prompt.device)

    def plain(self, tokens: Tensor) -> Tensor:
        """Return the hidden states (1, P + T, E) of the prompt and tokens (1, T), in one forward without a cache."""
        x = torch.cat([self.prompt, self.target.embed(tokens)], 1) if tokens.shape[1] else self.prompt
        return self.target.forward(x, self.positions(0, x.shape[1]))

    def causality(self) -> Pairs:
        """Check that a token's hidden state does not depend on later tokens."""
        yield self.plain(self.tokens[:, :4]), self.plain(self.tokens)[:, : self.length + 4]

    def cached(self, lengths: Sequence[int]) -> tuple[Cache, Tensor]:
        """Forward the prompt with a cache, then the tokens in several forwards.

        Args:
            lengths: Number of tokens in each forward.

        Returns:
            The cache, and the hidden states (1, T, E) of the tokens.
        """
        cache, first, hidden = self.target.new_cache(1, self.capacity), self.length, []
        self.target.forward(self.prompt, self.positions(0, first), cache)
        need(cache.length == first, f"the cache has length {cache.length} after a prompt of {first} tokens")
        for tokens in self.tokens[:, : sum(lengths)].split(list(lengths), 1):
            positions = self.positions(first, tokens.shape[1])
            hidden.append(self.target.forward(self.target.embed(tokens), positions, cache))
            first += tokens.shape[1]
        return cache, torch.cat(hidden, 1)

    def pieces(self, *lengths: int) -> Pairs:
        """Check that tokens in several forwards with a cache have the same hidden states as in one forward.

        Args:
            lengths: Number of tokens in each forward.
        """
        size = sum(lengths)
        yield self.cached(lengths)[1], self.plain(self.tokens[:, :size])[:, -size:]

    def forward_tree(self) -> tuple[Cache, Tensor, Tensor]:
        """Forward a token and a draft tree after it in one forward, after two cached tokens.

        Returns:
            The cache; the random tokens (1, n) of the tree; the hidden states (1, 1 + n, E) of token and tree.
        """
        (cache, _), drafted = self.cached([1, 1]), self.draw(len(TREE))
        x = self.target.embed(torch.cat([self.tokens[:, 2:3], drafted], 1))
        positions = TREE.positions(self.length + 2, 1, self.prompt.device)
        return cache, drafted, self.target.forward(x, positions, cache, TREE.visible(1))

    def tree(self) -> Pairs:
        """Check that a node of a draft tree has the same hidden state as in a forward of only its own path."""
        _, drafted, hidden = self.forward_tree()
        for node in range(len(TREE)):
            tokens = torch.cat([self.tokens[:, :3], drafted[:, TREE.tree.path_to(node)]], 1)
            yield hidden[:, node + 1], self.plain(tokens)[:, -1]

    def commit(self) -> Pairs:
        """Check that decoding can continue after the cache has kept only the accepted path of a tree."""
        (cache, drafted, _), path, start = self.forward_tree(), TREE.tree.path_to(6), self.length + 2
        cache.compact(start, torch.tensor([start, *(start + 1 + node for node in path)], device=self.prompt.device))
        length = start + 1 + len(path)
        need(cache.length == length, f"compact leaves length {cache.length}, not {length}")
        last = self.tokens[:, 3:4]
        hidden = self.target.forward(self.target.embed(last), self.positions(length, 1), cache)
        yield hidden, self.plain(torch.cat([self.tokens[:, :3], drafted[:, path], last], 1))[:, -1:]

    def prefill_draft(self) -> Pairs:
        """Check a forward of prompt and draft tree together, as methods do that draft before the prefill."""
        drafted, positions = self.draw(len(TREE)), TREE.positions(0, self.length, self.prompt.device)
        x, cache = torch.cat([self.prompt, self.target.embed(drafted)], 1), self.target.new_cache(1, self.capacity)
        hidden = self.target.forward(x, positions, cache, TREE.visible(self.length))
        for node in (1, 3, 6):
            yield hidden[:, self.length + node], self.plain(drafted[:, TREE.tree.path_to(node)])[:, -1]

    def reused_cache(self) -> Pairs:
        """Check that nothing of its earlier content is left in a cache after its length is set to 0."""
        cache, _ = self.cached([5])
        cache.length = 0
        yield self.target.forward(self.prompt, self.positions(0, self.length), cache), self.plain(self.tokens[:, :0])

    def batch(self) -> Pairs:
        """Check that two prompts in one batch give the same hidden states as each alone."""
        prompts, positions = torch.cat([self.prompt, self.prompt.flip(1)]), self.positions(0, self.length)
        hidden = self.target.forward(prompts, positions, self.target.new_cache(2, self.capacity))
        for row, prompt in zip(hidden, prompts, strict=True):
            yield row[None], self.target.forward(prompt[None], positions)

    def greedy_chunk(self) -> Pairs:
        """Check that greedy decoding gives the same tokens with and without a cache."""
        tokens = self.tokens[:, :0]
        for _ in range(self.size):
            tokens = torch.cat([tokens, self.target.head(self.plain(tokens)[:, -1]).argmax(-1)[None]], 1)
        decoded = greedy(self.target, self.prompt, self.target.new_cache(1, self.capacity))[0][0].tolist()
        same = decoded == tokens[0].tolist() or self.prompt.dtype not in (torch.float32, torch.float64)
        need(same, f"greedy decoding gives {decoded} with a cache and {tokens[0].tolist()} without")
        return ()


CHECKS: tuple[tuple[str, str, Callable[[Trial], Pairs]], ...] = (
    ("members", "", Trial.members),
    ("encode", "", Trial.encode),
    ("embed and head", "", Trial.embed_and_head),
    ("causality", "a token sees later ones", Trial.causality),
    ("cache, token by token", "token by token after a cache", lambda trial: trial.pieces(1, 1, 1, 1, 1, 1)),
    ("cache, several tokens", "several tokens after a cache", lambda trial: trial.pieces(1, 5, 3)),
    ("tree attention", "a node of a tree sees others than its ancestors", Trial.tree),
    ("commit of a path", "a token after a committed path", Trial.commit),
    ("draft in the prefill", "a node of a tree in the prefill", Trial.prefill_draft),
    ("cache used again", "a reused cache", Trial.reused_cache),
    ("batch", "a batch of two", Trial.batch),
    ("greedy chunk", "the chunk", Trial.greedy_chunk),
)
"""The checks in order: name, what is wrong if it fails, function. If the second is empty, all later checks need this
one, and a failure ends the checks."""
