"""How fast a method could be at best: every chunk accepted whole at once, its drafts for nothing
(docs/methods.md §5)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from typing import Any

import pandas as pd

AUTOREGRESSIVE = "ar"


@dataclass(frozen=True)
class Ceiling:
    """What the ceiling of a method is made of: seconds per decode, of which the first three and N are the baseline's.

    A method that verifies inside the prefill is left with its overhead and that one forward, every other method with
    the baseline's prefill and one verification.
    """

    overhead: float  # encoding the observation: the phase vision
    prefill: float
    one_token: float  # T_1, a forward over one token
    tokens: float  # N
    own: float  # the method's prefill with the draft in it, or its verification
    opens: float = 0.0  # 1: verifies inside the prefill
    chunks: float = 1.0  # H of the method / H of the baseline

    @property
    def value(self) -> float:
        """Ratio of times per control step; NaN where a part is missing."""
        baseline = self.overhead + self.prefill + (self.tokens - 1) * self.one_token
        least = self.overhead + (0.0 if self.opens else self.prefill) + self.own
        return self.chunks * baseline / least if least > 0 else math.nan

    def columns(self) -> dict[str, float]:
        """For a row of a table: the ceiling, and its times in milliseconds per decode."""
        times = ("overhead", "prefill", "one_token", "own")
        parts = {f"ceiling_ms.{name}": 1000.0 * getattr(self, name) for name in times}
        return {"ceiling": self.value, "ceiling_tokens": self.tokens, **parts}


NONE = Ceiling(math.nan, math.nan, math.nan, math.nan, math.nan)


def ceiling(episodes: pd.DataFrame, baseline: pd.DataFrame, opens: bool, chunks: float, macro: bool) -> Ceiling:
    """The ceiling of a method's episodes; NaN where nothing was verified or there is no baseline.

    Args:
        episodes: the method's, columns of rows.EPISODE_SCHEMA and `difficulty`.
        baseline: autoregressive decoding's, same columns.
        opens: the method verifies inside the prefill.
        chunks: the method's control steps per chunk over the baseline's.
        macro: take the parts within every difficulty group, then their unweighted means.
    """
    if not macro:
        return _parts(episodes, baseline, opens, chunks)
    groups = [
        _parts(own, baseline[baseline["difficulty"] == name], opens, chunks)
        for name, own in episodes.groupby("difficulty", sort=True)
    ]
    known = [astuple(group) for group in groups if not math.isnan(group.value)]
    return Ceiling(*(sum(values) / len(known) for values in zip(*known, strict=True))) if known else NONE


def _parts(episodes: pd.DataFrame, baseline: pd.DataFrame, opens: bool, chunks: float) -> Ceiling:
    decodes = float(baseline["decodes"].sum())
    prefills = float(episodes["decodes"].sum() - episodes["skipped_decodes"].sum())
    verifications = float(episodes["verifications"].sum())
    if not decodes or not prefills or not verifications:
        return NONE
    one_by_one = float(baseline["forwards"].sum()) - decodes
    one_token = _seconds(baseline, "verify") / one_by_one if one_by_one else 0.0
    if opens:
        own = _seconds(episodes, "prefill") / prefills
    else:
        # the phase also holds the forwards without a draft, e.g. where one token was left: T_1 each
        undrafted = max(0.0, float(episodes["forwards"].sum()) - prefills - verifications)
        own = (_seconds(episodes, "verify") - undrafted * one_token) / verifications
    return Ceiling(
        overhead=_seconds(baseline, "vision") / decodes,
        prefill=_seconds(baseline, "prefill") / decodes,
        one_token=one_token,
        tokens=float(baseline["forwards"].sum()) / decodes,
        own=own if own > 0 else math.nan,
        opens=float(opens),
        chunks=chunks,
    )


def _seconds(episodes: pd.DataFrame, phase: str) -> float:
    return float(episodes[f"seconds.{phase}"].sum())


def is_autoregressive(settings: Mapping[str, Any]) -> bool:
    """Whether a setting decodes token by token, without drafts."""
    return bool(settings["method"] == AUTOREGRESSIVE)


def verifies_in_prefill(settings: Mapping[str, Any]) -> bool:
    """Whether a setting drafts before the prefill."""
    return bool(settings["prefill_draft"]["kind"] != "none")


def chunk_ratio(settings: Mapping[str, Any], baseline: Mapping[str, Any]) -> float:
    """H over the baseline's H; NaN where one of them is left to the target and the other is not."""
    own, other = settings.get("chunk") or 0, baseline.get("chunk") or 0
    if own == other:
        return 1.0
    return own / other if own and other else math.nan
