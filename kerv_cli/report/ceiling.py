"""Upper bound of a method's speedup: every chunk accepted whole in one verification, and drafting at no cost
(docs/methods.md §5)."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import pandas as pd

from kerv_cli.base.settings import MODEL
from kerv_cli.lab.identity import Plain


@dataclass(frozen=True)
class Ceiling:
    """The times behind a method's ceiling, in seconds per decode; overhead, prefill, one_token and tokens are those of
    autoregressive decoding.

    At best a method with an in-prefill draft needs the overhead and one forward; every other one the overhead, the
    prefill and one verification.
    """

    overhead: float  # encoding the observation: the phase vision
    prefill: float
    one_token: float  # T_1, a forward over one token
    tokens: float  # N
    forward: float  # the method's prefill with its draft, or its verification
    in_prefill: float = 0.0  # 1: the method has an in-prefill draft
    chunks: float = 1.0  # H of the method / H of the baseline

    @property
    def value(self) -> float:
        """Ratio of times per control step; NaN where a part is missing."""
        baseline = self.overhead + self.prefill + (self.tokens - 1) * self.one_token
        least = self.overhead + (0.0 if self.in_prefill else self.prefill) + self.forward
        return self.chunks * baseline / least if least > 0 else math.nan


NONE = Ceiling(math.nan, math.nan, math.nan, math.nan, math.nan)


def ceiling(episodes: pd.DataFrame, baseline: pd.DataFrame, in_prefill: bool, chunks: float, macro: bool) -> Ceiling:
    """The ceiling of a method's episodes; NaN without verifications or without episodes of the baseline.

    Args:
        episodes: the method's, columns of rows.EPISODE_SCHEMA and `difficulty`.
        baseline: autoregressive decoding's, same columns.
        in_prefill: the method has an in-prefill draft.
        chunks: the method's control steps per chunk over the baseline's.
        macro: compute the times within every difficulty group, then their unweighted means.
    """
    if not macro:
        return _parts(episodes, baseline, in_prefill, chunks)
    ceilings = [
        _parts(group, baseline[baseline["difficulty"] == name], in_prefill, chunks)
        for name, group in episodes.groupby("difficulty", sort=True)
    ]
    rows = [astuple(one) for one in ceilings if not math.isnan(one.value)]
    return Ceiling(*(sum(column) / len(rows) for column in zip(*rows, strict=True))) if rows else NONE


def _parts(episodes: pd.DataFrame, baseline: pd.DataFrame, in_prefill: bool, chunks: float) -> Ceiling:
    decodes = float(baseline["decodes"].sum())
    prefills = float(episodes["decodes"].sum() - episodes["skipped_decodes"].sum())
    verifications = float(episodes["verifications"].sum())
    if not decodes or not prefills or not verifications:
        return NONE
    one_by_one = float(baseline["forwards"].sum()) - decodes
    one_token = _seconds(baseline, "verify") / one_by_one if one_by_one else 0.0
    if in_prefill:
        verification = _seconds(episodes, "prefill") / prefills
    else:
        # `verify` also holds the forwards without a draft, e.g. over the last token of a chunk: one_token each
        undrafted = max(0.0, float(episodes["forwards"].sum()) - prefills - verifications)
        verification = (_seconds(episodes, "verify") - undrafted * one_token) / verifications
    return Ceiling(
        overhead=_seconds(baseline, "vision") / decodes,
        prefill=_seconds(baseline, "prefill") / decodes,
        one_token=one_token,
        tokens=float(baseline["forwards"].sum()) / decodes,
        forward=verification if verification > 0 else math.nan,
        in_prefill=float(in_prefill),
        chunks=chunks,
    )


def _seconds(episodes: pd.DataFrame, phase: str) -> float:
    return float(episodes[f"seconds.{phase}"].sum(skipna=False))  # NaN where an episode was not timed


def is_autoregressive(settings: Plain) -> bool:
    """Whether a setting is a model that decodes token by token: nothing drafts, nothing is skipped."""
    drafts = any(settings[part]["kind"] != "none" for part in ("prefill_draft", "proposer", "skip"))
    return not drafts and settings["policy"]["kind"] == MODEL


def verifies_in_prefill(settings: Plain) -> bool:
    """Whether a setting drafts before the prefill."""
    return bool(settings["prefill_draft"]["kind"] != "none")


def chunk_ratio(settings: Plain, baseline: Plain) -> float:
    """H over the baseline's H; NaN if only one of them is the target's default."""
    steps, baseline_steps = settings["chunk"], baseline["chunk"]
    if steps == baseline_steps:
        return 1.0
    return steps / baseline_steps if steps and baseline_steps else math.nan
