"""A tree of the tokens near the last action and near its continuation (docs/methods.md §5.2, ours)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from kerv_cli.base.limits import MOST_TOKENS, number
from kerv_cli.base.registry import PREFILL, ProposerPart
from kerv_cli.engine.proposer import Proposer

if TYPE_CHECKING:
    import numpy as np

    from kerv_cli.engine.chunk import Chunk
    from kerv_cli.engine.draft import Draft

DECAY = 0.8  # factor by which the weight of an error falls with every later action
CAP, FLOOR = 4.0, 0.1  # bins: largest error that counts, smallest scale
FIRST = 0.5  # weight of the scale 1 to begin with
SHARE = 0.1  # share of the trust that is split equally between both guesses, however wrong they were
WIDTH = 16  # tokens that are considered at each place


@dataclass
class NearProposerSettings:
    """Draft the most probable tokens around the last action and around a line through the last two (§5.2, ours)."""

    kind: str = "near"
    nodes: int = number(48, 1, MOST_TOKENS)  # size of the tree


@ProposerPart("near", NearProposerSettings, colour=0x1B7837, when=PREFILL)
class NearProposer(Proposer):
    """Drafts a tree around two guesses: *hold* repeats the last action, *line* continues the last two.

    The tree is wider where the guesses were wrong for the last actions.
    """

    name = "near"

    def __init__(self, settings: Any = None, context: Any = None) -> None:
        super().__init__(settings or NearProposerSettings(), context)
        self.nodes = self.settings.nodes

    def propose(self, chunk: Chunk, depth: int) -> Draft:
        import numpy as np

        from kerv_cli.engine.draft import EMPTY, Draft

        space, dofs, committed = chunk.space, chunk.space.dofs, len(chunk.tokens)
        done = committed // dofs
        planned = space.bins_of(np.array(chunk.episode.planned[done : chunk.steps]).reshape(-1, dofs))
        past = space.bins_of(chunk.history())
        if not len(past):
            past = planned[:1]
        if not len(past):
            return EMPTY
        guesses, scales, weights = expected(past, chunk.steps - done)
        if len(planned):  # the target has decoded these steps before
            guesses[0, : len(planned)], guesses[0, len(planned) :] = planned, planned[-1]
        table = probabilities(guesses.reshape(2, -1), scales.reshape(2, -1), space.tokens)
        for place, token in enumerate(chunk.tokens[done * dofs :]):
            weights = weights * table[:, place, token]
        begin = committed - done * dofs
        return Draft.of(*likely_tree(table[:, begin : begin + depth], weights / weights.sum(), self.nodes))


def expected(past: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Guess the next actions from the past actions (m, D). Actions and errors are in bins.

    Returns the guesses *hold* and *line* (2, steps, D), the mean errors of such guesses so far (2, steps, D), and the
    trust in each guess (2,), which sums to 1.
    """
    import numpy as np

    speed = np.diff(past, axis=0, prepend=past[:1])
    last = len(past) - 1
    guesses = np.empty((2, steps, past.shape[1]))
    scales = np.ones_like(guesses)
    trust = np.zeros(2)
    for step in range(1, steps + 1):
        made = np.stack([past, past + step * speed])  # (2, m, D): what would have been guessed after each action
        guesses[:, step - 1] = made[:, last]
        if step > last:
            continue
        errors = np.abs(made[:, : last + 1 - step] - past[step:])
        kept = DECAY ** np.arange(errors.shape[1] - 1, -1, -1)
        total = FIRST + np.tensordot(np.minimum(errors, CAP), kept, ([1], [0]))
        scales[:, step - 1] = np.maximum(FLOOR, total / (FIRST + kept.sum()))
        if step == 1:
            ratio = scales[:, :1] / (1 + scales[:, :1])
            found = np.log((1 - ratio) / (1 + ratio) * ratio**errors + 1e-4).sum(2)
            trust = (found * kept).sum(1)
    trust = np.exp(trust - trust.max())
    return guesses, scales, (1 - SHARE) * trust / trust.sum() + SHARE / 2


def probabilities(guesses: np.ndarray, scales: np.ndarray, vocabulary: int) -> np.ndarray:
    """Return the probability (2, N, V) of each token under each guess.

    The distribution around a guess (2, N) is two-sided geometric. Its mean error grows with the scale (2, N), in bins.
    """
    import numpy as np

    ratio = scales / (1 + scales)
    away = np.abs(np.arange(vocabulary) - np.clip(guesses, 0, vocabulary - 1)[..., None])
    return ((1 - ratio) / (1 + ratio))[..., None] * ratio[..., None] ** away + 1e-9


def likely_tree(table: np.ndarray, weights: np.ndarray, nodes: int) -> tuple[list[int], list[int]]:
    """Return the tokens and the parents (−1: the root) of the draft tree's `nodes` most probable nodes.

    Args:
        table: Probability of each token at each place of the draft, under each of two guesses, (2, places, V).
        weights: Trust in each guess, (2,). Along a path, trust shifts to the guess that made its tokens more probable.
    """
    import numpy as np

    tokens, parents = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    chances, paths, first = [np.zeros(0)], weights[None], -1  # paths (n, 2): probability of n prefixes and each guess
    width = min(WIDTH, table.shape[2])
    best = np.argpartition(-table.max(0), width - 1)[:, :width]
    for place, candidates in enumerate(best):
        likely = table[:, place, candidates]
        joint = (paths @ likely).ravel()
        kept = np.argsort(-joint, kind="stable")[:nodes]
        before, which = np.divmod(kept, width)
        tokens.append(candidates[which])
        parents.append(before + first)
        chances.append(joint[kept])
        first = first + len(paths)
        paths = paths[before] * likely[:, which].T
    # a prefix is less probable than its beginning, so what is kept is a tree
    chosen = np.sort(np.argsort(-np.concatenate(chances), kind="stable")[:nodes])
    places = np.full(sum(map(len, chances)) + 1, -1)
    places[chosen] = np.arange(len(chosen))
    return np.concatenate(tokens)[chosen].tolist(), places[np.concatenate(parents)[chosen]].tolist()
