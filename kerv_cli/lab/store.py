"""A study, and what is written of it: its row, its settings and its episodes. `lab/read.py` reads them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from kerv_cli.base.errors import UsageError
from kerv_cli.base.paths import check_name
from kerv_cli.episodes.identity import Setting
from kerv_cli.lab.database import (
    BLOCKS,
    DECODES,
    EPISODES,
    PLANNED,
    RUNS,
    SETTINGS,
    STUDIES,
    WANTED,
    Database,
    now,
)
from kerv_cli.lab.plan import Episode, Key

SWEEP, ROLLOUT = "sweep", "rollout"
"""Kinds of studies, made by `kerv sweep` and `kerv rollout`."""
_FOLDERS = {SWEEP: "studies", ROLLOUT: "rollouts"}
ABOUT = ("title", "baseline", "axis", "note", "block", "machines")
"""Fields of a `Study` that are stored as one JSON value."""


@dataclass(frozen=True, eq=False)
class Study:
    """A comparison of several settings, in a database.

    `Study(database, name)` alone names a study: `loaded` returns it with its settings and episodes.

    Attributes:
        database: The database.
        name: Name in the database.
        kind: sweep, rollout or import.
        settings: The settings to compare.
        episodes: All episodes, in the order in which they run.
        title: Title of the report.
        baseline: Label of the setting that the others are compared with.
        axis: Configuration key on the x axis of plots. If empty, they show speed and success of each setting.
        note: A sentence printed in the report.
        block: Number of seeds in a block, which one process runs. For each of these seeds it runs all settings.
        machines: Names of cost profiles of other machines, on which the report estimates the speeds.
    """

    database: Database
    name: str
    kind: str = SWEEP
    settings: tuple[Setting, ...] = ()
    episodes: tuple[Episode, ...] = ()
    title: str = ""
    baseline: str = ""
    axis: str = ""
    note: str = ""
    block: int = 5
    machines: Sequence[str] = ()

    def __post_init__(self) -> None:
        check_name(self.name, "study name")

    @property
    def labels(self) -> list[str]:
        return [setting.label for setting in self.settings]

    @property
    def tasks(self) -> list[str]:
        return list(dict.fromkeys(map(attrgetter("task"), self.episodes)))

    @property
    def root(self) -> Path:
        return self.database.results / _FOLDERS[self.kind] / self.name

    @property
    def rollouts(self) -> Path:
        return self.root / "rollouts"

    @property
    def recordings(self) -> list[Path]:
        return sorted(self.rollouts.glob("[!.]*.rrd"))


def write_episode(
    connection: sa.Connection, key: Key, block: Mapping[str, Any], row: Mapping[str, Any], decodes: bytes
) -> int:
    """Write an episode that has been run, unless it is there already. Return its row number.

    Args:
        connection: The database, in a transaction.
        key: Key of the episode.
        block: Row of its block.
        row: Columns of the table `episodes` whose values are neither in `key` nor in `block`.
        decodes: The episode's decodes, as the bytes of a Parquet file.
    """
    own = dict(zip(("work", "task", "seed"), key, strict=True)) | {"block": block["id"]}
    number = connection.scalar(sa.select(EPISODES.c.id).filter_by(**own))
    if number is None:
        if connection.scalar(sa.select(BLOCKS.c.id).filter_by(id=block["id"])) is None:
            connection.execute(sa.insert(BLOCKS).values(**block))
        number = connection.execute(sa.insert(EPISODES).values({**row, **own}).returning(EPISODES.c.id)).scalar_one()
        connection.execute(sa.insert(DECODES).values(episode_id=number, parquet=decodes))
    return int(number)


def study_row(connection: sa.Connection, study: Study) -> tuple[int, bool]:
    """Write a study's row. Return its number, and whether its baseline was the same before."""
    about = {name: getattr(study, name) for name in ABOUT}
    row = connection.execute(sa.select(STUDIES).where(STUDIES.c.name == study.name)).first()
    if row is None:
        new = sa.insert(STUDIES).values(name=study.name, kind=study.kind, created=now(), about=about)
        return int(connection.execute(new.returning(STUDIES.c.id)).scalar_one()), True
    connection.execute(sa.update(STUDIES).where(STUDIES.c.id == row.id).values(about=about))
    return int(row.id), row.about["baseline"] == study.baseline


def save_settings(
    connection: sa.Connection, study: Study, number: int, is_shared: bool, is_same_baseline: bool
) -> dict[str, int]:
    """Write a study's settings, and return their ids by label.

    Unless somebody runs the study, settings that it has no longer are deleted with their rows, and so is a setting that
    has another hash now. All are, if the baseline is another.

    Args:
        connection: The database, in a transaction.
        study: The study.
        number: Its row number.
        is_shared: Whether somebody runs the study.
        is_same_baseline: Whether its baseline was the same before.
    """
    of_study, ids = SETTINGS.c.study_id == number, {}
    stored = sa.select(SETTINGS.c.label, SETTINGS.c.work).where(of_study)
    works: dict[str, str] = dict(connection.execute(stored).all())
    if not is_shared:
        kept = [one.label for one in study.settings if works.get(one.label) == one.work] if is_same_baseline else []
        connection.execute(sa.delete(SETTINGS).where(of_study, SETTINGS.c.label.not_in(kept)))
    for position, setting in enumerate(study.settings):
        if is_shared and works.get(setting.label, setting.work) != setting.work:
            raise UsageError(
                f"study {study.name} is running, with other settings of {setting.label}: wait until it has ended, or "
                "write a study of another name"
            )
        values = {
            "position": position,
            "name": setting.name,
            "method": str(setting.settings["method"]),
            "varies": dict(setting.varies),
            "overrides": list(setting.overrides),
            "settings": dict(setting.settings),
            "identity": dict(setting.identity),
        }
        same = sa.update(SETTINGS).where(of_study, SETTINGS.c.label == setting.label)
        found = connection.scalar(same.values(**values).returning(SETTINGS.c.id))
        if found is None:
            new = sa.insert(SETTINGS).values(study_id=number, label=setting.label, work=setting.work, **values)
            found = connection.execute(new.returning(SETTINGS.c.id)).scalar_one()
        ids[setting.label] = int(found)
    return ids


def remove_study(study: Study) -> None:
    """Delete the study, and its episodes that no other study uses.

    Also delete episodes that `rerun=all` has replaced, if commands of this study ran them.
    """
    used = sa.select(WANTED.c.episode_id).select_from(PLANNED)
    used = used.where(WANTED.c.episode_id.is_not(None))
    mine, of_others = used.where(STUDIES.c.name == study.name), used.where(STUDIES.c.name != study.name)
    own_runs = sa.select(RUNS.c.id).where(RUNS.c.kind == study.kind, RUNS.c.name == study.name)
    own_blocks = sa.select(BLOCKS.c.id).where(BLOCKS.c.run.in_(own_runs))
    unused = sa.or_(EPISODES.c.id.in_(mine), EPISODES.c.block.in_(own_blocks)), EPISODES.c.id.not_in(of_others)
    with study.database.writing() as connection:
        connection.execute(sa.delete(EPISODES).where(*unused))
        connection.execute(sa.delete(STUDIES).where(STUDIES.c.name == study.name))
        full = sa.select(EPISODES.c.block)
        connection.execute(sa.delete(BLOCKS).where(BLOCKS.c.id.not_in(full)))
