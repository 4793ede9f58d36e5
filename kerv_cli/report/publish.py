"""Conditions for publishing a ratio: both sides were measured in turn, in one run, by one commit, on one machine."""

from __future__ import annotations

import pandas as pd

from kerv_cli.base.errors import KervError
from kerv_cli.report.tables import StudyData, values_of


class Unpublishable(KervError):
    """A study whose table does not meet the conditions for publishing."""


def refusals(table: pd.DataFrame) -> list[str]:
    """Return why a study's table may not be published, a clause each; empty if it may."""
    clauses = []
    commits = values_of(table, "git_commit")
    if any(commit.endswith("+changes") or commit in ("none", "nan", "") for commit in commits):
        clauses.append("some episodes were computed by code that is not committed")
    several = {"git_commit": "commits", "host": "machines", "device_name": "devices", "engine": "engines"}
    for column, what in several.items():
        if len(values_of(table, column)) > 1:
            clauses.append(f"its episodes are from {len(values_of(table, column))} {what}")
    compared = table[(table["label"] != table["baseline"]) & (table["pairs"] > 0)]
    for column, what in (("same_run", "in one run with"), ("same_block", "in turn with")):
        if apart := list(dict.fromkeys(compared.loc[compared[column] < 1, "label"])):
            clauses.append(f"not measured {what} the baseline: {', '.join(map(str, apart))}")
    return clauses


def check_publishable(data: StudyData) -> None:
    """Refuse a study that lacks episodes or has `refusals`.

    Raises:
        Unpublishable: The line lists all reasons.
    """
    clauses = [f"{len(data.absent)} of its episodes are missing"] if data.absent else []
    clauses += refusals(data.table)
    if clauses:
        raise Unpublishable(
            f"study {data.study.name} may not be published: {'; '.join(clauses)}. Commit, then run 'kerv sweep "
            f"study={data.study.name}' into a fresh results folder on one machine"
        )
