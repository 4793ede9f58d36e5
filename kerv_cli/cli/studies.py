"""Prints a study: its table, its verdict, what to open."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from kerv_cli.cli.common import console

if TYPE_CHECKING:
    from pandas import DataFrame

    from kerv_cli.lab.store import StudyStore


def print_study(table: DataFrame, store: StudyStore) -> None:
    """Print a study's table, its note, and the command that measures the times that it lacks."""
    from kerv_cli.report.summary import SummaryTable, not_in_turn
    from kerv_cli.report.tables import values_of

    console().print(SummaryTable(table))
    codes, commits = values_of(table, "code"), values_of(table, "git_commit")
    if len(codes) > 1:
        names = ", ".join(sorted(commit[:12] for commit in commits))
        typer.echo(f"its episodes are of {len(codes)} states of the code, commits {names}")
    apart = not_in_turn(table)
    if apart:
        mend = "" if store.kind == "import" else f"; '{store.sweep_command('rerun=timed')}' does that"
        typer.echo(f"no speedup of {', '.join(apart)}: not measured in turn with the baseline{mend}")
    note = store.load().note
    if note:
        typer.echo(f"\n{note}\n")


def print_verdict(table: DataFrame, store: StudyStore, loss: float) -> None:
    """Prints the last three lines of a study: the verdict, the page to open, the recording to watch."""
    from kerv_cli.report.decide import verdict_of

    typer.echo(f"verdict: {verdict_of(table, loss)[0]}")
    typer.echo(f"page: {store.root / 'report.html'}")
    recordings = store.recordings
    mend = "" if store.kind == "import" else "; the same sweep with record=1 rerun=all does that"
    typer.echo(f"watch: {f'kerv view {recordings[0]}' if recordings else f'nothing is recorded{mend}'}")
