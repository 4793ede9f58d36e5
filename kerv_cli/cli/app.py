"""The `kerv` command. One thin module per command lies below `commands/`; nothing heavy is imported here."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from kerv_cli.cli import (
    bench,
    build,
    calibrate,
    completion,
    demos,
    doctor,
    report,
    rollout,
    runs,
    serve,
    sweep,
    train,
    view,
)

# Set before numpy loads: by default its products use every core, whatever runtime.threads says.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

app = typer.Typer(
    name="kerv",
    help="Fast vision-language-action policies on Meta-World: train, sweep, report, look.",
    epilog="Settings follow the command as key=value, e.g. kerv rollout method=spec_vla task=drawer-open threshold.r=5",
    no_args_is_help=True,
    add_completion=False,  # `kerv completion` installs a script for bash that knows of '='
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("demos")(demos.demos)
app.add_typer(train.app, name="train")
app.add_typer(build.app, name="build")
app.command("calibrate")(calibrate.calibrate)
app.command("rollout")(rollout.rollout)
app.command("sweep")(sweep.sweep)
app.command("serve")(serve.serve)
app.command("report")(report.report)
app.add_typer(runs.app, name="runs")
app.command("view")(view.view)
app.command("bench")(bench.bench)
app.command("doctor")(doctor.doctor)
app.command("completion")(completion.completion)


def _version(asked: bool) -> None:
    if asked:
        from kerv_cli.base.provenance import git_commit, versions

        names = ", ".join(f"{name} {number}" for name, number in versions().items())
        typer.echo(f"{names}, commit {git_commit()}")
        raise typer.Exit(0)


@app.callback()
def kerv(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print versions and stop.")
    ] = False,
) -> None:
    """Options of kerv itself."""


def main() -> None:
    """Entry point of the `kerv` script."""
    if (
        "_KERV_COMPLETE" in os.environ
    ):  # a shell asks for completions; typer registers its shells with add_completion only
        from typer._completion_classes import completion_init

        completion_init()
    app()


if __name__ == "__main__":
    main()
