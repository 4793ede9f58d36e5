"""`kerv bench`: measure how long a target's decodes take, compared with what the device could do at best."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from kerv_cli.bench.settings import BenchSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import print_rows

AsJson = Annotated[bool, typer.Option("--json", help="Also print the whole result as JSON, in the last line.")]


@command(
    "bench",
    BenchSettings,
    keys="target dtype tokens repeats projected runtime.device runtime.dtype runtime.threads results",
)
def bench(settings: BenchSettings, as_json: AsJson = False) -> None:
    """Measure how long a target's decodes take, compared with what the device could do at best.

    target= is a policy, or a shape with random weights: vla-150m, smolvla, openvla-7b. 'kerv report study=NAME
    on=PROFILE' estimates from the profile how long a study's decodes would take. projected=openvla-7b computes profiles
    for GPUs that are not here.

    Examples:
        kerv bench target=vla-150m
        kerv bench projected=openvla-7b
    """
    if settings.projected != "none":
        _project(settings, as_json)
        return
    from kerv_cli.bench.measure import document, launches_per_token, measure, phase_rows, title_of
    from kerv_cli.bench.model import open_model

    model = open_model(settings)
    phases, launched = measure(model, settings), launches_per_token(model)
    print_rows(list(phase_rows(phases)), title_of(model))
    if launched is not None:
        typer.echo(f"{launched:.1f} launches on the GPU per token, with graphs counted as one")
    result = document(model, phases, launched)
    _write(settings, f"{model.name.rstrip('/').rsplit('/', 1)[-1]}-{result['dtype']}", result)
    if as_json:
        typer.echo(json.dumps(result, allow_nan=False))


def _project(settings: BenchSettings, as_json: bool) -> None:
    from kerv_cli.bench.projections import projection_rows, projections

    computed = list(projections(settings))
    print_rows(list(projection_rows(computed)), f"{settings.projected}, computed, not measured")
    for one in computed:
        _write(settings, f"{one.name}-profile", one.document)
    if as_json:
        typer.echo(json.dumps({one.name: one.document for one in computed}, allow_nan=False))


def _write(settings: BenchSettings, name: str, document: dict[str, Any]) -> None:
    from kerv_cli.base.files import write_json
    from kerv_cli.base.paths import results_dir

    path = results_dir(settings.results) / "bench" / f"{name}.json"
    write_json(path, document)
    typer.echo(str(path))
