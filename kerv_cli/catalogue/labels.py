"""Labels of runs: tags and a note that people write. The database has one row for each run that has any."""

from __future__ import annotations

import json
from collections.abc import Mapping
from operator import itemgetter

import sqlalchemy as sa

from kerv_cli.lab.database import ABOUT, Database

LABELS = ("tag", "note")
"""Kinds of labels. `tag` holds words, separated by commas; `note` is free text."""
_KEY = "labels of "


def labels_in(database: Database) -> dict[str, dict[str, str]]:
    """Return the labels of all runs that have any, by the id of the run."""
    rows = sa.select(ABOUT).where(ABOUT.c.key.startswith(_KEY))
    with database.reading() as connection, database.checking("a label"):
        return {row.key.removeprefix(_KEY): json.loads(row.value) for row in connection.execute(rows)}


def set_labels(database: Database, run: str, labels: Mapping[str, str]) -> None:
    """Replace the labels of a run, given its id. Empty labels are removed."""
    kept = dict(filter(itemgetter(1), labels.items()))
    with database.writing() as connection:
        connection.execute(sa.delete(ABOUT).where(ABOUT.c.key == _KEY + run))
        if kept:
            connection.execute(sa.insert(ABOUT).values(key=_KEY + run, value=json.dumps(kept, ensure_ascii=False)))
