"""Scores against each other: risk over coverage of a recording, and the levels that it certifies (docs/methods.md
§4.6)."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib as mpl
import numpy as np

from kerv_cli.base.files import atomic_path
from kerv_cli.engine.loss import BAD, auc
from kerv_cli.methods.risk.recording import Losses, RiskRecording, certify, episode_means
from kerv_cli.report.drawing import COLOURS, DASHES, MUTED, STYLE, colour, entitle, figure_bytes, new_figure

REPEATS = 200


def coverage(scores: np.ndarray, losses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Risk over coverage of n decodes: (shares, risks), both (n,). Entry i is of the i + 1 decodes with the largest
    scores, their share of all decodes and their mean loss; equal scores keep the order of the recording."""
    order = np.argsort(-scores, kind="stable")
    count = np.arange(1, len(order) + 1)
    return count / len(order), np.cumsum(losses[order]) / count


def valid_share(drafts: Losses, score: str, epsilon: float, delta: float, repeats: int = REPEATS) -> float:
    """Share of repeated calibrations whose level has a risk of at most ε over all recorded episodes. Each calibration
    draws as many episodes with replacement; one that certifies nothing is valid."""
    count, scores, valid = int(drafts.episodes.max()) + 1, drafts.scores[score], 0
    decodes = [np.flatnonzero(drafts.episodes == number) for number in range(count)]
    random = np.random.default_rng(0)
    for _ in range(repeats):
        drawn = [decodes[number] for number in random.integers(0, count, count)]
        rows, numbers = np.concatenate(drawn), np.repeat(np.arange(count), [len(part) for part in drawn])
        level = certify(scores[rows], drafts.losses[rows], numbers, epsilon, delta).level
        trusted = scores >= level
        valid += not trusted.any() or episode_means(trusted, drafts.losses, drafts.episodes).mean() <= epsilon
    return valid / repeats


def coverage_table(recording: RiskRecording, epsilon: float, delta: float) -> list[tuple[str, ...]]:
    """A row per source and score: level, trusted share, risk, p, share of valid repeated calibrations, AUC, episodes;
    `-` where nothing is certified."""
    rows: list[tuple[str, ...]] = []
    for source in recording.manifest.sources:
        drafts = recording.losses(source)
        for name, scores in drafts.scores.items():
            result = recording.certified(source, name, epsilon, delta)
            certain = (f"{result.level:.4g}", f"{result.share:.1%}", f"{result.risk:.4f}")
            figures = certain if math.isfinite(result.level) else ("-", "0%", "-")
            rest = (f"{result.p:.3g}", f"{valid_share(drafts, name, epsilon, delta):.1%}")
            discriminates = f"{auc(scores, drafts.losses > BAD):.3f}"
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
            drafts = recording.losses(source)
            for number, (name, scores) in enumerate(drafts.scores.items()):
                share, risk = coverage(scores, drafts.losses)
                panel.plot(
                    100 * share,
                    risk,
                    color=colour(number),
                    linestyle="-" if number < len(COLOURS) else DASHES[0],
                    linewidth=1.8,
                    label=name,
                )
            best = coverage(-drafts.losses, drafts.losses)
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
