"""Fit the kinematic predictors (docs/methods.md §3.1).

Training episodes give the noise of the filters, held-out episodes the error of every predictor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kerv_cli.base.errors import KervError
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.methods.calibration import Errors
from kerv_cli.methods.kerv.prediction import FILTERS, PREDICTORS, Noise, kalman_weights
from kerv_cli.targets.observations import check_tail, held_out_every
from kerv_cli.training.demonstrations import check_tasks
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.episode_file import DemoEpisode

RATIOS = np.logspace(-3, 3, 49)
"""Ratios q / r that are tried, with r = 1."""
DAMPINGS = (0.95, 0.9, 0.85, 0.8, 0.75, 0.7, 0.6, 0.5, 0.3)
"""Dampings that are tried for the damped filter."""


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
