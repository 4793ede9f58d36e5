"""`kerv demos`: record the scripted experts."""

from __future__ import annotations

from kerv_cli.commands.common import (
    Overrides,
    ShowConfig,
    ShowPlan,
    composed,
    edge,
    print_plan,
    print_table,
    progress_bar,
)


@edge
def demos(overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False) -> None:
    """Record successful expert episodes, plain and perturbed, as a dataset."""
    from kerv_cli.errors import Interrupted
    from kerv_cli.settings import DemosSettings, as_plain

    settings = composed("demos", overrides, DemosSettings, cfg)
    from kerv_cli.environments import resolve_tasks, spec_of
    from kerv_cli.places import artifact

    tasks = resolve_tasks(settings.task)
    folder = artifact(settings.results, "demos", settings.name or "-".join(settings.task).lower())
    if plan:
        steps = spec_of(tasks[0]).horizon / 6 * settings.episodes * len(tasks)  # experts are about that quick
        minutes = steps * (0.7 + 10 / settings.frame_stride) / 60_000 / settings.runtime.workers
        print_plan(f"{len(tasks)} tasks x {settings.episodes} episodes -> {folder}, about {minutes:.0f} min (a guess)")
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
    try:
        with progress_bar("demonstrations") as advance:
            manifest = record(config, folder, advance)
    except KeyboardInterrupt:
        raise Interrupted(
            f"interrupted: finished episodes are kept in {folder}, the same command goes on there"
        ) from None
    rows = ((n, len(row.episodes), f"{row.mean_steps:.0f}", len(row.failed_seeds)) for n, row in manifest.tasks.items())
    print_table(("task", "episodes", "mean steps", "failed seeds"), rows, f"demonstrations in {folder}")
