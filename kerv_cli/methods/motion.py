"""Accept FAST tokens, and stop decoding, by the motion that the tokens stand for (*ours*; docs/methods.md §6)."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import MOST_TOKENS, number
from kerv_cli.base.registry import AcceptancePart, BoundaryPart
from kerv_cli.engine.acceptance import Accepted, DistanceRule, nearest_child
from kerv_cli.engine.decisions import ROOT, Choice, TokenTree
from kerv_cli.engine.parts import Boundary

if TYPE_CHECKING:
    import numpy as np

    from kerv_cli.base.codes import FastCode
    from kerv_cli.methods.context import Context


def code_of(context: Context, part: str) -> FastCode:
    code = context.target.actions.code
    if code is None:
        raise UsageError(f"{part}: this target's tokens are bins; it is for a target with target.code=fast")
    return code


@dataclass
class MotionAcceptanceSettings:
    """Accept a draft token if the chunk's motion is nearly the same as with the target's token."""

    kind: str = "motion"
    tolerance: float = number(0.1, 0, 2)  # largest difference of an action in the chunk, normalised units


@AcceptancePart("motion", MotionAcceptanceSettings, reads_threshold=False, any_code=True)
@dataclass(frozen=True)
class MotionRule(DistanceRule):
    """Accepts a draft token if the chunk's motion is nearly the same as with the target's token.

    FAST tokens stand for frequency coefficients of the chunk's motion. Two motions are compared: that of the accepted
    tokens and the draft token, and that of the accepted tokens and the target's token, with all missing coefficients
    zero. They may differ by at most `tolerance` in every action. The draft token may not give more coefficients than
    the target's token, and may end the chunk only if the target's token ends it.
    """

    tolerance: float

    @classmethod
    def build(cls, settings: Any, context: Context) -> MotionRule:
        code_of(context, "acceptance=motion")
        return cls(context.target.actions, settings.tolerance)

    @property
    def code(self) -> FastCode:
        assert self.space.code is not None
        return self.space.code

    @functools.cached_property
    def basis(self) -> np.ndarray:
        """(H · D, H · D) float64. Row i is the flattened motion if coefficient i is 1 and every other one is 0."""
        import numpy as np

        unit = np.eye(self.code.steps * self.code.dofs)
        return self.code.motions(unit).reshape(unit.shape)

    def limits(self, r: int) -> tuple[int, ...]:
        return (0,)

    def difference(self, before: Sequence[int], token: int, other: int) -> float:
        """Return the largest change of a normalised action if `other`, not `token`, follows the tokens `before`."""
        import numpy as np

        start = len(self.code.decode(before))
        gap = np.zeros(len(self.basis) - start)
        for sign, one in ((1, token), (-1, other)):
            part = self.code.parts[one][: len(gap)]
            gap[: len(part)] += sign * np.array(part, dtype=float)
        return float(np.abs(gap @ self.basis[start:]).max(initial=0.0))

    def judge_after(self, tokens: Sequence[int], tree: TokenTree, target_tokens: Sequence[int], r: int) -> Accepted:
        paths: dict[int, list[int]] = {ROOT: list(tokens)}  # tokens of the chunk up to each accepted node
        best = ROOT
        for node, (token, parent) in enumerate(zip(tree.tokens, tree.parents, strict=True)):
            before, target = paths.get(parent), target_tokens[parent + 1]
            if before is None or self.space.end in before:
                continue
            decides_more = len(self.code.parts[token]) > len(self.code.parts[target])
            ends_early = target != self.code.end and (token == self.code.end or decides_more)
            if token == target or (not ends_early and self.difference(before, token, target) <= self.tolerance):
                paths[node] = [*before, token]
                best = node if len(paths[node]) > len(paths[best]) else best
        return Accepted(tuple(tree.path_to(best)), nearest_child(tree, best, target_tokens))


@dataclass
class CoarseBoundarySettings:
    """Decode only the first `tokens` tokens of a chunk. They give a coarse motion: FAST codes low frequencies first."""

    kind: str = "coarse"
    tokens: int = number(4, 1, MOST_TOKENS)  # largest number of tokens


@BoundaryPart("coarse", CoarseBoundarySettings, any_code=True)
class Coarse(Boundary):
    """Ends every chunk after at most `tokens` FAST tokens. Coefficients of higher frequencies count as zero."""

    @classmethod
    def build(cls, settings: Any, context: Context) -> Coarse:
        code_of(context, "boundary=coarse")
        return cls(settings, context)

    def choose(self, path: np.ndarray) -> Choice:
        return Choice("drafter", most=self.settings.tokens)
