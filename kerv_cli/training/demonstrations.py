"""Which demonstrations a command learns from: one dataset, or several that add up."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.places import artifact, find_target, results_dir
from kerv_cli.base.settings import DEFAULT_TASKS, DemonstrationSettings
from kerv_cli.targets.checkpoint import TargetDescription, described
from kerv_cli.worlds import resolve_tasks
from kerv_cli.worlds.demos.dataset import DemoDataset


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
            if folder.is_dir():
                raise
            remedy = _remedy(results, folder, tasks, episodes)
            raise CheckpointError(f"no demonstrations in {folder}: {remedy}") from error
    return DemoDataset.joined(datasets)


def _remedy(results: str, folder: Path, tasks: Sequence[str], episodes: int) -> str:
    name = [] if folder.name == name_of(tasks) else [f"name={folder.name}"]
    task = [f"task={tasks[0]}" if len(tasks) == 1 else f"task=[{','.join(tasks)}]"] if tasks else []
    words = [*name, *task, *([f"episodes={episodes}"] if episodes else [])]
    there = sorted(path.parent.name for path in (results_dir(results) / "artifacts/demos").glob("*/manifest.json"))
    others = f", or name others: demos={' or demos='.join(there)}" if there else ""
    return f"record them with '{' '.join(['kerv demos', *words])}'{others}"


def demos_for(settings: DemonstrationSettings) -> DemoDataset:
    """The demonstrations that something is made from for a target: those that it was trained on, where none are named.
    Fills what the settings leave open: their name, and, where they have tasks that the target does not know, the tasks
    that it does; no task stands for all.

    Raises:
        UsageError: no such target. CheckpointError: as `open_demos`.
    """
    folder = find_target(settings.results, settings.policy.target)
    target = described(folder, "target", TargetDescription)
    tasks = settings.task or target.tasks
    recorded = target.provenance.get("demos") if not settings.demos else None
    config = recorded.get("config") if isinstance(recorded, dict) else None
    episodes = config.get("episodes", 0) if isinstance(config, dict) else 0
    settings.demos = settings.demos or target.demos or name_of(())
    dataset = open_demos(settings.results, settings.demos, tasks, episodes)
    there = list(dataset.manifest.tasks)
    same = dataset.manifest.environment == target.environment  # else the spaces differ, which is said instead
    for task in resolve_tasks(settings.task) if settings.task and same else ():
        if task not in there:
            raise CheckpointError(
                f"the demonstrations in {dataset.path} hold no episode of {task}: leave task= out for those of "
                f"{', '.join(there)}, or record others with 'kerv demos task={task}' and name them by demos="
            )
    known = resolve_tasks(target.tasks) if target.tasks and not settings.task else ()
    if set(there) - set(known):
        settings.task = settings.task or [task for task in there if task in known]
    return dataset
