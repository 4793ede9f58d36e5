"""Conditions for publishing a ratio: its two sides were measured in turn, in one run, by one commit, on one machine."""

from __future__ import annotations

import pandas as pd

from kerv_cli.base.errors import KervError
from kerv_cli.report.tables import StudyData, values_of


class Unpublishable(KervError):
    """A study whose table does not meet the conditions for publishing."""


def refusals(table: pd.DataFrame) -> list[str]:
    """Why a study's table may not be published, a clause each; empty where it may.

    table: a study's, with labels in `label` and several values of a column joined by semicolons.
    """
    clauses = []
    commits = values_of(table, "git_commit")
    if any(commit.endswith("+changes") or commit in ("none", "nan", "") for commit in commits):
        clauses.append("some episodes were computed by code that is not committed")
    if len(commits) > 1:
        clauses.append(f"its episodes are of {len(commits)} commits")
    for column, what in (("host", "machines"), ("device_name", "devices"), ("engine", "engines")):
        names = values_of(table, column)
        if len(names) > 1:
            clauses.append(f"its episodes are of {len(names)} {what}")
    compared = table[(table["label"] != table["baseline"]) & (table["pairs"] > 0)]
    for column, value, what in (("same_run", True, "in one run with"), ("same_block", 1.0, "in turn with")):
        apart = list(dict.fromkeys(compared.loc[compared[column] != value, "label"]))
        if apart:
            clauses.append(f"not measured {what} the baseline: {', '.join(map(str, apart))}")
    return clauses


def check_publishable(data: StudyData) -> None:
    """Raises Unpublishable: episodes are missing, or there are `refusals`; its line lists them all."""
    clauses = [f"{len(data.absent)} of its episodes are missing"] if data.absent else []
    clauses += refusals(data.table)
    if clauses:
        raise Unpublishable(
            f"study {data.study.name} may not be published: {'; '.join(clauses)}. Commit, then run 'kerv sweep "
            f"study={data.study.name}' into a fresh results folder on one machine"
        )
