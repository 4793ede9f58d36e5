"""Compute the highest speedup that a method can reach with measured latencies (docs/methods.md §5)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kerv_cli.base.config import compose, groups
from kerv_cli.base.registry import DRAFTING, part_of
from kerv_cli.engine.cost import Profile
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.settings import EXPERT


@dataclass(frozen=True)
class MethodCeiling:
    """The highest speedup of a method over AR: every draft is accepted completely.

    Attributes:
        method: Name of the method.
        how: The forwards that it still needs, as text.
        free: Speedup if drafting took no time.
        drafted: Speedup with the time of the drafter. The same as `free` if the method uses no drafter.
    """

    method: str
    how: str
    free: float
    drafted: float


def ceilings(profile: Profile, tokens: int) -> list[MethodCeiling]:
    """Return the highest speedup of each method in conf/method. Methods without verification are left out.

    Args:
        profile: Measured latencies of the forwards.
        tokens: N, tokens of a chunk.
    """
    names = [name for name in groups()["method"] if name != EXPERT]
    candidates = (_ceiling(name, profile, tokens) for name in names)
    return [ceiling for ceiling in candidates if ceiling is not None]


def _ceiling(name: str, profile: Profile, tokens: int) -> MethodCeiling | None:
    settings = compose("rollout", [f"method={name}"], RolloutSettings)
    autoregressive, encode = profile.decode(tokens), profile.seconds("encode", 1)
    draft, proposer, skip = (
        part_of(kind, getattr(settings, kind).kind) for kind in ("prefill_draft", "proposer", "skip")
    )
    if skip.traits.get("parallel"):
        speedup = autoregressive / (encode + profile.seconds("prefill", profile.prompt + tokens))
        return MethodCeiling(name, "one forward", speedup, speedup)
    if not skip.traits.get("verifies", True) or (draft.absent and proposer.absent):
        return None
    if not draft.absent:
        least = encode + profile.seconds("prefill", profile.prompt + tokens - 1)
        return MethodCeiling(name, "in the prefill", autoregressive / least, autoregressive / least)
    prefill = encode + profile.seconds("prefill", profile.prompt)
    least = prefill + profile.seconds("verify", tokens - 1)
    free = autoregressive / least
    if proposer.traits.get("cost") != DRAFTING:
        return MethodCeiling(name, "one verification", free, free)
    depth = min(int(getattr(settings.proposer, "depth", tokens)), tokens - 2)
    rounds = math.ceil((tokens - 1) / (depth + 1))  # each round commits the whole chain and one more token
    drafting = profile.seconds(DRAFTING, depth) if depth else 0.0
    decode = prefill + rounds * (profile.seconds("verify", 1 + depth) + drafting)
    return MethodCeiling(name, f"{rounds} × {depth} drafted", free, autoregressive / decode)
