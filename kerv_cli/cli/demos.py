"""`kerv demos`: record demonstrations of scripted experts, and import LeRobot datasets."""

from __future__ import annotations

from pathlib import Path

from kerv_cli.base.errors import Interrupted, UsageError
from kerv_cli.base.paths import artifact
from kerv_cli.cli.command import command
from kerv_cli.cli.common import ShowPlan, database_of, made, print_table, progress_bar
from kerv_cli.training.settings import DemosSettings
from kerv_cli.worlds.settings import DemosImportSettings


@command(
    "demos", DemosSettings, keys="name task episodes seed perturbed policy world.camera.name runtime.workers results"
)
def demos(settings: DemosSettings, plan: ShowPlan = False) -> None:
    """Record successful episodes of the scripted experts, some of them disturbed, as a dataset.

    With policy=NAME a policy acts instead, and the expert labels the states that it reaches (DAgger).

    Examples:
        kerv demos name=mine task=MT10 episodes=100
        kerv demos name=visited policy=vision task=reach --plan
    """
    from kerv_cli.training.demonstrations import plan_demos

    database, planned = database_of(settings), plan_demos(settings)
    try:
        with made(planned, database, plan) as (folder, manifest):
            pass
    except KeyboardInterrupt:
        kept = f"finished episodes are kept in {planned.path}, the same command goes on there"
        raise Interrupted(f"interrupted: {kept}") from None
    rows = ((n, len(row.episodes), f"{row.mean_steps:.0f}", len(row.failed_seeds)) for n, row in manifest.tasks.items())
    print_table(("task", "episodes", "mean steps", "failed seeds"), rows, f"demonstrations in {folder}")


@command("demos import", DemosImportSettings, keys="source name environment camera episodes dofs strict tail results")
def import_demos(settings: DemosImportSettings) -> None:
    """Read a LeRobot dataset as demonstrations.

    Examples:
        kerv demos import source=datasets/aloha name=aloha
        kerv demos import source=datasets/spatial dofs=openvla episodes=50
    """
    from kerv_cli.lab.runs import making
    from kerv_cli.worlds.demos.lerobot import import_lerobot

    if not settings.source:
        raise UsageError("source=DIR: name the folder of a LeRobot dataset")
    folder = artifact(settings.results, "demos", settings.name or Path(settings.source).name)
    with making(database_of(settings), "demos", folder) as made, progress_bar("import", made) as advance:
        manifest = import_lerobot(settings, folder, advance).manifest
    rows = ((name, len(row.episodes), f"{row.mean_steps:.0f}") for name, row in manifest.tasks.items())
    title = f"demonstrations in {folder}" + ("" if settings.environment else f", suite {manifest.environment.upper()}")
    print_table(("task", "episodes", "mean steps"), rows, title)
