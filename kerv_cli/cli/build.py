"""`kerv build target` and `datastore`."""

from __future__ import annotations

from functools import partial
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import owned, write_folder
from kerv_cli.base.paths import check_free, find_target, new_target
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, ShowPlan, database_of, made, print_figures
from kerv_cli.targets import TargetPart
from kerv_cli.targets.settings import BuildTargetSettings
from kerv_cli.training.settings import BuildDatastoreSettings


@command(
    "build target",
    BuildTargetSettings,
    keys="grow policy.target target checkpoint name statistics environment replace results",
    typed={"target": "family", "policy.target": "base"},
)
def target(settings: BuildTargetSettings, as_json: AsJson = False) -> None:
    """Make a target from a published checkpoint, which is not copied, or from a policy by enlarging its trunk.

    Examples:
        kerv build target grow=150m policy.target=mt10-h1 name=mt10-150m
        kerv build target checkpoint=models/libero name=libero statistics=libero_spatial crop=true
    """
    if settings.grow.width:
        settings.family = "grown"
    importer = TargetPart.find(settings.family, "target family").importer
    if importer is None:
        imported = ", ".join(name for name, part in TargetPart.every().items() if part.importer)
        raise UsageError(f"family={settings.family}: only {imported} is imported, others are trained")
    from kerv_cli.lab.runs import making

    folder = new_target(settings.results, settings.name)
    if settings.grow.width and find_target(settings.results, settings.base).resolve() == folder.resolve():
        raise UsageError(f"name={settings.name}: a target cannot grow from itself, choose another name=")

    check, figures = partial(check_free, folder, "name", settings.replace), dict[str, Any]()
    check()
    with making(database_of(settings), "target", folder), owned(folder, check):
        write_folder(folder, lambda new: figures.update(importer(settings, new)))
    print_figures("target", figures, folder, as_json)


@command(
    "build datastore",
    BuildDatastoreSettings,
    keys="policy.target policy.artifacts demos task episodes key components half replace",
)
def datastore(settings: BuildDatastoreSettings, plan: ShowPlan = False, as_json: AsJson = False) -> None:
    """Store the demonstrations' action chunks with the target's features as search keys, for drafts by retrieval.

    Examples:
        kerv build datastore demos=mt10 policy.artifacts.datastore=mine
        kerv build datastore policy.target=mine demos=mine half=true --plan
    """
    from kerv_cli.training.datastore import plan_datastore

    database = database_of(settings)
    with made(plan_datastore(settings, database), database, plan, as_json) as (folder, store):
        pass
    print_figures("datastore", {"entries": len(store.vectors), "tasks": len(store.shards)}, folder, as_json)
