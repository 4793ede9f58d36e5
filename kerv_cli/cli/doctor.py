"""`kerv doctor`: checks rendering, torch, policies and results, and names the remedy for each failure."""

from __future__ import annotations

import shutil
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from kerv_cli.base.errors import KervError, StorageError
from kerv_cli.base.files import visible
from kerv_cli.base.leftovers import left_over, remove
from kerv_cli.base.places import check_writable, find_target, results_dir, shipped_dir
from kerv_cli.base.settings import DoctorSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, print_json, print_table

if TYPE_CHECKING:
    from pathlib import Path

    from kerv_cli.worlds.spec import EnvironmentSpec

Repair = Annotated[
    bool, typer.Option("--repair", help="Remove what killed commands left in the results; set damaged cells aside.")
]


class Finding(NamedTuple):
    """The result of one check."""

    what: str
    ok: bool
    says: str


@command(
    "doctor",
    DoctorSettings,
    keys="world.camera.size runtime.device runtime.threads results",
    examples=("kerv doctor", "kerv doctor --repair"),
    writes=False,
)
def doctor(settings: DoctorSettings, repair: Repair = False, as_json: AsJson = False) -> None:
    """Check rendering, torch, the shipped policies and the results folder; say what to do about what is missing."""
    if repair:
        _repair(settings)
        return
    from kerv_cli.worlds import specs

    paths = _left_over(settings)
    says = f"{len(paths)} files of killed commands, kerv doctor --repair removes them" if paths else "nothing"
    findings = [
        *(_rendering(spec, settings) for spec in specs().values()),
        _torch(settings),
        *_policies(settings),
        _disk(settings),
        Finding("left over", True, says),
    ]
    if as_json:
        print_json([finding._asdict() for finding in findings])
    else:
        print_table(("check", "", "finding"), ((f.what, "ok" if f.ok else "FAILS", f.says) for f in findings))
    if not all(finding.ok for finding in findings):
        raise typer.Exit(1)


def _rendering(spec: EnvironmentSpec, settings: DoctorSettings) -> Finding:
    """Draws frames of a world and times them: a backend can load and still draw nothing."""
    from kerv_cli.worlds.camera import choose_backend

    what, first = f"rendering {spec.name}", next(iter(spec.suites.values()), tuple(spec.tasks))[0]
    try:
        backend = choose_backend()
        with spec.open_world(first, replace(settings.world.camera, name="")) as world:
            world.reset(settings.seed)
            world.frame()
            began = time.perf_counter()
            spread = [int(world.frame().std()) for _ in range(20)][-1]
            milliseconds = 1000 * (time.perf_counter() - began) / 20
    except KervError as error:
        return Finding(what, False, str(error))
    size = settings.world.camera.size
    if spread == 0:
        return Finding(what, False, f"{backend} draws empty frames: set MUJOCO_GL=osmesa and run 'kerv doctor' again")
    return Finding(what, milliseconds < 50, f"{backend}, {milliseconds:.1f} ms a frame at {size}x{size}")


def _torch(settings: DoctorSettings) -> Finding:
    import torch

    from kerv_cli.base.provenance import device_name
    from kerv_cli.base.runtime import set_up

    try:
        device, _ = set_up(settings.runtime)
    except KervError as error:
        return Finding("torch", False, str(error))
    cuda = "CUDA available" if torch.cuda.is_available() else "no CUDA device"
    return Finding("torch", True, f"{device}: {device_name(device)}, {torch.get_num_threads()} thread(s), {cuda}")


def _policies(settings: DoctorSettings) -> list[Finding]:
    from kerv_cli.targets.checkpoint import read_target

    findings = []
    for name in (path.name for path in visible(shipped_dir()) if path.is_dir()):
        try:
            described = read_target(find_target(settings.results, name))
            parameters = described.provenance.get("parameters")
            size = f"{parameters / 1e6:.1f} M parameters, " if isinstance(parameters, int | float) else ""
            findings.append(Finding(f"policy {name}", True, f"{size}{described.sha256[:12]}"))
        except KervError as error:
            findings.append(Finding(f"policy {name}", False, str(error)))
    return findings


def _disk(settings: DoctorSettings) -> Finding:
    folder = results_dir(settings.results)
    try:
        parent = check_writable(settings.results)
    except StorageError as error:
        return Finding("results", False, str(error))
    free = shutil.disk_usage(parent).free / 1e9
    return Finding("results", free > 2, f"{folder.resolve()} can be written, {free:.0f} GB free")


def _left_over(settings: DoctorSettings) -> list[Path]:
    """Temporary files and folders of dead processes, and claims and notes of dead sweeps, in the results."""
    from kerv_cli.lab.claims import void

    root = results_dir(settings.results)
    claims = [path for folder in sorted(root.glob("[!.]*/[!.]*/claims")) for path in void(folder)]
    return [*left_over(root), *claims]


def _repair(settings: DoctorSettings) -> None:
    """Removes the files of `_left_over` and prints their names; sets damaged cells aside."""
    from kerv_cli.lab.store import ROLLOUTS, STUDIES, stores

    paths = _left_over(settings)
    for path in paths:
        remove(path)
        typer.echo(f"removed {path}")
    remaining = [path for path in paths if path.exists()]
    if remaining:
        raise StorageError(f"{remaining[0]} cannot be removed: permission denied?")
    every = [store for family in (STUDIES, ROLLOUTS) for store in stores(results_dir(settings.results), family)]
    damages = [(store, name, error) for store in every for name, error in store.damages()]
    for store, name, error in damages:
        typer.echo(f"{str(error).split(': `')[0]}: it lies in {store.set_aside(name)} now, {store.how_to_run()}")
    aside = f", {len(damages)} damaged cells set aside" if damages else ""
    typer.echo(f"{len(paths)} left over files removed{aside}; everything else is complete or absent")
