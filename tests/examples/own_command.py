"""A command from outside: `kerv seeds`, registered by `KERV_PLUGINS=examples.own_command`."""

from __future__ import annotations

from dataclasses import dataclass

import typer

from kerv_cli.base.limits import choice, number
from kerv_cli.base.settings import TaskSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, end_with_json
from kerv_cli.worlds.settings import EVALUATION_SEED


@dataclass
class SeedsSettings(TaskSettings):
    """`kerv seeds`."""

    episodes: int = number(3, 1, 100, help="seeds per task")
    use: str = choice("evaluation", "evaluation", "demonstrations", help="what the seeds are for")


@command("seeds", SeedsSettings, keys="task episodes use")
def seeds(settings: SeedsSettings, as_json: AsJson = False) -> None:
    """Print the seeds of a task's episodes.

    Examples:
        kerv seeds task=reach
        kerv seeds use=demonstrations episodes=10 --json
    """
    from kerv_cli.worlds import resolve_tasks

    first = EVALUATION_SEED if settings.use == "evaluation" else 0
    numbers = {task: list(range(first, first + settings.episodes)) for task in resolve_tasks(settings.task)}
    if as_json:
        end_with_json(numbers)
    for task, one in numbers.items():
        typer.echo(f"{task}: {one[0]} to {one[-1]}")
