"""A study. `lab/study.py` plans and saves it, `lab/read.py` reads it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import sqlalchemy as sa

from kerv_cli.base.paths import check_name
from kerv_cli.episodes.identity import Setting
from kerv_cli.lab.database import BLOCKS, EPISODES, PLANNED, RUNS, STUDIES, WANTED, Database
from kerv_cli.lab.plan import Episode

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
        kind: SWEEP or ROLLOUT.
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
