"""`kerv estimate`: what speculation can give a policy that is described by its size. Nothing is run."""

from __future__ import annotations

from typing import Any

import typer

from kerv_cli.bench.settings import EstimateSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, end_with_json, print_rows


@command(
    "estimate", EstimateSettings, keys="weights model tokens prompt vision hz device on trace choose", writes=False
)
def estimate(settings: EstimateSettings, as_json: AsJson = False) -> None:
    """Say whether speculative decoding can help a policy: costs of an action, and speeds that methods can reach.

    weights=7B describes a policy by its size; model= reads a config.json or a target. A policy without action tokens
    has tokens=0. on=PROFILE takes measured costs. trace=FILE prices recorded decodes; choose=draft says which length of
    chains is the fastest for them.

    Examples:
        kerv estimate weights=7B tokens=7 device=h100
        kerv estimate trace=FILE on=PROFILE
    """
    from kerv_cli.bench.described import described
    from kerv_cli.bench.prices import NO_TOKENS, Estimate, costs_of
    from kerv_cli.bench.tables import document, family_rows, notes, part_rows, rate, sentence

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
    found: dict[str, list[Estimate]] = {}
    for title, costs in costs_of(settings, policy):
        costs.check(tokens)
        found.setdefault(title, []).append(Estimate(costs, tokens))
    rows = []
    for title, estimates in found.items():
        row: dict[str, Any] = {"machine": title, "tokens": tokens, "engines": list(map(document, estimates))}
        row["notes"] = notes(policy, estimates)
        if settings.hz:
            row["rate"] = rate(estimates, settings.hz, settings.actions)
        row["sentence"] = sentence(estimates)
        rows.append(row)
        if as_json:
            continue
        if policy and policy.shape:
            engines = " / ".join(one.costs.name for one in estimates)
            title = f"{policy.shape.name} on {title}, computed, not measured: {engines}"
        print_rows(list(part_rows(estimates)), title)
        print_rows(list(family_rows(estimates)), "speed against AR; break-even: accepted tokens per verification")
        for line in filter(None, (*row["notes"], row.get("rate"), row["sentence"])):
            typer.echo(line)
    if as_json:
        end_with_json({"applies": True, "machines": rows})


def _trace(settings: EstimateSettings, as_json: bool) -> None:
    """Price a trace on each machine, or say which length of chains would have been the fastest there."""
    from kerv_cli.base.paths import as_path
    from kerv_cli.bench.described import described
    from kerv_cli.bench.prices import costs_of
    from kerv_cli.bench.tables import trace_row
    from kerv_cli.bench.trace import CANNOT, choose_length, price, read_trace

    trace = read_trace(as_path(settings.trace))
    settings.prompt = settings.prompt or next(filter(None, [one.prompt for one in trace]), None)
    answer = choose_length if settings.choose == "draft" else price
    documents, rows = [], []
    for title, costs in costs_of(settings, None if settings.on else described(settings)):
        machine = {"machine": title, "engine": costs.name}
        for one in answer(trace, costs):
            documents.append(machine | one)
            rows.append(machine | trace_row(one))
    if as_json:
        end_with_json({"rows": documents, "note": CANNOT})
    print_rows(rows, settings.trace)
    if settings.choose == "draft":
        typer.echo(CANNOT)
