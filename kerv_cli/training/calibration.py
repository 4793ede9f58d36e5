"""`kerv calibrate`: measure numbers that KERV and HeiSD need, and write a JSON file (docs/methods.md §3, §4).

The numbers are measured on demonstrations: the noise of the kinematic predictors; each task's K_S, the reference level
of the kinematic variability K (how far drafts are from the target's tokens); the ranges of curvature and path length,
by which the boundary chooses who drafts; each task's smallest similarity at which a retrieved chunk is executed without
verification.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from kerv_cli.base.durations import count
from kerv_cli.base.errors import KervError
from kerv_cli.base.files import write_json
from kerv_cli.base.manifests import stamped
from kerv_cli.base.paths import check_free
from kerv_cli.base.registry import find
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.decoder import Decoder, Stopwatch
from kerv_cli.engine.record import MEAN, MEASURES, DecodeRecord, variability
from kerv_cli.episodes.policy import artifacts_of
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.database import Database
from kerv_cli.methods import calibration as stored
from kerv_cli.methods.artifacts import MadeFor
from kerv_cli.methods.compose import Method
from kerv_cli.methods.heisd.curvature import BoundaryRanges
from kerv_cli.methods.heisd.datastore import Datastore
from kerv_cli.methods.kerv.prediction import Noise, kalman_weights
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.targets.observations import check_tail, observations_of
from kerv_cli.targets.provenance import provenance_of
from kerv_cli.targets.samples import observed_steps
from kerv_cli.training.demonstrations import check_tasks, demos_for
from kerv_cli.training.fit import FEW, timed
from kerv_cli.training.settings import CalibrateSettings, Plan, Stage
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.files import DemoEpisode

# Parts of the method that decodes to measure K_S, the reference level of the kinematic variability K
DRAFTS = {"proposer": "drafter", "acceptance": "relaxed", "threshold": "fixed"}
PRESAMPLED = 6  # the decodes that measure K_S are spread over about this many episodes per task

ENTRIES = 4000  # maximum number of datastore entries looked up per task, evenly spread
LEAST = 20  # minimum number of matches from which a skip level (similarity at which verification is skipped) is derived
# The lower and the upper bound of s_min allow this many times the share of wrong chunks that s_min allows
LOW, HIGH = 2.0, 1 / 3

# Grid of the Kalman filter's ratio q / r (process noise to measurement noise), with r = 1
RATIOS = np.logspace(-3, 3, 49)


Calibrated = tuple[Path, stored.Calibration, list[str]]  # its file, and a line per section that was not measured


def plan_calibration(settings: CalibrateSettings, database: Database) -> Plan[Calibrated]:
    """Check the settings and the artifacts of a calibration, and return the plan to measure it.

    `Plan.make` returns the file's path, the calibration, and a line per section that was not measured: no K_S if
    `decodes` is 0 or the drafter is missing, no skip levels without a datastore.
    """
    artifacts = artifacts_of(settings)
    target, device = artifacts.description, artifacts.device
    target.check_autoregressive("kerv calibrate", "there is no draft to calibrate")
    settings, dataset = demos_for(settings, target, database)
    tasks = resolve_tasks(settings.task or list(dataset.manifest.tasks))
    chosen = choose_episodes(dataset, tasks, settings.episodes)
    drafting().check(target)
    missing = [kind for kind in ("drafter", "datastore") if not artifacts.exists(kind)]
    hashes = artifacts.check({"drafter", "datastore"} - set(missing))
    path = artifacts.new("calibration")
    check = partial(check_free, path, "policy.artifacts.calibration", settings.replace)
    without = f"; without {' and '.join(missing)}" if missing else ""
    text = (
        f"{path}: predictors fitted on {count(len(chosen), 'demonstration')} of {count(len(tasks), 'task')}; "
        f"{settings.decodes} decodes per task; boundary over {', '.join(map(str, settings.boundary_windows))} "
        f"positions{without}"
    )
    measures_k = settings.decodes > 0 and "drafter" not in missing
    windows = partial(read_windows, dataset, target, settings.window)

    def work(stage: Stage) -> Calibrated:
        with stage("reading demonstrations") as progress:
            past, future, paths, counts = windows(chosen, progress)
        variability: dict[str, stored.Variability] = {}
        skip: stored.SkipSection | None = None
        if measures_k:
            decoder = drafting().decoder(artifacts.target, artifacts.load)
            with stage("pre-sampling") as progress:
                variability = presample(decoder, dataset, chosen, settings.decodes, progress)
        if "datastore" not in missing:
            store = artifacts.load("datastore")
            with stage("skip levels") as progress:
                skip = skip_section(store, tasks, settings.epsilon, settings.confidence, progress)
        with stage("boundary ranges") as progress:
            boundary = fit_boundary(paths, settings.boundary_windows, progress)
        with stage("fitting the predictors"):
            ratios = tuple(fit_noise(past[..., dof], future[..., dof]) for dof in range(past.shape[2]))
        calibration = stored.Calibration(
            target=MadeFor.of(target),
            demos=stored.Demonstrations(dataset.sha256, counts),
            window=settings.window,
            noise={"kalman": Noise(ratios, (1.0,) * len(ratios))},
            variability=variability,
            boundary=boundary,
            skip=skip,
            drafter=hashes["drafter"] if measures_k else "",
            provenance=provenance_of("kerv calibrate", settings, device),
        )
        write_json(path, stamped(asdict(calibration)))
        no_drafter = ", no drafter" if "drafter" in missing else ""
        notes = [] if variability else [f"no reference levels K_S: decodes={settings.decodes}{no_drafter}"]
        notes += [] if skip else ["no skip levels: no datastore of these tasks (kerv build datastore)"]
        return path, calibration, notes

    def seconds() -> float:
        # from a few demonstrations and, with a drafter, from two decodes
        few, clock = chosen[:FEW], Stopwatch(torch.device(device))
        fit_boundary(windows(few, lambda *done: None)[2], settings.boundary_windows, lambda *done: None)
        total = clock.stop() * len(chosen) / len(few)
        if measures_k:
            decoder = drafting().decoder(artifacts.target, artifacts.load)
            of_two, decodes = timed(device, lambda: episode_decodes(decoder, dataset, few[0], 2))
            total += of_two * settings.decodes * len(tasks) / max(1, len(decodes))
        return total

    return Plan("calibration", path, text, work, check, seconds)


def drafting() -> Method:
    return Method.of(RolloutSettings(**{kind: find(kind, name).default for kind, name in DRAFTS.items()}))


def presample(
    decoder: Decoder, dataset: DemoDataset, chosen: Sequence[int], decodes: int, progress: OnProgress
) -> dict[str, stored.Variability]:
    variability, tasks = {}, list(dict.fromkeys(dataset.episodes[index].task for index in chosen))
    for number, name in enumerate(tasks, 1):
        records: list[DecodeRecord] = []
        for index in chosen:
            if dataset.episodes[index].task == name and len(records) < decodes:
                budget = min(math.ceil(decodes / PRESAMPLED), decodes - len(records))
                records += episode_decodes(decoder, dataset, index, budget)
        if not records:
            raise KervError(f"{name}: no decode compared a draft with a target token, so there is no K_S")
        variability[name] = reference_level(records, decoder.target.actions, decoder.target.chunk)
        progress(number, len(tasks))
    return variability


def reference_level(records: Sequence[DecodeRecord], actions: ActionSpace, chunk: int) -> stored.Variability:
    """Return a task's reference level K_S: the median of the variability K over the decodes, for each measure of K.

    Thresholds divide by K_S. So K_S is at least the K of a chunk in which a single token is off by one bin.
    """
    bin_width, moving = 2.0 / actions.tokens, chunk * int((~actions.is_strict).sum())
    levels = {}
    for measure in MEASURES:
        found = np.array([variability(record.rounds, actions, measure) for record in records], dtype=float)
        known = found[~np.isnan(found)]  # NaN: no draft token counts
        median = float(np.median(known)) if len(known) else 0.0
        levels[measure] = max(median, bin_width if measure.startswith("sum") else bin_width / moving)
    return stored.Variability(levels[MEAN], len(records), levels)


def episode_decodes(decoder: Decoder, dataset: DemoDataset, index: int, decodes: int) -> list[DecodeRecord]:
    """Decode observations spread evenly over one demonstration. Leave out decodes in which no draft was verified.

    The decoder also gets every action executed in between, because some methods use a history.
    """
    episode = dataset.load(index)
    seen = observed_steps(episode, bool(decoder.target.cameras))
    rows = np.unique(np.linspace(0, len(seen) - 1, decodes).round().astype(int))
    steps, records, executed = seen[rows], [], 0
    observations = observations_of(decoder.target, episode, steps, dataset.manifest.observation)
    decoder.reset(episode.task, episode.seed, episode.end_effector[0])
    for step, observation in zip(steps, observations, strict=True):
        for t in range(executed, step):
            decoder.observe(episode.executed[t], episode.end_effector[t + 1])
        executed = step
        record = decoder.decode(observation)
        if record.variability is not None:
            records.append(record)
    return records


def fit_boundary(paths: list[np.ndarray], windows: Sequence[int], progress: OnProgress) -> stored.BoundarySection:
    ranges = {}
    for number, window in enumerate(windows, 1):
        ranges[str(window)] = BoundaryRanges.fit(paths, window)
        progress(number, len(windows))
    return stored.BoundarySection(len(paths), ranges)


def episode_windows(episode: DemoEpisode, actions: ActionSpace, window: int, horizon: int) -> np.ndarray:
    """Cut out the expert's actions around each moment (control step) that has `window` control steps before it.

    The recording has actions beyond the episode's last control step; the last windows end in them.

    Returns:
        (n, window + horizon, D) float32: the expert's normalised actions around each of the n moments, oldest first.
    """
    steps, length = len(episode.executed), window + horizon
    check_tail(episode, horizon, f"predictions of {horizon} steps")
    labels = actions.normalise(episode.labels[: steps + horizon - 1]).astype(np.float32)
    if steps <= window:
        return np.zeros((0, length, labels.shape[1]), np.float32)
    return np.lib.stride_tricks.sliding_window_view(labels, length, axis=0).swapaxes(1, 2)


def read_windows(
    dataset: DemoDataset, target: TargetDescription, window: int, chosen: Sequence[int], progress: OnProgress
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], dict[str, dict[str, int]]]:
    """Read the expert's actions around n moments (control steps) of episodes, see `episode_windows`.

    Returns:
        - (n, window, D) normalised actions before each moment
        - (n, H, D) normalised actions from each moment on
        - (T, 3) metres, the end effector's positions in each episode
        - the number of episodes of each task, as in `Demonstrations`
    """
    counts: dict[str, dict[str, int]] = {}
    parts, paths = [], []
    for done, index in enumerate(chosen, 1):
        episode = dataset.load(index)
        parts.append(episode_windows(episode, target.actions, window, target.chunk))
        paths.append(episode.end_effector.copy())
        counts.setdefault(episode.task, {"training": 0})["training"] += bool(len(parts[-1]))
        progress(done, len(chosen))
    if short := [task for task, number in counts.items() if not number["training"]]:
        raise KervError(f"{', '.join(short)}: no episode is longer than a window of {window}")
    around = np.concatenate(parts)
    return around[:, :window], around[:, window:], paths, counts


def choose_episodes(dataset: DemoDataset, tasks: Sequence[str], limit: int) -> list[int]:
    check_tasks(dataset, tasks)
    return [index for task in tasks for index in dataset.of_tasks(task)[: limit or None]]


def fit_noise(past: np.ndarray, future: np.ndarray) -> float:
    """Return the process noise q in `RATIOS` with which one DoF's Kalman filter predicts best, for a noise r = 1.

    Args:
        past: (n, window) normalised actions before each of n moments.
        future: (n, H) normalised actions from each moment on. Their mean absolute error counts.
    """

    def error(q: float) -> float:
        weights = kalman_weights(q, 1.0, past.shape[1], future.shape[1])
        return float(np.abs(np.clip(past @ weights.T, -1.0, 1.0) - future).mean())

    return min(map(float, RATIOS), key=error)


@dataclass(frozen=True)
class Matches:
    """n datastore entries of one task, each compared with the most similar entry of another episode.

    A match is good if the error is small and all tokens of strict DoFs are the same: a wrong gripper hardly changes the
    mean error but drops the object.
    """

    similarity: np.ndarray  # (n,) float32, cosine
    error: np.ndarray  # (n,) mean absolute difference of the two chunks, normalised action units
    good: np.ndarray  # (n,) bool


def match(store: Datastore, task: str, epsilon: float) -> Matches:
    """Compare each datastore entry of a task with the most similar entry of another episode (docs/methods.md §4.3).

    Args:
        epsilon: Largest mean absolute error of a good match, in normalised action units.
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
    same_strict = (drafts == expert)[:, space.strict_tokens(expert.shape[1])].all(1)
    return Matches(similarity, error, (error <= epsilon) & same_strict)


def lowest_level(matches: Matches, confidence: float, least: int = LEAST) -> float | None:
    """Return the lowest similarity s for which at least the share `confidence` of the matches from s on is good.

    None if there is no s with at least `least` matches from s on.
    """
    order = np.argsort(-matches.similarity, kind="stable")
    ranked = matches.similarity[order]
    above = np.arange(1, len(ranked) + 1)
    enough = (np.cumsum(matches.good[order]) / above >= confidence) & (above >= least)
    enough[:-1] &= ranked[:-1] > ranked[1:]
    return float(ranked[enough][-1]) if enough.any() else None


def task_levels(matches: Matches, confidence: float) -> stored.SkipLevel:
    similarity, wrong = matches.similarity, 1 - confidence
    s_min = lowest_level(matches, confidence)
    if s_min is None:
        return stored.SkipLevel(stored.NEVER, stored.NEVER, stored.NEVER, share=0.0, entries=len(similarity))
    low, high = lowest_level(matches, 1 - wrong * LOW), lowest_level(matches, 1 - wrong * HIGH)
    skipped = similarity >= s_min
    return stored.SkipLevel(
        s_min,
        low=s_min if low is None else min(low, s_min),
        high=float(similarity.max()) if high is None else max(high, s_min),
        share=float(skipped.mean()),
        entries=len(similarity),
        within=float(matches.good[skipped].mean()),
        error=float(matches.error[skipped].mean()),
    )


def skip_section(
    store: Datastore, tasks: Sequence[str], epsilon: float, confidence: float, progress: OnProgress
) -> stored.SkipSection | None:
    levels = {}
    for done, task in enumerate(tasks, 1):
        if task in store.shards:
            levels[task] = task_levels(match(store, task, epsilon), confidence)
        progress(done, len(tasks))
    return stored.SkipSection(store.manifest.content, epsilon, confidence, levels) if levels else None
