"""`kerv bench`: what a target's decodes cost, against the device's limits."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from kerv_cli.bench.settings import BenchSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import print_table

if TYPE_CHECKING:
    from kerv_cli.bench.ceilings import MethodCeiling
    from kerv_cli.bench.phases import Phase

AsJson = Annotated[bool, typer.Option("--json", help="Print the whole result as JSON in the last line.")]


@command(
    "bench",
    BenchSettings,
    keys="target dtype tokens repeats projected runtime.device runtime.dtype runtime.threads results",
    examples=("kerv bench", "kerv bench target=vla-150m dtype=bfloat16 projected=openvla-7b"),
    typed={"target": "model"},  # to Hydra target= would be a choice among the files of conf/target
)
def bench(settings: BenchSettings, as_json: AsJson = False) -> None:
    """Measure what a target's decodes cost, against the device's limits; target= is a policy or a shape: vla-150m,
    smolvla, openvla-7b. 'kerv report study=NAME on=PROFILE' prices a study's decodes with it."""
    from kerv_cli.bench.machine import measure_machine
    from kerv_cli.bench.model import open_model
    from kerv_cli.bench.run import card_of, run, write

    model = open_model(settings)
    machine = measure_machine(model.target.device, model.dtype)
    card = card_of(model, machine, max(settings.tokens))
    print_table(("card", ""), _card_rows(card), f"{model.name}, {model.dtype}".replace("torch.", ""))
    done = run(settings, model, machine)
    print_table(_PHASE_COLUMNS, _phase_rows(done.phases), done.title)
    columns = [name for n in settings.tokens for name in (f"N = {n}", "ceiling", "with its drafter")]
    print_table(("method", *columns), _ceiling_rows(done.ceilings), "speedup if every draft were accepted whole")
    for path in write(settings, done):
        typer.echo(str(path))
    if as_json:
        typer.echo(json.dumps(done.document(), allow_nan=False))


def _card_rows(card: Mapping[str, float]) -> list[tuple[str, str]]:
    """Sizes of the target, rates of the device and the floors that follow, before the target is measured."""
    return [
        ("weights that a forward reads", f"{card['weights'] / 1e6:.1f} M, {card['weight_bytes'] / 1e6:.1f} MB"),
        ("cache of prompt and chunk", f"{card['cache_bytes'] / 1e6:.2f} MB"),
        ("bandwidth, measured", f"{card['bandwidth'] / 1e9:.1f} GB/s"),
        ("products, measured", f"{card['flops'] / 1e9:.0f} GFLOP/s"),
        ("floor of one token", f"{1e3 * card['floor_token']:.2f} ms"),
        ("floor of a verification of N", f"{1e3 * card['floor_verify']:.2f} ms"),
        ("floor of the prefill", f"{1e3 * card['floor_prefill']:.2f} ms"),
        ("floor of prefill and N", f"{1e3 * card['floor_both']:.2f} ms"),
    ]


def _phase_rows(phases: Sequence[Phase]) -> list[tuple[str, ...]]:
    """One row per phase: times in milliseconds, rates, share of the device's rate."""
    rows: list[tuple[str, ...]] = []
    for phase in phases:
        limited = phase.floor > 0
        rates = (f"{phase.read / phase.seconds / 1e9:.1f}", f"{phase.flops / phase.seconds / 1e9:.0f}")
        times = (f"{1e3 * phase.seconds:.2f}", f"{1e3 * phase.p95:.2f}", f"{1e3 * phase.least:.2f}")
        floor = (f"{1e3 * phase.floor:.2f}", f"{100 * phase.share:.0f}") if limited else ("–", "–")
        rows.append((phase.name, *times, *(rates if limited else ("–", "–")), *floor))
    return rows


_PHASE_COLUMNS = ("phase", "median ms", "p95", "least", "GB/s", "GFLOP/s", "floor ms", "share %")


def _ceiling_rows(by_tokens: Mapping[int, Sequence[MethodCeiling]]) -> list[tuple[str, ...]]:
    """One row per method, two columns per N."""
    by_method: dict[str, list[str]] = {}
    for ceilings in by_tokens.values():
        for ceiling in ceilings:
            row = by_method.setdefault(ceiling.method, [])
            row += [ceiling.how, f"{ceiling.free:.2f}", f"{ceiling.drafted:.2f}"]
    return [(method, *row) for method, row in by_method.items()]
