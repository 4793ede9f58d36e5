"""`kerv bench`: what a target's decodes cost, against the device's limits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_json
from kerv_cli.base.settings import BenchSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import print_table

AsJson = Annotated[bool, typer.Option("--json", help="Print the whole result as JSON in the last line.")]
Compare = Annotated[
    tuple[Path, Path] | None, typer.Option("--compare", help="Compare two results instead of measuring one.")
]


@command(
    "bench",
    BenchSettings,
    keys="target dtype tokens repeats projected runtime.device runtime.dtype runtime.threads results",
    examples=("kerv bench", "kerv bench target=vla-150m dtype=bfloat16 projected=openvla-7b"),
    typed={"target": "model"},  # to Hydra target= would be a choice among the files of conf/target
)
def bench(settings: BenchSettings, as_json: AsJson = False, compare: Compare = None) -> None:
    """Measure what a target's decodes cost, against the device's limits; target= is a policy or a shape: vla-150m,
    smolvla, openvla-7b. 'kerv report study=NAME on=PROFILE' prices a study's decodes with it."""
    if compare is not None:
        _compare(*compare)
        return
    from kerv_cli.bench import report
    from kerv_cli.bench.run import card_of, open_timed, run, write

    model, machine, opened = open_timed(settings)
    card = card_of(model, machine, max(settings.tokens))
    print_table(("card", ""), report.card_rows(card), f"{model.name}, {model.dtype}".replace("torch.", ""))
    done = run(settings, model, machine, opened)
    typer.echo(
        f"cold start: opened in {opened:.1f} s, first prefill and token {done.cold['first_decode_seconds']:.2f} s"
    )
    print_table(report.PHASE_COLUMNS, report.phase_rows(done.phases), done.title)
    columns = [name for n in settings.tokens for name in (f"N = {n}", "ceiling", "with its drafter")]
    print_table(("method", *columns), report.ceiling_rows(done.ceilings), "speedup if every draft were accepted whole")
    flipped, compared = done.ties
    typer.echo(f"{flipped} of {compared} tokens differ between one verification and single tokens ({done.dtype})")
    for path in write(settings, done):
        typer.echo(str(path))
    if as_json:
        typer.echo(json.dumps(done.document(), allow_nan=False))


def _compare(a: Path, b: Path) -> None:
    from kerv_cli.bench.report import comparison_rows

    documents = {path: read_json(path) for path in (a, b)}
    for path, document in documents.items():
        if not isinstance(document, dict) or not {"phases", "target", "dtype"} <= set(document):
            raise CheckpointError(f"{path} is no result of 'kerv bench'")
    names = [f"{documents[path]['target']} {documents[path]['dtype']} ms" for path in (a, b)]
    print_table(("phase", *names, "ratio"), comparison_rows(documents[a], documents[b]), f"{a} and {b}")
