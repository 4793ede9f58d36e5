"""The `kerv` command. One thin module per command lies below `commands/`; nothing heavy is imported here."""

from __future__ import annotations

import os

import typer

from kerv_cli.commands import bench, build, calibrate, demos, doctor, report, rollout, serve, sweep, train, view

# Set before numpy loads: by default its products use every core, whatever runtime.threads says.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

app = typer.Typer(
    name="kerv",
    help="Fast vision-language-action policies on Meta-World: train, sweep, report, look.",
    epilog="Settings follow the command as key=value, e.g. kerv rollout method=spec_vla task=drawer-open threshold.r=5",
    no_args_is_help=True,
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
app.command("view")(view.view)
app.command("bench")(bench.bench)
app.command("doctor")(doctor.doctor)


def main() -> None:
    """Entry point of the `kerv` script."""
    app()


if __name__ == "__main__":
    main()
