"""The demonstrations that a command learns from: one dataset, or several that add up, of all tasks or some."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.places import artifact, find_target, results_dir
from kerv_cli.base.spaces import ActionSpace, ObservationSpace
from kerv_cli.base.views import views_of
from kerv_cli.episodes.settings import DEFAULT_TASKS
from kerv_cli.lab.runs import command_to_go_on
from kerv_cli.targets.checkpoint import TargetDescription, described
from kerv_cli.training.settings import DemonstrationSettings
from kerv_cli.worlds import resolve_tasks, specs, stands_for_tasks
from kerv_cli.worlds.demos.dataset import DemoDataset

S = TypeVar("S", bound=DemonstrationSettings)
"""Settings of what is made for a target from demonstrations."""


def name_of(tasks: Sequence[str]) -> str:
    """The name of demonstrations of these tasks and suites, where none is given."""
    return "-".join(tasks or DEFAULT_TASKS).lower()


def open_demos(results: str, names: str, tasks: Sequence[str] = (), episodes: int = 0) -> DemoDataset:
    """The dataset of that name; several, e.g. `mt50+mt50-dagger`, are joined in that order. A folder of that very
    name comes first. tasks, episodes: for the command that records what is missing; none and 0: its defaults.

    Raises:
        UsageError: no folder name. CheckpointError: one is missing, unfinished or damaged, or they do not add up.
    """
    whole = artifact(results, "demos", names)
    folders = [whole] if whole.is_dir() else [artifact(results, "demos", name) for name in names.split("+")]
    datasets = []
    for folder in folders:
        try:
            datasets.append(DemoDataset.open(folder))
        except CheckpointError as error:
            words = command_to_go_on(results, "demos", folder)
            if words and not (folder / "manifest.json").exists():
                line = shlex.join(["kerv", *words])
                raise CheckpointError(f"the demonstrations in {folder} are unfinished: go on with '{line}'") from error
            if folder.is_dir():
                raise
            remedy = _remedy(results, folder, tasks, episodes)
            raise CheckpointError(f"no demonstrations in {folder}: {remedy}") from error
    return DemoDataset.joined(datasets)


def _remedy(results: str, folder: Path, tasks: Sequence[str], episodes: int) -> str:
    tasks = [folder.name] if stands_for_tasks(folder.name) else tasks
    name = [] if folder.name == name_of(tasks) else [f"name={folder.name}"]
    task = [f"task={tasks[0]}" if len(tasks) == 1 else f"task=[{','.join(tasks)}]"] if tasks else []
    words = [*name, *task, *([f"episodes={episodes}"] if episodes else [])]
    stored = sorted(path.parent.name for path in (results_dir(results) / "artifacts/demos").glob("*/manifest.json"))
    others = f", or name others: demos={' or demos='.join(stored)}" if stored else ""
    return f"record them with '{' '.join(['kerv demos', *words])}'{others}"


def demos_for(settings: S) -> tuple[S, DemoDataset]:
    """The demonstrations that something is made from for a target: those that it was trained on, where none are named.
    Also the settings with what they leave open: the demonstrations' name, and, where those have tasks that the target
    does not know, the tasks that it does; no task stands for all.

    Raises:
        UsageError: no such target. CheckpointError: as `open_demos`, or they are of another environment, or for a
            compact target of other views.
    """
    target = described(find_target(settings.results, settings.policy.target), "target", TargetDescription)
    origin = target.provenance.get("demos") if not settings.demos else None
    config = origin.get("config") if isinstance(origin, dict) else None
    episodes = config.get("episodes", 0) if isinstance(config, dict) else 0
    name, tasks = settings.demos or target.demos or name_of(()), settings.task
    names = resolve_tasks(tasks) if tasks else ()
    asked = tasks if settings.demos else ()  # the target's own are recorded whole
    dataset = open_demos(settings.results, name, asked or target.tasks, episodes)
    check_spaces(dataset, target.actions, target.observation, "the target")
    if target.family == "compact" and target.cameras:
        camera = specs()[dataset.manifest.environment].camera_name(target.cameras[0])
        dataset = seen_by(dataset, camera, "the target sees", f"record them with world.camera.name={camera}")
    if dataset.manifest.environment == target.environment:
        check_tasks(dataset, names)
    recorded = list(dataset.manifest.tasks)
    trained = resolve_tasks(target.tasks) if target.tasks and not tasks else ()
    if set(recorded) - set(trained):
        tasks = tasks or [task for task in recorded if task in trained]
    return replace(settings, demos=name, task=tasks), dataset


def check_tasks(dataset: DemoDataset, names: Sequence[str]) -> None:
    """Refuses demonstrations that lack one of these tasks, by their full names.

    Raises:
        CheckpointError: the first one without an episode.
    """
    recorded = list(dict.fromkeys(entry.task for entry in dataset.episodes))
    for task in names:
        if task not in recorded:
            raise CheckpointError(
                f"the demonstrations in {dataset.path} hold no episode of {task}: leave task= out for those of "
                f"{', '.join(recorded)}, or record others with 'kerv demos task={task}' and name them by demos="
            )


def check_spaces(dataset: DemoDataset, actions: ActionSpace, observation: ObservationSpace, owner: str) -> None:
    """Refuses demonstrations of another environment. actions, observation: spaces of `owner`, e.g. "the target".

    Raises:
        CheckpointError: other actions or observations.
    """
    where = f"the demonstrations in {dataset.path}"
    dataset.manifest.actions.check_same(actions, where, owner)
    if observation.state and observation != dataset.manifest.observation:  # without a state it reads images alone
        raise CheckpointError(f"{where} have other observations than {owner}: they are of another environment")


def seen_by(dataset: DemoDataset, camera: str, who: str, remedy: str) -> DemoDataset:
    """The dataset with the views of `camera` alone, where further ones were recorded behind them. who, remedy: for the
    message.

    Raises:
        CheckpointError: its frames begin with other views.
    """
    recorded = dataset.manifest.config["camera"]["name"]
    if recorded == camera:
        return dataset
    if recorded.startswith(f"{camera}+"):
        return replace(dataset, views=len(views_of(camera)))
    raise CheckpointError(f"the demonstrations in {dataset.path} show camera {recorded}, {who} {camera}: {remedy}")


def subset(dataset: DemoDataset, tasks: Sequence[str]) -> DemoDataset:
    """Return the dataset with only the episodes of `tasks` (tasks and suites). No tasks: the whole dataset.

    Raises:
        UnknownName: no such task. CheckpointError: the dataset has none of a task.
    """
    if not tasks:
        return dataset
    names = resolve_tasks(tasks)
    check_tasks(dataset, names)
    return replace(dataset, episodes=[entry for entry in dataset.episodes if entry.task in names])
