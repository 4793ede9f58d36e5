"""`kerv prepare`: make all artifacts of a target that methods need, in the right order."""

from __future__ import annotations

import shlex

import typer

from kerv_cli.base.registry import ArtifactPart
from kerv_cli.cli.command import command
from kerv_cli.cli.common import ShowPlan, database_of, print_table, results_word
from kerv_cli.training.settings import PrepareSettings

NOT_OF_STEPS = ("for", "steps", "quick")  # not passed on to the commands of the single steps


@command(
    "prepare",
    PrepareSettings,
    keys="policy.target for demos task quick steps replace runtime.device results",
    typed={"for": "methods"},
)
def prepare(settings: PrepareSettings, overrides: list[str], plan: ShowPlan = False) -> None:
    """Make all artifacts of a target that methods need, in order: drafters, datastore, calibration.

    Existing artifacts are skipped. The same command continues after an interruption.

    Examples:
        kerv prepare policy.target=mine
        kerv prepare policy.target=mine quick=true --plan
    """
    from kerv_cli.cli.app import app
    from kerv_cli.training.preparation import THERE
    from kerv_cli.training.preparation import plan as planned

    database, name = database_of(settings), settings.policy.target
    steps = planned(settings, database)
    lines, rows = {}, []
    for step in steps:
        passed_on = (word for word in overrides if word.split("=")[0] not in NOT_OF_STEPS)
        lines[step.kind] = [*step.command, *passed_on]
        rows.append((step.kind, step.state, f"kerv {shlex.join(lines[step.kind])}"))
    print_table(("what", "state", "command"), rows, name)
    run = typer.main.get_command(app).main
    if plan:
        parts, made = ArtifactPart.every(), set[str]()
        for step in (step for step in steps if step.state != THERE):
            if made & {*parts[step.kind].needed(None)}:
                typer.echo(f"{step.kind}: its time is known when the steps before it are done")
            elif code := run([*lines[step.kind], "--plan"], standalone_mode=False):
                raise typer.Exit(code)
            made.add(step.kind)
        return
    for kind, line in lines.items():
        # planned again before each step: an artifact that was just made can make a later one outdated
        states = {step.kind: step.state for step in planned(settings, database)}
        if states[kind] != THERE:
            typer.echo(f"\nkerv {shlex.join(line)}")
            if code := run(line, standalone_mode=False):
                raise typer.Exit(code)
    typer.echo(f"\n{name} is ready: kerv sweep study=own policy.target={name}{results_word(overrides)}")
