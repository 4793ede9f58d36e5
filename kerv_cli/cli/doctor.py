"""`kerv doctor`: check this machine, a target or an environment, and say how to fix each problem."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import starmap
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import typer

from kerv_cli.base.durations import count
from kerv_cli.base.errors import UnknownName
from kerv_cli.base.files import visible
from kerv_cli.base.limits import number, setting
from kerv_cli.base.paths import check_writable, find_target, results_dir, shipped_dir
from kerv_cli.base.settings import RunSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, database_of, end_with_json, print_table
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.worlds.findings import Finding, find, need
from kerv_cli.worlds.settings import EVALUATION_SEED, WorldSettings

if TYPE_CHECKING:
    from kerv_cli.worlds.spec import EnvironmentSpec


@dataclass
class DoctorSettings(RunSettings):
    """Settings of `kerv doctor`. If a target or an environment is given, nothing else is checked."""

    groups: ClassVar = {"world": "default", "runtime": "cpu"}

    policy: PolicySettings = setting(lambda: PolicySettings(target=""), "the target to check")
    environment: str | None = setting(None, "the environment to check")
    seed: int = number(EVALUATION_SEED, 0, 2**31 - 1, help="seed of the scene that is rendered")
    world: WorldSettings = setting(WorldSettings, "camera and length of an episode")


@command(
    "doctor",
    DoctorSettings,
    keys="target environment world.camera.size runtime.device runtime.threads results",
    typed={"target": "policy.target"},
    writes=False,
)
def doctor(settings: DoctorSettings, as_json: AsJson = False) -> None:
    """Check rendering, simulator, torch, shipped policies and disk; say how to fix each problem.

    With target=NAME or environment=NAME check only whether that target or environment behaves as kerv requires.

    Examples:
        kerv doctor
        kerv doctor target=mt10-h1
    """
    findings: list[Finding] = []
    if settings.policy.target:
        findings += check_policy(settings)
    if settings.environment:
        from kerv_cli.worlds import specs
        from kerv_cli.worlds.conformance import check_environment

        if settings.environment not in specs():
            raise UnknownName("environment", settings.environment, specs())
        findings += check_environment(specs()[settings.environment], settings.seed)
    if not settings.policy.target and not settings.environment:
        findings = check_machine(settings)
    failed = not all(one.ok for one in findings)
    if as_json:
        end_with_json(list(map(asdict, findings)), code=int(failed))
    print_table(("check", "", "finding"), ((one.what, "ok" if one.ok else "FAILS", one.says) for one in findings))
    raise typer.Exit(int(failed))


def check_machine(settings: DoctorSettings) -> list[Finding]:
    from kerv_cli.targets.provenance import versions
    from kerv_cli.worlds import specs

    checks: dict[str, Callable[[], str]] = {}
    for spec in specs().values():
        checks[f"rendering {spec.name}"] = partial(_rendering, spec, settings)
    checks["torch"] = partial(_torch, settings)
    for folder in filter(Path.is_dir, visible(shipped_dir())):
        checks[f"policy {folder.name}"] = partial(_policy, folder.name, settings)
    checks |= {"results": partial(_disk, settings), "database": partial(_database, settings)}
    return [Finding("versions", True, ", ".join(map(" ".join, versions().items()))), *starmap(find, checks.items())]


def check_policy(settings: DoctorSettings) -> list[Finding]:
    """Check on a random observation whether the target behaves as the engine requires."""
    import numpy as np

    from kerv_cli.base.runtime import set_up
    from kerv_cli.base.spaces import Observation
    from kerv_cli.methods.artifacts import Artifacts
    from kerv_cli.targets.conformance import check_target
    from kerv_cli.worlds.views import frame_shape

    device, _ = set_up(settings.runtime)
    artifacts = Artifacts(settings.results, settings.policy, device=device, dtype=settings.runtime.dtype)
    described, random = artifacts.description, np.random.default_rng(settings.seed)
    size, space = int(described.settings.get("image_size", settings.world.camera.size)), described.observation
    images = {name: random.integers(0, 256, frame_shape(name, size), dtype=np.uint8) for name in described.cameras}
    state = random.normal(size=space.state)
    words = " ".join(described.words[:3]) or "move"
    return check_target(artifacts.target, Observation(state[: len(space.proprioception)], state, words, images))


def _rendering(spec: EnvironmentSpec, settings: DoctorSettings) -> str:
    from kerv_cli.worlds.mujoco_world import choose_backend

    if not spec.installed:
        return f"not installed: pip install 'kerv[{spec.extra}]'"
    backend, first = choose_backend(), next(iter(spec.suites.values()), tuple(spec.tasks))[0]
    with spec.open_world(first, replace(settings.world.camera, name="")) as world:
        world.reset(settings.seed)
        spread = int(world.frame().std())  # a broken OpenGL backend can load without an error and render nothing
    need(spread, f"{backend} draws empty frames: set MUJOCO_GL=osmesa and run 'kerv doctor' again")
    return backend


def _torch(settings: DoctorSettings) -> str:
    import torch

    from kerv_cli.base.runtime import set_up
    from kerv_cli.targets.provenance import device_name

    device, _ = set_up(settings.runtime)
    cuda = "CUDA available" if torch.cuda.is_available() else "no CUDA device"
    return f"{device}: {device_name(device)}, {count(torch.get_num_threads(), 'thread')}, {cuda}"


def _policy(name: str, settings: DoctorSettings) -> str:
    from kerv_cli.targets.checkpoint import read_target

    described = read_target(find_target(settings.results, name))
    parameters = described.provenance.get("parameters")
    size = f"{parameters / 1e6:.1f} M parameters, " if isinstance(parameters, int | float) else ""
    return f"{size}{described.sha256[:12]}"


def _disk(settings: DoctorSettings) -> str:
    free = shutil.disk_usage(check_writable(settings.results)).free / 1e9
    says = f"{results_dir(settings.results).resolve()} can be written, {free:.0f} GB free"
    need(free > 2, says)
    return says


def _database(settings: DoctorSettings) -> str:
    from kerv_cli.lab.runs import run_rows

    database = database_of(settings)
    rows = len(run_rows(database))
    what = "PostgreSQL" if database.file is None else "SQLite"
    says = f"{count(rows, 'command')} in it" if database.exists else "made by the first command that needs it"
    return f"{what}, {database.shown}: {says}"
