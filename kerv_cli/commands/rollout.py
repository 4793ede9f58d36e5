"""`kerv rollout`: episodes of one method, their figures and their Rerun files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from kerv_cli.commands.common import (
    Overrides,
    ShowConfig,
    ShowPlan,
    called,
    edge,
    print_notes,
    print_table,
    progress_bar,
)

if TYPE_CHECKING:
    from pathlib import Path

    from kerv_cli.decoding.record import EpisodeRecord
    from kerv_cli.settings import RolloutSettings

Many = Annotated[bool, typer.Option("-m", "--multirun", help="Comma lists form a grid; every point is run.")]


@edge
def rollout(
    overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False, multirun: Many = False
) -> None:
    """Run episodes of one method; print success, forwards, acceptance and time; write one .rrd per episode."""
    from kerv_cli.config import compose, expand, to_yaml
    from kerv_cli.effects import without_effect
    from kerv_cli.settings import RolloutSettings

    points = expand(overrides or []) if multirun else [list(overrides or [])]
    for point in points:
        settings = compose("rollout", point, RolloutSettings)
        if cfg:
            typer.echo(to_yaml(settings), nl=False)
            continue
        if multirun:
            typer.echo(" ".join(point))
        print_notes(without_effect(settings, point))
        _run(settings, plan)


def _run(settings: RolloutSettings, plan: bool) -> None:
    from kerv_cli.environments import resolve_tasks, settled, spec_of

    tasks = resolve_tasks(settings.task)
    settings.world = settled(settings.world, spec_of(tasks[0]))
    from kerv_cli.rollouts.policy import check
    from kerv_cli.rollouts.run import close_worlds, run_task

    check(settings)
    total = len(tasks) * settings.episodes
    if plan:
        typer.echo(
            f"{settings.method}: {len(tasks)} tasks x {settings.episodes} episodes, about {3 * total} s (a guess)"
        )
        return
    from kerv_cli.places import results_dir

    folder = results_dir(settings.results) / "rollouts" / settings.method
    seeds = range(settings.seed, settings.seed + settings.episodes)
    records: list[EpisodeRecord] = []
    files: list[Path] = []
    with progress_bar(settings.method) as advance:
        for name in tasks:
            for record in run_task(settings, name, seeds):
                if record.frames:
                    from kerv_cli.viewing.rerun_log import save_episode  # only a recording needs rerun

                    path = folder / f"{record.task}-{record.seed}.rrd"
                    files.append(save_episode(record, path, method=settings.method))
                records.append(record)
                advance(len(records), total, f"{name} {'success' if record.success else 'failure'}")
    close_worlds()
    _summary(settings, tasks, records)
    if files:
        typer.echo(f"{len(files)} rollouts in {folder}; open one with: {called()} view {files[0]}")


def _summary(settings: RolloutSettings, tasks: tuple[str, ...], records: list[EpisodeRecord]) -> None:
    from kerv_cli.rollouts.policy import identity_of

    seen = identity_of(settings)["observation"]
    last = settings.seed + settings.episodes - 1
    names = (*tasks, "all") if len(tasks) > 1 else tasks
    rows = [(name, *_figures([r for r in records if name in ("all", r.task)])) for name in names]
    headers = ("task", "success", "steps", "forwards/step", "AL", "accepted/round", "ms/step")
    print_table(headers, rows, f"{settings.method}, observation {seen}, seeds {settings.seed}…{last}")
    decodes = [d for r in records for d in r.decodes]
    total = sum(d.seconds for d in decodes)
    seconds = {phase: sum(d.phases[phase] for d in decodes) for phase in decodes[0].phases}
    rows = [(phase, f"{1000 * s / len(decodes):.2f}", f"{s / total:.0%}") for phase, s in seconds.items()]
    print_table(("phase", "ms per decode", "share"), rows, "time by phase")


def _figures(records: list[EpisodeRecord]) -> list[str]:
    steps = sum(r.steps for r in records)
    rounds = [x for r in records for d in r.decodes for x in d.rounds if x.is_verification]
    per_round = [
        f"{sum(getattr(x, field) for x in rounds) / len(rounds):.2f}" if rounds else "–"
        for field in ("committed", "accepted")
    ]
    return [
        f"{sum(r.success for r in records)}/{len(records)}",
        f"{steps / len(records):.0f}",
        f"{sum(r.forwards for r in records) / steps:.2f}",
        *per_round,
        f"{1000 * sum(r.seconds / r.steps for r in records) / len(records):.2f}",
    ]
