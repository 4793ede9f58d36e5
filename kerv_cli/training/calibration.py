"""`kerv calibrate`: one JSON of figures measured on the training demonstrations (docs/methods.md §3, §4).

It holds the noise of the kinematic predictors and their errors on held-out episodes, each task's reference level K_S,
the ranges of the hybrid boundary, and the similarity from which verification is skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from kerv_cli.base.errors import CheckpointError, KervError
from kerv_cli.base.files import read_mapping, write_json
from kerv_cli.base.places import artifact
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.decoder import Decoder
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.methods.artifacts import Artifacts, MadeFor
from kerv_cli.methods.calibration import (
    NEVER,
    BoundarySection,
    Calibration,
    CalibrationArtifact,
    Demonstrations,
    Errors,
    SkipLevel,
    SkipSection,
    Variability,
)
from kerv_cli.methods.compose import Method
from kerv_cli.methods.heisd.datastore import Datastore
from kerv_cli.methods.heisd.rules import BoundaryRanges
from kerv_cli.methods.kerv.prediction import FILTERS, PREDICTORS, Noise, kalman_weights
from kerv_cli.targets.folders import check_not_shipped
from kerv_cli.targets.observations import check_tail, held_out_every, observations_of
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.training.demonstrations import check_tasks, demos_for
from kerv_cli.training.settings import CalibrateSettings
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.episode_file import DemoEpisode

PRESAMPLED = 6
"""Episodes per task over which the decodes of pre-sampling are spread, at most."""

ENTRIES = 4000
"""Entries looked up per task, evenly spread. On MT10, levels from 1000 did not hold on other episodes."""
LEAST = 20
"""Entries that must be above a level to support it."""
LOW, HIGH = 2.0, 1 / 3
"""The bounds of s_min allow this multiple of the wrong chunks that s_min allows."""

RATIOS = np.logspace(-3, 3, 49)
"""Ratios q / r that are tried, with r = 1."""
DAMPINGS = (0.95, 0.9, 0.85, 0.8, 0.75, 0.7, 0.6, 0.5, 0.3)
"""Dampings that are tried for the damped filter."""

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
class Windows:
    """n moments of demonstrations, with the expert's actions before and after each, normalised."""

    past: np.ndarray  # (n, window, D)
    future: np.ndarray  # (n, H, D)
    task: np.ndarray  # (n,) index into `tasks`
    held_out: np.ndarray  # (n,) bool, by whole episodes
    tasks: tuple[str, ...]
    episodes: dict[str, dict[str, int]]  # task -> {"training": episodes, "held_out": episodes}
    paths: list[np.ndarray]  # (T, 3) metres, of the end effector in every training episode


def episode_windows(
    episode: DemoEpisode, actions: ActionSpace, window: int, horizon: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return past (n, window, D) and future (n, horizon, D) of every moment with a full window before it.

    Both are the clean labels.

    Raises:
        CheckpointError: Too few labels were recorded after the episode's end.
    """
    steps = len(episode.executed)
    check_tail(episode, horizon, f"predictions of {horizon} steps")
    labels = actions.normalise(episode.labels)
    if steps <= window:
        return np.zeros((0, window, labels.shape[1])), np.zeros((0, horizon, labels.shape[1]))
    past = np.lib.stride_tricks.sliding_window_view(labels[: steps - 1], window, axis=0)
    future = np.lib.stride_tricks.sliding_window_view(labels[window : steps + horizon - 1], horizon, axis=0)
    return past.swapaxes(1, 2), future.swapaxes(1, 2)


def read_windows(
    dataset: DemoDataset,
    chosen: Mapping[int, bool],
    actions: ActionSpace,
    window: int,
    horizon: int,
    progress: OnProgress,
) -> Windows:
    """Return the windows of the episodes `chosen`: index in the dataset -> whether it is held out.

    Raises:
        KervError: A task's training or held-out episodes are all shorter than the window.
    """
    tasks = tuple(dict.fromkeys(dataset.episodes[i].task for i in chosen))
    counts = {task: {"training": 0, "held_out": 0} for task in tasks}
    columns, paths = [], []
    for done, (index, held_out) in enumerate(chosen.items(), 1):
        episode = dataset.load(index)
        past, future = (x.astype(np.float32) for x in episode_windows(episode, actions, window, horizon))
        columns.append((past, future, np.full(len(past), tasks.index(episode.task)), np.full(len(past), held_out)))
        if not held_out:
            paths.append(episode.end_effector.copy())
        counts[episode.task]["held_out" if held_out else "training"] += bool(len(past))
        progress(done, len(chosen))
    short = [task for task, count in counts.items() if not all(count.values())]
    if short:
        raise KervError(f"{', '.join(short)}: no training or no held-out episode is longer than a window of {window}")
    past, future, task, held = map(np.concatenate, zip(*columns, strict=True))
    return Windows(past, future, task, held, tasks, counts, paths)


def choose_episodes(dataset: DemoDataset, tasks: Sequence[str], limit: int, share: float) -> dict[int, bool]:
    """Return index -> whether it is held out, for the first `limit` episodes of each task (0: all).

    Of a task's plain and of its perturbed episodes, every k-th is held out.

    Raises:
        CheckpointError: A task has no demonstration.
    """
    check_tasks(dataset, tasks)
    chosen: dict[int, bool] = {}
    for task in tasks:
        of_task = [index for index, entry in enumerate(dataset.episodes) if entry.task == task][: limit or None]
        for perturbed in (False, True):
            kind = [i for i in of_task if dataset.episodes[i].perturbed == perturbed]
            every = held_out_every(max(2, len(kind)), share)
            chosen |= {index: number % every == every - 1 for number, index in enumerate(kind)}
    return chosen


def fit_noise(past: np.ndarray, future: np.ndarray, dampings: Sequence[float]) -> tuple[float, float]:
    """Return (q, damping) with the smallest mean absolute error, for r = 1, on the grid RATIOS x `dampings`.

    Args:
        past: (n, window) of one DoF.
        future: (n, H) of the same DoF.
        dampings: Those to try.
    """
    window, steps = past.shape[1], future.shape[1]

    def error(candidate: tuple[float, float]) -> float:
        weights = kalman_weights(candidate[0], 1.0, window, steps, candidate[1])
        return float(np.abs(np.clip(past @ weights.T, -1.0, 1.0) - future).mean())

    return min(((float(q), damping) for damping in dampings for q in RATIOS), key=error)


def fit_filters(windows: Windows, steps: int, held: np.ndarray) -> dict[str, Noise]:
    """Return each filter's noise per DoF, fitted on the training episodes to the next `steps` actions.

    DoFs where `held` (D,) is true keep their value and are not fitted.
    """
    past, future = windows.past[~windows.held_out], windows.future[~windows.held_out]
    noise = {}
    for kind in FILTERS:
        dampings = DAMPINGS if kind == "damped" else (1.0,)
        fits = [
            (0.0, 1.0) if held[dof] else fit_noise(past[..., dof], future[:, :steps, dof], dampings)
            for dof in range(past.shape[2])
        ]
        noise[kind] = Noise(tuple(q for q, _ in fits), (1.0,) * len(fits), tuple(d for _, d in fits))
    return noise


def prediction_errors(windows: Windows, noise: Mapping[str, Noise], space: ActionSpace) -> Errors:
    """Return predictor -> task -> DoF -> H mean absolute errors on the held-out episodes, normalised units."""
    window, horizon = windows.past.shape[1], windows.future.shape[1]
    errors: Errors = {}
    for kind, predictor_class in PREDICTORS.items():
        predictor = predictor_class(space.is_strict, noise.get(kind), window, window, horizon)
        errors[kind] = {}
        for number, task in enumerate(windows.tasks):
            chosen = windows.held_out & (windows.task == number)
            mean = np.abs(predictor.predict_many(windows.past[chosen], horizon) - windows.future[chosen]).mean(0)
            errors[kind][task] = {name: mean[:, dof].tolist() for dof, name in enumerate(space.names)}
    return errors


def moving_errors(errors: Errors, kind: str, space: ActionSpace) -> np.ndarray:
    """Return (tasks, H) errors of a predictor, averaged over the DoFs that are not strict."""
    moving = [name for name in space.names if name not in space.strict]
    return np.array([[rows[name] for name in moving] for rows in errors[kind].values()]).mean(1)


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
