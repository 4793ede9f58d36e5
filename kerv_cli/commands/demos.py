"""`kerv demos`: record the scripted experts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from kerv_cli.commands.common import Overrides, ShowConfig, ShowPlan, console, edge, progress_bar

if TYPE_CHECKING:
    from kerv_cli.environments.demos.dataset import DemoManifest


@edge
def demos(overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False) -> None:
    """Record successful expert episodes, plain and perturbed, as a dataset."""
    from kerv_cli.config import compose, to_yaml
    from kerv_cli.environments import resolve_tasks, spec_of
    from kerv_cli.settings import DemosSettings, as_plain

    settings = compose("demos", overrides or [], DemosSettings)
    tasks = resolve_tasks(settings.task)
    if cfg:
        typer.echo(to_yaml(settings), nl=False)
        return
    from kerv_cli.places import artifact

    folder = artifact(settings.results, "demos", settings.name or "-".join(settings.task).lower())
    if plan:
        steps = spec_of(tasks[0]).horizon / 6 * settings.episodes * len(tasks)  # experts are about that quick
        minutes = steps * (0.7 + 10 / settings.frame_stride) / 60_000 / settings.runtime.workers
        typer.echo(f"{len(tasks)} tasks x {settings.episodes} episodes -> {folder}, about {minutes:.0f} min (a guess)")
        return
    from kerv_cli.environments.camera import CameraConfig
    from kerv_cli.environments.demos.recording import DemoConfig, record

    config = DemoConfig(
        tasks=tasks,
        episodes=settings.episodes,
        first_seed=settings.seed,
        perturbed=settings.perturbed,
        camera=CameraConfig(**as_plain(settings.world.camera)),
        frame_stride=settings.frame_stride,
        workers=settings.runtime.workers,
        horizon=settings.world.horizon,
    )
    with progress_bar("demonstrations", settings.episodes * len(tasks)) as advance:
        manifest = record(config, folder, lambda done, total: advance(done, ""))
    _summary(manifest, folder)


def _summary(manifest: DemoManifest, folder: object) -> None:
    from rich.table import Table

    table = Table("task", "episodes", "mean steps", "failed seeds", title=f"demonstrations in {folder}")
    for name, row in manifest.tasks.items():
        table.add_row(name, str(len(row.episodes)), f"{row.mean_steps:.0f}", str(len(row.failed_seeds)))
    console().print(table)
