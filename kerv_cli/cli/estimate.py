"""`kerv estimate`: what speculation can give a policy that is described by its size. Nothing is run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

from kerv_cli.bench.settings import EstimateSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, end_with_json, print_rows, print_table

if TYPE_CHECKING:
    from kerv_cli.bench.described import Described
    from kerv_cli.bench.estimate import Costs, Estimate


@command(
    "estimate",
    EstimateSettings,
    keys="weights model tokens prompt vision hz device on trace choose",
    examples=("kerv estimate weights=7B tokens=7 device=h100", "kerv estimate trace=FILE on=PROFILE"),
    writes=False,
)
def estimate(settings: EstimateSettings, as_json: AsJson = False) -> None:
    """Say whether speculative decoding can help a policy: costs of an action, and speeds that methods can reach.

    weights=7B describes a policy by its size; model= reads a config.json or a target. A policy without action tokens
    has tokens=0. on=PROFILE takes measured costs. trace=FILE prices recorded decodes; choose=draft says which length of
    chains is the fastest for them.
    """
    from kerv_cli.bench.described import described
    from kerv_cli.bench.estimate import NO_TOKENS, Estimate, check_tokens

    if settings.trace:
        _trace(settings, as_json)
        return
    policy = None if settings.on and settings.tokens != 0 else described(settings)
    if policy and policy.shape is None:
        if as_json:
            end_with_json({"applies": False, "reason": NO_TOKENS})
        typer.echo(NO_TOKENS)
        return
    tokens = policy.tokens if policy else 7 if settings.tokens is None else settings.tokens
    found = {}
    for title, costs in _costs(settings, policy).items():
        for one in costs:
            check_tokens(one.engine, one.profile, tokens)
        found[title] = [Estimate(one, tokens) for one in costs]
    if as_json:
        end_with_json({"applies": True, "machines": [_row(settings, policy, *one) for one in found.items()]})
    for title, estimates in found.items():
        _print(settings, policy, title, estimates)


def _costs(settings: EstimateSettings, policy: Described | None) -> dict[str, list[Costs]]:
    """Return the costs on each machine, with each engine or of a profile, by the machine's title."""
    from kerv_cli.bench.estimate import Costs, computed
    from kerv_cli.bench.physics import DEVICES

    if policy is not None:
        devices = [DEVICES[name] for name in settings.device]
        return {device.title: computed(policy, device) for device in devices}
    from kerv_cli.report.reprice import open_profiles

    profiles = open_profiles(settings.results, settings.on)
    return {one.title: [Costs(one.name, one.profile, {})] for one in profiles}


def _row(settings: EstimateSettings, policy: Described | None, title: str, estimates: list[Estimate]) -> dict[str, Any]:
    from kerv_cli.bench.estimate import document, notes, rate, sentence

    about = {"machine": title, "tokens": estimates[0].tokens, "engines": document(estimates)}
    hz = {"rate": rate(estimates, settings.hz, settings.actions)} if settings.hz else {}
    return {**about, "notes": notes(policy, estimates), **hz, "sentence": sentence(estimates)}


def _print(settings: EstimateSettings, policy: Described | None, title: str, estimates: list[Estimate]) -> None:
    from kerv_cli.bench.estimate import FAMILY_COLUMNS, PART_COLUMNS, family_rows, notes, part_rows, rate, sentence

    name = f"{policy.shape.name} on {title}" if policy and policy.shape else title
    engines = " / ".join(one.costs.engine for one in estimates)
    print_table(PART_COLUMNS, part_rows(estimates), f"{name}, computed, not measured: {engines}" if policy else name)
    print_table(
        FAMILY_COLUMNS, family_rows(estimates), "speed against AR; break-even: accepted tokens per verification"
    )
    for line in notes(policy, estimates):
        typer.echo(line)
    if settings.hz:
        typer.echo(rate(estimates, settings.hz, settings.actions))
    typer.echo(sentence(estimates))


def _trace(settings: EstimateSettings, as_json: bool) -> None:
    """Price a trace on each machine, or say which length of chains would have been the fastest there."""
    from kerv_cli.base.places import as_path
    from kerv_cli.bench.described import described
    from kerv_cli.bench.traced import CANNOT, choose_length, price
    from kerv_cli.engine.trace import read_trace

    trace = read_trace(as_path(settings.trace))
    settings.prompt = settings.prompt or next((one.prompt for one in trace if one.prompt), None)
    answer = choose_length if settings.choose == "draft" else price
    found = [
        ({"machine": title, "engine": costs.engine}, one)
        for title, several in _costs(settings, None if settings.on else described(settings)).items()
        for costs in several
        for one in answer(trace, costs)
    ]
    if as_json:
        end_with_json({"rows": [{**machine, **one.document} for machine, one in found], "note": CANNOT})
    print_rows([{**machine, **one.cells} for machine, one in found], settings.trace)
    if settings.choose == "draft":
        typer.echo(CANNOT)
