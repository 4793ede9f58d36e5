"""`kerv build datastore`."""

from __future__ import annotations

import typer

from kerv_cli.commands.common import Overrides, ShowConfig, ShowPlan, composed, console, edge, print_plan, progress_bar

app = typer.Typer(
    help="Build what is not trained.", no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False
)


@app.callback()
def build() -> None:
    """Build what is not trained."""  # with a callback, a single command keeps its name


@app.command("datastore")
@edge
def datastore(overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False) -> None:
    """Store the demonstrations' action chunks under the target's own features, for retrieval."""
    from kerv_cli.settings import BuildDatastoreSettings

    settings = composed("build_datastore", overrides, BuildDatastoreSettings, cfg)
    from kerv_cli.training.datastore import DatastoreBuild, leave_one_out

    run = DatastoreBuild(settings)
    if plan:
        print_plan(run.plan())
    with progress_bar("encoding demonstrations", 1000) as advance:
        store = run.build(lambda done, total: advance(1000 * done // total, ""))
    _summary({"entries": len(store.vectors), "tasks": len(store.shards), **leave_one_out(store)}, run.folder)


def _summary(figures: dict[str, float], folder: object) -> None:
    from rich.table import Table

    table = Table("datastore, nearest neighbour in another episode", str(folder))
    for name, value in figures.items():
        table.add_row(name, f"{value:.4g}" if isinstance(value, float) else str(value))
    console().print(table)
