"""Fits the kinematic predictors: windows of actions from the demonstrations, the noise of the filters from training
episodes, every predictor's error on held-out ones (docs/methods.md §3.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from kerv_cli.base.errors import KervError
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.methods.calibration import Errors
from kerv_cli.methods.kerv.prediction import FILTERS, PREDICTORS, Noise, build_predictor, kalman_weights
from kerv_cli.training.demonstrations import check_tasks
from kerv_cli.training.observations import check_tail, held_out_every
from kerv_cli.worlds.demos.dataset import DemoDataset, OnProgress
from kerv_cli.worlds.demos.episode_file import DemoEpisode

RATIOS = np.logspace(-3, 3, 49)  # q / r that are tried, r = 1
DAMPINGS = (0.95, 0.9, 0.85, 0.8, 0.75, 0.7, 0.6, 0.5, 0.3)  # tried by the damped filter


@dataclass(frozen=True)
class Windows:
    """n moments of demonstrations: the actions before each and the expert's actions from there on, normalised.

    past (n, window, D), future (n, H, D), task (n,) index into `tasks`, held_out (n,) bool by whole episodes. paths:
    (T, 3) metres, of the end effector in every training episode.
    """

    past: np.ndarray
    future: np.ndarray
    task: np.ndarray
    held_out: np.ndarray
    tasks: tuple[str, ...]
    episodes: dict[str, dict[str, int]]  # task -> {"training": episodes, "held_out": episodes}
    paths: list[np.ndarray] = field(default_factory=list)

    def where(self, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(past, future) of the moments in `mask`."""
        return self.past[mask], self.future[mask]


def episode_windows(
    episode: DemoEpisode, actions: ActionSpace, window: int, horizon: int
) -> tuple[np.ndarray, np.ndarray]:
    """(past (n, window, D), future (n, horizon, D)) of every moment of an episode that has a full window behind it.

    Both are the clean labels.

    Raises:
        CheckpointError: too few labels were recorded beyond the episode's end.
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
    on_progress: OnProgress,
) -> Windows:
    """The windows of the episodes `chosen`: index in the dataset -> whether it is held out.

    Raises:
        KervError: a task's training or held-out episodes are all shorter than the window.
    """
    tasks = tuple(dict.fromkeys(dataset.episodes[i].task for i in chosen))
    counts = {task: {"training": 0, "held_out": 0} for task in tasks}
    parts, labels, masks, paths = [], [], [], []
    for done, (index, held_out) in enumerate(chosen.items(), 1):
        episode = dataset.load(index)
        past, future = episode_windows(episode, actions, window, horizon)
        parts.append((past.astype(np.float32), future.astype(np.float32)))
        labels.append(np.full(len(past), tasks.index(episode.task)))
        masks.append(np.full(len(past), held_out))
        paths += [] if held_out else [episode.end_effector.copy()]
        counts[episode.task]["held_out" if held_out else "training"] += bool(len(past))
        on_progress(done, len(chosen))
    short = [task for task, count in counts.items() if not all(count.values())]
    if short:
        raise KervError(f"{', '.join(short)}: no training or no held-out episode is longer than a window of {window}")
    past, future = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Windows(past, future, np.concatenate(labels), np.concatenate(masks), tasks, counts, paths)


def choose_episodes(dataset: DemoDataset, tasks: Sequence[str], limit: int, share: float) -> dict[int, bool]:
    """Index -> held out, of the first `limit` episodes per task (0: all); every k-th of a task's plain episodes and
    every k-th of its perturbed ones is held out.

    Raises:
        CheckpointError: a task has no demonstration.
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
    """(q, damping) with the smallest mean absolute error over all moments and steps, for r = 1.

    past (n, window), future (n, H) of one DoF. Searched on a grid: `RATIOS` x `dampings`.
    """
    window, steps = past.shape[1], future.shape[1]

    def error(candidate: tuple[float, float]) -> float:
        weights = kalman_weights(candidate[0], 1.0, window, steps, candidate[1])
        return float(np.abs(np.clip(past @ weights.T, -1.0, 1.0) - future).mean())

    return min(((float(q), damping) for damping in dampings for q in RATIOS), key=error)


def fit_filters(windows: Windows, steps: int, held: np.ndarray) -> dict[str, Noise]:
    """Kind of filter -> its noise per DoF, fitted on the training episodes to the next `steps` actions. held (D,) bool:
    DoFs that are not fitted, because they are held."""
    past, future = windows.where(~windows.held_out)
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
    """Kind of predictor -> task -> DoF -> H mean absolute errors on the held-out episodes, normalised units."""
    window, horizon = windows.past.shape[1], windows.future.shape[1]
    errors: Errors = {}
    for kind in PREDICTORS:
        predictor = build_predictor(kind, space.is_strict, noise, window, window, horizon)
        errors[kind] = {}
        for number, task in enumerate(windows.tasks):
            past, future = windows.where(windows.held_out & (windows.task == number))
            mean = np.abs(predictor.predict_many(past, horizon) - future).mean(0)
            errors[kind][task] = {name: mean[:, dof].tolist() for dof, name in enumerate(space.names)}
    return errors


def moving_errors(errors: Errors, kind: str, space: ActionSpace) -> np.ndarray:
    """(tasks, H): errors of predictor `kind`, averaged over the DoFs that are not strict."""
    moving = [name for name in space.names if name not in space.strict]
    return np.array([[rows[name] for name in moving] for rows in errors[kind].values()]).mean(1)
