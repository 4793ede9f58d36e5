"""`kerv calibrate`: one JSON of figures measured on the training demonstrations (docs/methods.md §3, §4).

It holds the noise of the kinematic predictors and their errors on held-out episodes, each task's reference level K_S,
the ranges of the hybrid boundary, and the similarity from which verification is skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from kerv_cli.base.errors import CheckpointError, KervError
from kerv_cli.base.files import read_mapping, write_json
from kerv_cli.base.places import artifact
from kerv_cli.engine.decoder import Decoder
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.artifacts import Artifacts, MadeFor
from kerv_cli.methods.calibration import (
    NEVER,
    BoundarySection,
    Calibration,
    CalibrationArtifact,
    Demonstrations,
    SkipLevel,
    SkipSection,
    Variability,
)
from kerv_cli.methods.compose import Method
from kerv_cli.methods.heisd.datastore import Datastore
from kerv_cli.methods.heisd.rules import BoundaryRanges
from kerv_cli.targets.folders import check_not_shipped
from kerv_cli.targets.observations import observations_of
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.training.demonstrations import demos_for
from kerv_cli.training.predictor_fit import choose_episodes, fit_filters, prediction_errors, read_windows
from kerv_cli.training.settings import CalibrateSettings
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import OnProgress

PRESAMPLED = 6
"""Episodes per task over which the decodes of pre-sampling are spread, at most."""

ENTRIES = 4000
"""Entries looked up per task, evenly spread. On MT10, levels from 1000 did not hold on other episodes."""
LEAST = 20
"""Entries that must be above a level to support it."""
LOW, HIGH = 2.0, 1 / 3
"""The bounds of s_min allow this multiple of the wrong chunks that s_min allows."""

Stage = Callable[[str], AbstractContextManager[OnProgress]]
"""Opens a part of the work by its title and yields what is told its progress."""


class CalibrationRun:
    """Checks that a calibration can be made; `run` makes it.

    Attributes:
        notes: One line per section that was not measured: why, and whether an earlier one was kept.

    Raises:
        UsageError: A number out of range, or an unknown task.
        CheckpointError: No such target or demonstrations, demonstrations of another environment, or a datastore of
            another target.
    """

    def __init__(self, settings: CalibrateSettings) -> None:
        self.settings, self.dataset = demos_for(settings)
        settings = self.settings
        self.tasks = resolve_tasks(settings.task or list(self.dataset.manifest.tasks))
        self.artifacts = Artifacts(settings.results, settings.policy, device=settings.runtime.device)
        self.description = self.artifacts.description
        self.description.check_autoregressive("kerv calibrate", "there is no draft to calibrate")
        self.path = self.artifacts.path("calibration")
        if settings.name is not None:
            self.path = artifact(settings.results, "calibration", settings.name) / self.path.name
        self.chosen = choose_episodes(self.dataset, self.tasks, settings.episodes, settings.held_out)
        self.datastore = self.artifacts.path("datastore")
        self.has_datastore = (self.datastore / "manifest.json").is_file()
        if self.has_datastore:
            self.artifacts.check(["datastore"])
        if not (self.has_datastore and self.path.is_file() and read_mapping(self.path).get("skip") is None):
            check_not_shipped(self.path, "name")  # a shipped one may get the levels of a datastore made since
        self.notes: list[str] = []

    def plan(self) -> str:
        """Return one line for --plan: demonstrations, decodes, boundary windows, skip levels and the file."""
        held_out, proposer = sum(self.chosen.values()), self.settings.proposer.kind
        skip = f"skip levels from {self.datastore}"
        if not self.has_datastore:
            skip = f"no skip levels: no datastore {self.datastore}"
        return (
            f"{self.path}: predictors fitted on {len(self.chosen) - held_out} demonstrations of {len(self.tasks)} "
            f"tasks, tested on {held_out}; {self.settings.decodes} decodes per task with {proposer} drafts; boundary "
            f"over {', '.join(map(str, self.settings.boundary_windows))} positions; {skip}"
        )

    def run(self, stage: Stage) -> Calibration:
        """Measure everything and write the calibration.

        A section that is not measured now is taken from an earlier calibration of the same target.

        Raises:
            CheckpointError: Frames of another size, or no path bends.
            KervError: No decode of a task compared a draft.
            StorageError: The disk refused.
        """
        space, chunk, settings = self.description.actions, self.description.chunk, self.settings
        with stage("reading demonstrations") as progress:
            windows = read_windows(self.dataset, self.chosen, space, settings.window, chunk, progress)
        variability, skip = self.presample(stage), self.skip(stage)
        with stage("boundary ranges") as progress:
            ranges = {}
            for number, window in enumerate(settings.boundary_windows, 1):
                ranges[str(window)] = BoundaryRanges.fit(windows.paths, window)
                progress(number, len(settings.boundary_windows))
        with stage("fitting the predictors"):
            noise = fit_filters(windows, chunk, space.is_strict)
            errors = prediction_errors(windows, noise, space)
        provenance = provenance_of("kerv calibrate", settings, settings.runtime.device)
        sections, kept = self._with_earlier({"variability": variability, "skip": skip})
        calibration = Calibration(
            target=MadeFor.of(self.description),
            demos=Demonstrations(self.dataset.sha256, windows.episodes),
            window=settings.window,
            noise=noise,
            errors=errors,
            boundary=BoundarySection(len(windows.paths), ranges),
            **sections,
            provenance={**provenance, "kept": kept} if kept else provenance,
        )
        write_json(self.path, asdict(calibration))
        return calibration

    def skip(self, stage: Stage) -> SkipSection | None:
        """Return the skip levels of the tasks, from the target's datastore; None without a datastore."""
        if not self.has_datastore:
            return None
        store = self.artifacts.load("datastore")
        with stage("skip levels") as progress:
            return skip_section(store, self.tasks, self.settings.epsilon, self.settings.confidence, progress)

    def presample(self, stage: Stage) -> dict[str, Variability]:
        """Return each task's K_S and percentiles of K, from decodes of training observations; empty for decodes=0."""
        decodes = self.settings.decodes
        if not decodes:
            return {}
        decoder, actions = self.decoder(), self.description.actions
        # the smallest K above 0: one token of a chunk is off by one bin
        least = 2.0 / actions.tokens / (self.description.chunk * int((~actions.is_strict).sum()))
        variability = {}
        with stage("pre-sampling") as progress:
            for number, name in enumerate(self.tasks, 1):
                levels: list[float] = []
                for index, held_out in self.chosen.items():
                    if not held_out and self.dataset.episodes[index].task == name and len(levels) < decodes:
                        budget = min(math.ceil(decodes / PRESAMPLED), decodes - len(levels))
                        levels += self.episode_levels(decoder, index, budget)
                if not levels:
                    raise KervError(f"{name}: no decode compared a draft with a target token, so there is no K_S")
                variability[name] = distribution(levels, least)
                progress(number, len(self.tasks))
        return variability

    def decoder(self) -> Decoder:
        """Return the decoder of pre-sampling: the settings' proposer, acceptance and threshold."""
        s = self.settings
        method = RolloutSettings(proposer=s.proposer, acceptance=s.acceptance, threshold=s.threshold)
        return Method.of(method).decoder(self.artifacts.target, self.artifacts.load)

    def episode_levels(self, decoder: Decoder, index: int, decodes: int) -> list[float]:
        """Return K of up to `decodes` decodes, spread evenly over a demonstration's observations.

        The decoder sees every executed action in between, because some methods have a history.
        """
        episode = self.dataset.load(index)
        rows = np.unique(np.linspace(0, len(episode.frame_steps) - 1, decodes).round().astype(int))
        steps, levels, executed = episode.frame_steps[rows], [], 0
        observations = observations_of(decoder.target, episode, steps, self.dataset.manifest.observation)
        decoder.reset(episode.task, episode.seed, episode.end_effector[0])
        for step, observation in zip(steps, observations, strict=True):
            for t in range(executed, step):
                decoder.observe(episode.executed[t], episode.end_effector[t + 1])
            executed = step
            record = decoder.decode(observation)
            if record.variability is not None:
                levels.append(record.variability)
        return levels

    def _with_earlier(self, sections: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Fill empty sections from an earlier calibration -> (sections, section -> provenance of its measurement)."""
        try:
            earlier = CalibrationArtifact().checked(self.path, self.description)
        except CheckpointError:  # missing, damaged or of another target: there is nothing to keep
            earlier = None
        reasons = {
            "variability": f"reference levels K_S: decodes={self.settings.decodes}",
            "skip": f"skip levels: no datastore of these tasks in {self.datastore} (kerv build datastore)",
        }
        kept = {}
        for name in [name for name, value in sections.items() if not value]:
            section = getattr(earlier, name) if earlier else None
            if earlier and section:
                sections[name] = section
                before = earlier.provenance.get("kept", {})
                kept[name] = before.get(name) or {k: v for k, v in earlier.provenance.items() if k != "kept"}
            self.notes.append(f"{reasons[name]}; {'kept from the earlier run' if section else 'left empty'}")
        return sections, kept


def distribution(levels: Sequence[float], least: float) -> Variability:
    """Return percentiles of K and its median K_S; K is divided by K_S, which is therefore at least `least`."""
    low, high, top = np.percentile(levels, [25, 75, 90]).tolist()
    return Variability(max(float(np.median(levels)), least), len(levels), low, high, top)


@dataclass(frozen=True)
class Matches:
    """n entries of one task and their best neighbours in other episodes."""

    similarity: np.ndarray  # (n,) float32, cosine
    error: np.ndarray  # (n,) mean absolute difference of the two chunks, normalised action units
    strict: np.ndarray  # (n,) bool, whether a token of a strict DoF differs

    def good(self, epsilon: float) -> np.ndarray:
        """Return (n,) bool: the error is at most epsilon, and all tokens of strict DoFs are the expert's.

        The gripper is judged apart: a wrong one hardly changes the mean over all DoFs, but drops the object.
        """
        return (self.error <= epsilon) & ~self.strict


def match(store: Datastore, task: str) -> Matches:
    """Compare up to ENTRIES entries of a task with their best neighbours in other episodes; none for one episode.

    Each entry is looked up among the other episodes of its task. The best neighbour's chunk, which would have been
    executed without verification, is compared with the entry's own: the expert's next actions (docs/methods.md §4.3).
    """
    shard = store.shards[task]
    count = min(ENTRIES, shard.stop - shard.start) if len(np.unique(store.seeds[shard])) > 1 else 0
    rows = np.linspace(shard.start, shard.stop - 1, count).astype(int)
    similarity, drafts = np.zeros(count, np.float32), np.zeros((count, store.tokens.shape[1]), np.int64)
    for i, row in enumerate(rows):
        neighbours = store.query(store.vectors[row], task, 1, without=int(store.seeds[row]))
        similarity[i], drafts[i] = neighbours.similarity[0], neighbours.chunks[0]
    space, expert = store.manifest.actions, store.tokens[rows].astype(np.int64)
    error = np.abs(space.values_of(drafts) - space.values_of(expert)).mean(1)
    strict = (drafts != expert)[:, space.strict_tokens(expert.shape[1])].any(1)
    return Matches(similarity, error, strict)


def lowest_level(similarity: np.ndarray, good: np.ndarray, confidence: float, least: int = LEAST) -> float | None:
    """Return the lowest similarity s such that at least the share `confidence` of the entries from s on is good.

    Entries of equal similarity count together.

    Args:
        similarity: (n,) of the entries.
        good: (n,) bool.
        confidence: Share of good entries.
        least: Entries that a level needs.

    Returns:
        The similarity; None if no level has that many good entries.
    """
    order = np.argsort(-similarity, kind="stable")
    ranked = similarity[order]
    above = np.arange(1, len(ranked) + 1)
    enough = (np.cumsum(good[order]) / above >= confidence) & (above >= least)
    enough[:-1] &= ranked[:-1] > ranked[1:]
    return float(ranked[enough][-1]) if enough.any() else None


def task_levels(matches: Matches, epsilon: float, confidence: float) -> SkipLevel:
    """Return a task's s_min, the bounds between which feedback may move it, and the share of decodes it would skip.

    The bounds low ≤ s_min ≤ high allow twice and a third of the wrong chunks: 0.8 and 0.967 for a confidence of 0.9. If
    no level is good enough for high, it is the largest similarity seen. If none is for s_min, all three are NEVER.
    """
    good, wrong = matches.good(epsilon), 1 - confidence
    s_min = lowest_level(matches.similarity, good, confidence)
    if s_min is None:
        return SkipLevel(NEVER, NEVER, NEVER, share=0.0, entries=len(matches.similarity))
    low, high = (lowest_level(matches.similarity, good, 1 - wrong * factor) for factor in (LOW, HIGH))
    skipped = matches.similarity >= s_min
    return SkipLevel(
        s_min,
        low=s_min if low is None else min(low, s_min),
        high=float(matches.similarity.max()) if high is None else max(high, s_min),
        share=float(skipped.mean()),
        entries=len(matches.similarity),
        within=float(good[skipped].mean()),
        error=float(matches.error[skipped].mean()),
    )


def skip_section(
    store: Datastore, tasks: Sequence[str], epsilon: float, confidence: float, progress: OnProgress
) -> SkipSection | None:
    """Return the levels of those tasks that the datastore holds; None if it holds none of them."""
    levels = {}
    for done, task in enumerate(tasks, 1):
        if task in store.shards:
            levels[task] = task_levels(match(store, task), epsilon, confidence)
        progress(done, len(tasks))
    return SkipSection(store.content, epsilon, confidence, levels) if levels else None
