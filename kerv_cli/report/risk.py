"""Scores against each other: risk over coverage of a recording, and the levels that it certifies (docs/methods.md
§4.6)."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib as mpl
import numpy as np
from scipy.stats import rankdata

from kerv_cli.base.files import atomic_path
from kerv_cli.methods.risk.recording import Losses, RiskRecording, certify, episode_means
from kerv_cli.report.drawing import COLOURS, DASHES, MUTED, STYLE, colour, entitle, figure_bytes, new_figure

REPEATS = 200
BAD = 0.5  # a draft with a larger loss is one that should have been verified


def coverage(scores: np.ndarray, losses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(shares, risks), both (n,): the mean loss of the share of decodes with the largest scores; equal scores in the
    order of the recording."""
    order = np.argsort(-scores, kind="stable")
    count = np.arange(1, len(order) + 1)
    return count / len(order), np.cumsum(losses[order]) / count


def auc(scores: np.ndarray, bad: np.ndarray) -> float:
    """Probability that a bad draft scores below a good one, ties counting half; NaN where all are alike."""
    below = int(bad.sum())
    above = len(bad) - below
    if not below or not above:
        return math.nan
    ranks = rankdata(scores)
    return float(1 - (ranks[bad].sum() - below * (below + 1) / 2) / (below * above))


def held(found: Losses, score: str, epsilon: float, delta: float, repeats: int = REPEATS) -> float:
    """Share of repeated calibrations, each on as many episodes drawn with replacement, whose level has a risk of at
    most ε over all recorded episodes; a calibration that certifies nothing holds."""
    count, scores, kept = int(found.episodes.max()) + 1, found.scores[score], 0
    decodes = [np.flatnonzero(found.episodes == number) for number in range(count)]
    random = np.random.default_rng(0)
    for _ in range(repeats):
        drawn = [decodes[number] for number in random.integers(0, count, count)]
        rows, numbers = np.concatenate(drawn), np.repeat(np.arange(count), [len(own) for own in drawn])
        level = certify(scores[rows], found.losses[rows], numbers, epsilon, delta).level
        trusted = scores >= level
        kept += not trusted.any() or episode_means(trusted, found.losses, found.episodes).mean() <= epsilon
    return kept / repeats


def coverage_table(recording: RiskRecording, epsilon: float, delta: float) -> list[tuple[str, ...]]:
    """A row per source and score: level, trusted share, risk, p, how often repeated calibrations hold, AUC, episodes;
    `-` where nothing is certified."""
    rows: list[tuple[str, ...]] = []
    for source in recording.manifest.sources:
        found = recording.losses(source)
        for name, scores in found.scores.items():
            result = recording.certified(source, name, epsilon, delta)
            certain = (f"{result.level:.4g}", f"{result.share:.1%}", f"{result.risk:.4f}")
            figures = certain if math.isfinite(result.level) else ("-", "0%", "-")
            rest = (f"{result.p:.3g}", f"{held(found, name, epsilon, delta):.1%}")
            discriminates = f"{auc(scores, found.losses > BAD):.3f}"
            rows.append((source, name, *figures, *rest, discriminates, str(result.episodes)))
    return rows


def plot_coverage(recording: RiskRecording, path: Path) -> Path:
    """Draws risk over coverage, a panel per source and a line per score -> `path`.

    Raises:
        StorageError: the disk refused.
    """
    sources = list(recording.manifest.sources)
    with mpl.rc_context(STYLE):
        figure = new_figure(5.6 * len(sources) + 2.4, 4.6)
        for panel, source in zip(figure.subplots(1, len(sources), squeeze=False).ravel(), sources, strict=True):
            found = recording.losses(source)
            for place, (name, scores) in enumerate(found.scores.items()):
                share, risk = coverage(scores, found.losses)
                panel.plot(
                    100 * share,
                    risk,
                    color=colour(place),
                    linestyle="-" if place < len(COLOURS) else DASHES[0],
                    linewidth=1.8,
                    label=name,
                )
            best = coverage(-found.losses, found.losses)
            panel.plot(100 * best[0], best[1], color=MUTED, linewidth=1.0, linestyle=":", label="by the loss itself")
            panel.set(
                title=f"drafts of {source}",
                xlabel="drafts trusted, %",
                ylabel="mean loss of the trusted",
                ylim=(0, None),
            )
        figure.axes[-1].legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        episodes = sum(len(seeds) for seeds in recording.manifest.tasks.values())
        entitle(figure, "Risk over coverage", f"{episodes} episodes on selection seeds; lower is better")
        content = figure_bytes(figure, "png")
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return path
