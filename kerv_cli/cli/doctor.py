"""`kerv doctor`: check this machine, and say how to fix each problem."""

from __future__ import annotations

from dataclasses import asdict

import typer

from kerv_cli.bench.doctor import DoctorSettings, check_environment_of, check_machine, check_policy
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, end_with_json, print_table


@command(
    "doctor",
    DoctorSettings,
    keys="target environment world.camera.size runtime.device runtime.threads results",
    examples=("kerv doctor", "kerv doctor target=mt10-vision"),
    # renamed, because Hydra would take target= as a choice among the files of conf/target
    typed={"target": "policy.target"},
    writes=False,
)
def doctor(settings: DoctorSettings, as_json: AsJson = False) -> None:
    """Check rendering, simulator, torch, shipped policies, disk and display; say how to fix each problem.

    With target=NAME or environment=NAME check only whether that target or environment behaves as kerv requires.
    """
    if settings.policy.target or settings.environment:
        findings = [*check_policy(settings), *check_environment_of(settings)]
    else:
        findings = check_machine(settings)
    failed = not all(finding.ok for finding in findings)
    if as_json:
        end_with_json([asdict(finding) for finding in findings], code=int(failed))
    print_table(("check", "", "finding"), ((f.what, "ok" if f.ok else "FAILS", f.says) for f in findings))
    raise typer.Exit(int(failed))
