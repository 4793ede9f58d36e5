"""`kerv estimate`: what speculation can give a policy that is described by its size. Nothing is run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

from kerv_cli.bench.settings import EstimateSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, end_with_json, print_table

if TYPE_CHECKING:
    from kerv_cli.bench.described import Described
    from kerv_cli.bench.estimate import Estimate


@command(
    "estimate",
    EstimateSettings,
    keys="weights model tokens prompt vision actions hz device on results",
    examples=("kerv estimate weights=7B tokens=7 device=h100", "kerv estimate on=epyc-mt10-vision tokens=16"),
    writes=False,
)
def estimate(settings: EstimateSettings, as_json: AsJson = False) -> None:
    """Say whether speculative decoding can help a policy: costs of an action, and speeds that methods can reach.

    weights=7B describes a policy by its size; model= reads a config.json or a target. A policy without action tokens
    has tokens=0. on=PROFILE takes measured costs.
    """
    from kerv_cli.bench.described import described
    from kerv_cli.bench.estimate import NO_TOKENS

    policy = None if settings.on and settings.tokens != 0 else described(settings)
    if policy and policy.shape is None:
        if as_json:
            end_with_json({"applies": False, "reason": NO_TOKENS})
        typer.echo(NO_TOKENS)
        return
    found = _on_profiles(settings) if policy is None else _on_devices(settings, policy)
    if as_json:
        end_with_json({"applies": True, "machines": [_row(settings, policy, *one) for one in found.items()]})
    for title, estimates in found.items():
        _print(settings, policy, title, estimates)


def _on_devices(settings: EstimateSettings, policy: Described) -> dict[str, list[Estimate]]:
    """Return the estimates for each device with each engine, by the device's title."""
    from kerv_cli.bench.estimate import Estimate, computed
    from kerv_cli.bench.physics import DEVICES

    devices = [DEVICES[name] for name in settings.device]
    return {device.title: [Estimate(costs, policy.tokens) for costs in computed(policy, device)] for device in devices}


def _on_profiles(settings: EstimateSettings) -> dict[str, list[Estimate]]:
    """Return the estimate for each profile of `kerv bench`, by its title."""
    from kerv_cli.bench.estimate import Costs, Estimate, check_tokens
    from kerv_cli.report.reprice import open_profiles

    profiles = open_profiles(settings.results, settings.on)
    tokens = 7 if settings.tokens is None else settings.tokens
    for one in profiles:
        check_tokens(one.name, one.profile, tokens)
    return {one.title: [Estimate(Costs(one.name, one.profile, {}), tokens)] for one in profiles}


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
