"""`kerv build target`, `drafter` and `datastore`."""

from __future__ import annotations

from kerv_cli.base.errors import UsageError
from kerv_cli.base.paths import artifact
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, ShowPlan, as_planned, database_of, print_figures
from kerv_cli.targets import TargetPart
from kerv_cli.targets.settings import BuildTargetSettings
from kerv_cli.training.settings import BuildDatastoreSettings, BuildDrafterSettings


@command(
    "build target",
    BuildTargetSettings,
    keys="grow policy.target target checkpoint name statistics environment check results",
    typed={"target": "family", "policy.target": "base"},
)
def target(settings: BuildTargetSettings, as_json: AsJson = False) -> None:
    """Make a target from a published checkpoint, which is not copied, or from a policy by enlarging its trunk.

    Examples:
        kerv build target grow=150m policy.target=mt10-vision name=mt10-150m
        kerv build target checkpoint=models/libero name=libero statistics=libero_spatial crop=true
    """
    if settings.grow.width:
        settings.family = "grown"
    importer = TargetPart.find(settings.family, "target family").importer
    if importer is None:
        imported = ", ".join(name for name, part in TargetPart.every().items() if part.importer)
        raise UsageError(f"family={settings.family}: only {imported} is imported, others are trained")
    from kerv_cli.lab.runs import making

    with making(database_of(settings), "target", artifact(settings.results, "target", settings.name)):
        folder, figures = importer(settings)
    print_figures("target", figures, folder, as_json)


@command("build drafter", BuildDrafterSettings, keys="checkpoint policy.target policy.artifacts positions mask results")
def drafter(settings: BuildDrafterSettings, as_json: AsJson = False) -> None:
    """Import a drafter in the public EAGLE or Spec-VLA layout for a target.

    Examples:
        kerv build drafter checkpoint=models/eagle policy.target=openvla
        kerv build drafter checkpoint=models/eagle policy.target=openvla policy.artifacts.drafter=public mask=prompt
    """
    if not settings.checkpoint:
        raise UsageError("checkpoint=DIR: name the folder of a drafter (config.json, model.safetensors)")
    from kerv_cli.lab.runs import making
    from kerv_cli.methods.artifacts import Artifacts
    from kerv_cli.training.drafter import import_drafter

    folder = Artifacts(settings.results, settings.policy).new("drafter")
    with making(database_of(settings), "drafter", folder):
        folder, figures = import_drafter(settings)
    print_figures("drafter", figures, folder, as_json)


@command(
    "build datastore",
    BuildDatastoreSettings,
    keys="policy.target policy.artifacts demos task episodes key components half",
)
def datastore(settings: BuildDatastoreSettings, plan: ShowPlan = False, as_json: AsJson = False) -> None:
    """Store the demonstrations' action chunks with the target's features as search keys, for drafts by retrieval.

    Examples:
        kerv build datastore demos=mt10 policy.artifacts.datastore=mine
        kerv build datastore policy.target=mine demos=mine half=true --plan
    """
    from kerv_cli.training.datastore import build_datastore

    with as_planned(settings, plan, as_json) as (database, begin):
        folder, store = build_datastore(settings, database, begin)
    print_figures("datastore", {"entries": len(store.vectors), "tasks": len(store.shards)}, folder, as_json)
