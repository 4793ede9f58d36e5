"""Check that a target behaves as the engine requires. The checks need the target and one observation.

Speculative decoding relies on this: a token's hidden state depends only on the tokens that it attends to, however the
tokens are divided into forwards. `kerv doctor target=NAME` checks a stored target, `check_target` any object.

Shapes: B prompts, P prompt tokens, T tokens, E width, V action tokens.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from kerv_cli.base.spaces import Observation
from kerv_cli.engine.draft import Draft
from kerv_cli.engine.protocol import Cache, Target
from kerv_cli.worlds.findings import Finding, find, need

# largest difference of two logits that rounding can cause, in standard deviations of the logits
TOLERANCE = {torch.float64: 1e-6, torch.float32: 2e-4, torch.bfloat16: 0.2, torch.float16: 0.05}
MEMBERS = ("actions", "chunk", "cameras", "width", "max_prompt", "device")
METHODS = ("encode", "embed", "new_cache", "forward", "head")
TREE = Draft.of([0] * 7, [-1, 0, 0, 1, 1, 2, 4])  # only its shape matters
# hidden states (…, E): as the engine computes them, and as expected up to rounding
Pairs = Iterable[tuple[Tensor, Tensor]]


@torch.inference_mode()
def check_target(target: Target, observation: Observation) -> list[Finding]:
    """Return one finding per check. If a check fails that all later checks need, the later checks are left out.

    The observation's values do not matter.
    """
    trial, findings = Trial(target, observation), []
    for what, fault, check in CHECKS:
        findings.append(find(what, functools.partial(trial.compare, fault, check)))
        if not fault and not findings[-1].ok:
            break
    return findings


class Trial:
    """The checks of one target on one observation.

    A check that fails raises a KervError. Most checks compare hidden states with the result of `plain`, which runs one
    causal forward without a cache.
    """

    def __init__(self, target: Target, observation: Observation) -> None:
        self.target, self.observation = target, observation

    def compare(self, fault: str, check: Callable[[Trial], Pairs | None]) -> str:
        """Compare the logits within each pair that a check yields.

        Differences are in standard deviations of the logits.
        """
        worst = 0.0
        for hidden, expected in check(self) or ():
            a, b = self.target.head(hidden).double(), self.target.head(expected).double()
            gap = float((a - b).abs().max() / b.std().clamp_min(1e-9))
            allowed = gap <= TOLERANCE.get(self.prompt.dtype, 2e-4)
            need(allowed, f"{fault}: logits differ by {gap:.2g} of their spread, rounding explains less")
            worst = max(worst, gap)
        return f"logits within {worst:.1g} of their spread" if worst else "as declared"

    def members(self) -> None:
        missing = [name for name in (*MEMBERS, *METHODS) if not hasattr(self.target, name)]
        need(not missing, f"{type(self.target).__name__} lacks {', '.join(missing)} (kerv_cli/engine/protocol.py)")
        need(not isinstance(self.target.cameras, str), "cameras is a text, must be a tuple of names")
        count = self.target.actions.tokens
        self.tokens = (31 * np.arange(9) % count).tolist()
        self.drafted = ((17 * np.arange(len(TREE)) + 5) % count).tolist()

    def encode(self) -> None:
        prompt, width, longest = self.target.encode(self.observation), self.target.width, self.target.max_prompt
        right = prompt.ndim == 3 and len(prompt) == 1 and prompt.shape[2] == width
        need(right, f"encode gives {tuple(prompt.shape)}, must be (1, P, {width})")
        self.prompt, self.length = prompt, prompt.shape[1]
        need(1 <= self.length <= longest, f"a prompt of {self.length} tokens, max_prompt is {longest}")
        need(torch.isfinite(prompt).all(), "the prompt holds numbers that are not finite")
        same = torch.equal(prompt, self.target.encode(self.observation))
        need(same, "the same observation gives another prompt the second time: a module is in training mode?")

    def embed_and_head(self) -> None:
        width, count, dtype = self.target.width, self.target.actions.tokens, self.prompt.dtype
        embedded = self.embed([0, count - 1])
        right = embedded.shape == (1, 2, width) and embedded.dtype == dtype
        need(right, f"embed gives {tuple(embedded.shape)} {embedded.dtype}, (1, 2, {width}) {dtype} wanted")
        hidden, shape = self.plain(self.tokens), (1, self.length + len(self.tokens), width)
        need(hidden.shape == shape, f"forward of {shape} gives {tuple(hidden.shape)}")
        logits = self.target.head(hidden)
        right = logits.shape == (*shape[:2], count) and bool(torch.isfinite(logits).all())
        need(right, f"head gives {tuple(logits.shape)}, finite (1, T, {count}) are wanted")

    def embed(self, tokens: Sequence[int]) -> Tensor:
        return self.target.embed(torch.tensor([tokens], device=self.prompt.device))

    def with_prompt(self, tokens: Sequence[int]) -> Tensor:
        return torch.cat([self.prompt, self.embed(tokens)], 1) if tokens else self.prompt

    def new_cache(self, batch: int = 1) -> Cache:
        return self.target.new_cache(batch, self.length + len(self.tokens) + len(TREE))

    def append(self, x: Tensor, cache: Cache | None = None) -> Tensor:
        """Return the hidden states (B, T, E) of embeddings (B, T, E), forwarded causally after the cached tokens."""
        first = cache.length if cache is not None else 0
        return self.target.forward(x, torch.arange(first, first + x.shape[1], device=x.device), cache)

    def plain(self, tokens: Sequence[int]) -> Tensor:
        return self.append(self.with_prompt(tokens))

    def path(self, node: int) -> list[int]:
        return [self.drafted[i] for i in TREE.tree.path_to(node)]

    def causality(self) -> Pairs:
        yield self.plain(self.tokens[:4]), self.plain(self.tokens)[:, : self.length + 4]

    def pieces(self) -> Pairs:
        for lengths in ([1] * 6, [1, 5, 3]):
            cache, rest = self.new_cache(), iter(self.tokens)
            self.append(self.prompt, cache)
            hidden = [self.append(self.embed(list(itertools.islice(rest, n))), cache) for n in lengths]
            count = sum(lengths)
            yield torch.cat(hidden, 1), self.plain(self.tokens[:count])[:, -count:]

    def forward_tree(self) -> tuple[Cache, Tensor]:
        """Forward the prompt and two tokens, then a third token and the draft tree of n nodes after it.

        Return the cache, and the hidden states (1, 1 + n, E) of the second forward.
        """
        cache = self.new_cache()
        self.append(self.with_prompt(self.tokens[:2]), cache)
        x, positions = self.embed([self.tokens[2], *self.drafted]), TREE.positions(cache.length, 1, self.prompt.device)
        return cache, self.target.forward(x, positions, cache, TREE.visible(1))

    def draft_tree(self) -> Pairs:
        """Compare each node's hidden state in the tree with a forward of only the node's path.

        The tree is checked twice: after cached tokens, as in a later round of a decode, and in one forward with the
        prompt, as in a prefill that verifies a draft.
        """
        after = self.forward_tree()[1][:, 1:]
        positions, cache = TREE.positions(0, self.length, self.prompt.device), self.new_cache()
        x, seen = self.with_prompt(self.drafted), TREE.visible(self.length)
        inside = self.target.forward(x, positions, cache, seen)[:, self.length :]
        for node in range(len(TREE)):
            yield after[:, node], self.plain([*self.tokens[:3], *self.path(node)])[:, -1]
            yield inside[:, node], self.plain(self.path(node))[:, -1]

    def commit(self) -> Pairs:
        (cache, _), start = self.forward_tree(), self.length + 2
        kept = [start, *(start + 1 + node for node in TREE.tree.path_to(6))]
        cache.compact(start, torch.tensor(kept, device=self.prompt.device))
        need(cache.length == start + len(kept), f"compact leaves length {cache.length}, not {start + len(kept)}")
        last = self.tokens[3]
        yield self.append(self.embed([last]), cache), self.plain([*self.tokens[:3], *self.path(6), last])[:, -1:]

    def reused_cache(self) -> Pairs:
        cache = self.new_cache()
        self.append(self.with_prompt(self.tokens), cache)
        cache.length = 0
        yield self.append(self.prompt, cache), self.plain([])

    def batch(self) -> Pairs:
        prompts = torch.cat([self.prompt, self.prompt.flip(1)])
        for row, prompt in zip(self.append(prompts, self.new_cache(2)), prompts, strict=True):
            yield row[None], self.append(prompt[None])


# name, what is wrong if it fails, function; a check without the text is needed by all later ones
CHECKS: tuple[tuple[str, str, Callable[[Trial], Pairs | None]], ...] = (
    ("members", "", Trial.members),
    ("encode", "", Trial.encode),
    ("embed and head", "", Trial.embed_and_head),
    ("causality", "a token sees later ones", Trial.causality),
    ("cache", "tokens after a cache", Trial.pieces),
    ("tree attention", "a node of a tree sees others than its ancestors", Trial.draft_tree),
    ("commit of a path", "a token after a committed path", Trial.commit),
    ("cache used again", "a reused cache", Trial.reused_cache),
    ("batch", "a batch of two", Trial.batch),
)
