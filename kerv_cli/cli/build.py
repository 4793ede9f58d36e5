"""`kerv build target`, `kerv build drafter` and `kerv build datastore`."""

from __future__ import annotations

import typer

from kerv_cli.base.errors import UsageError
from kerv_cli.cli import common
from kerv_cli.cli.common import Overrides, ShowConfig, ShowPlan, edge, progress_bar

HELP = "Build artifacts that need no training."

app = typer.Typer(help=HELP, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)


@app.callback(help=HELP)
def build() -> None:
    """The group: with a callback, its single command keeps its name."""


@app.command("target")
@edge
def target(overrides: Overrides = None, cfg: ShowConfig = False) -> None:
    """Check a published checkpoint and make it a target; its files stay where they are."""
    from kerv_cli.base.settings import BuildTargetSettings

    # here target=NAME is a registered family; to Hydra it would be a choice among the files of conf/target
    words = [f"family={o[7:]}" if o.startswith("target=") else o for o in overrides or []]
    settings = common.composed("build_target", words, BuildTargetSettings, cfg)
    from kerv_cli.base.registry import find, load, parts

    importers = {name: part for name, part in parts("target").items() if "importer" in part.traits}
    if find("target", settings.family, "target family").name not in importers:
        raise UsageError(f"family={settings.family}: only {', '.join(importers)} is imported, others are trained")
    folder, figures = load(importers[settings.family].traits["importer"])(settings)
    common.print_figures("target", figures, folder)


@app.command("drafter")
@edge
def drafter(overrides: Overrides = None, cfg: ShowConfig = False) -> None:
    """Check a drafter in the public EAGLE or Spec-VLA layout and copy it beside its target."""
    from kerv_cli.base.settings import BuildDrafterSettings

    settings = common.composed("build_drafter", overrides, BuildDrafterSettings, cfg)
    from kerv_cli.training.public_drafter import import_drafter

    folder, figures = import_drafter(settings)
    common.print_figures("drafter", figures, folder)


@app.command("datastore")
@edge
def datastore(overrides: Overrides = None, cfg: ShowConfig = False, plan: ShowPlan = False) -> None:
    """Store the demonstrations' action chunks under the target's own features, for retrieval."""
    from kerv_cli.base.settings import BuildDatastoreSettings

    settings = common.composed("build_datastore", overrides, BuildDatastoreSettings, cfg)
    from kerv_cli.training.datastore import DatastoreBuild, leave_one_out

    run = DatastoreBuild(settings)
    if plan:
        common.print_plan(run.plan())
    with progress_bar("encoding demonstrations") as advance:
        store = run.build(advance)
    figures = {"entries": len(store.vectors), "tasks": len(store.shards), **leave_one_out(store)}
    common.print_figures("datastore, nearest neighbour in another episode", figures, run.folder)
