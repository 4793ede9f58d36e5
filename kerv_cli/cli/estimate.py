"""`kerv estimate`: what verified drafts can give a policy that is described by its size. Nothing is run."""

from __future__ import annotations

import typer

from kerv_cli.bench.settings import EstimateSettings
from kerv_cli.cli.command import command
from kerv_cli.cli.common import AsJson, end_with_json, print_rows


@command("estimate", EstimateSettings, keys="weights code tokens device hz actions accepted on results", writes=False)
def estimate(settings: EstimateSettings, as_json: AsJson = False) -> None:
    """Say whether speculative decoding can help a policy: costs of an action, and speeds at a given acceptance.

    weights=7B describes a policy by its size, on=PROFILE by costs that kerv bench measured. A break-even is the
    probability of acceptance from which a method is faster than AR.

    Examples:
        kerv estimate weights=7B tokens=7 device=h100
        kerv estimate weights=pi0-fast code=fast device=4090 hz=50 actions=16
    """
    from kerv_cli.bench.estimate import FLOW, draft_rows, part_rows
    from kerv_cli.bench.estimate import estimate as estimated

    if settings.code == "flow" or settings.tokens == 0:
        if as_json:
            end_with_json({"applies": False, "reason": FLOW})
        typer.echo(FLOW)
        return
    machines = list(estimated(settings))
    if as_json:
        end_with_json({"applies": True, "machines": machines})
    for one in machines:
        engines = one["engines"]
        print_rows(list(part_rows(engines)), f"{one['machine']}: {' / '.join(engine['engine'] for engine in engines)}")
        if drafts := list(draft_rows(engines)):
            print_rows(drafts, "speed against AR, tokens unchanged")
        for line in filter(None, (*one["notes"], one.get("rate"), one["sentence"])):
            typer.echo(line)
