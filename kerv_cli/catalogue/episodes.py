"""Find stored episodes: all episodes of a study with their outcomes, or one episode by its row number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from kerv_cli.base.errors import UsageError
from kerv_cli.engine.record import DecodeRecord
from kerv_cli.lab.database import BLOCKS, EPISODES, MEASURES, SETTINGS, STUDIES, WANTED, Database
from kerv_cli.lab.plan import Episode
from kerv_cli.lab.store import Study, decodes_of, setting_of

LARGEST_ID = 2**31 - 1


def outcomes(store: Study, task: str = "", seed: int | None = None) -> list[Any]:
    """Return one row per planned episode of a study (label, task and seed), in the study's order.

    `episode` is the episode's row number, None if it has not run. `failed`: whether the last attempt to run it failed.
    """
    with store.database.reading() as connection:
        query = (
            sa.select(
                SETTINGS.c.label, WANTED.c.task, WANTED.c.seed, WANTED.c.episode_id.label("episode"),
                *EPISODES.c["success", "closest_approach", "object_moved"],
                WANTED.c.error.is_not(None).label("failed"),
            )
            .select_from(WANTED.join(SETTINGS).join(STUDIES).outerjoin(EPISODES, EPISODES.c.id == WANTED.c.episode_id))
            .where(STUDIES.c.name == store.name)
            .order_by(WANTED.c.position)
        )  # fmt: skip
        query = query if not task else query.where(WANTED.c.task == task)
        query = query if seed is None else query.where(WANTED.c.seed == seed)
        return list(connection.execute(query).all())


def totals(store: Study) -> list[Any]:
    """Return one row per setting of a study, with sums over its episodes, such as successes, steps and seconds."""
    columns = [sa.func.sum(EPISODES.c[name]).label(name) for name in ("steps", "decodes", "forwards", "seconds")]
    successes = sa.func.sum(sa.cast(EPISODES.c.success, sa.Integer)).label("successes")
    query = (
        sa.select(
            SETTINGS.c.label, sa.func.count(WANTED.c.task.distinct()).label("tasks"),
            sa.func.count().label("episodes"), successes, *columns,
        )
        .select_from(WANTED.join(SETTINGS).join(STUDIES).join(EPISODES, EPISODES.c.id == WANTED.c.episode_id))
        .where(STUDIES.c.name == store.name)
        .group_by(SETTINGS.c.id, SETTINGS.c.label, SETTINGS.c.position)
        .order_by(SETTINGS.c.position)
    )  # fmt: skip
    with store.database.reading() as connection:
        return list(connection.execute(query).all())


@dataclass(frozen=True)
class FoundEpisode:
    """A stored episode, and the newest study that uses it."""

    id: int  # row number of the episode
    store: Study
    episode: Episode
    row: Mapping[str, Any]  # the episode's row, by column: setting, study, task, seed, block, start time and results
    about: Mapping[str, Any]  # machine and software versions that ran the episode
    # seeds that must run before this episode, in this order, so that it gives the same tokens again. Empty unless the
    # setting's skip rule adapts from episode to episode.
    earlier: tuple[int, ...]

    @property
    def recording(self) -> Path:
        return self.store.rollouts / self.episode.recording

    def decodes(self) -> tuple[list[DecodeRecord], list[int]]:
        """Read the episode's decodes, and for each the control step at which its first action is executed."""
        from kerv_cli.episodes.rows import decode_records

        table = decodes_of(self.store, [self.id])
        return decode_records(table), table["step"].to_pylist()


def find_episode(database: Database, number: int) -> FoundEpisode:
    with database.reading() as connection:
        own = EPISODES.c["task", "seed", "order", "block", "started"]
        about = STUDIES.c.name.label("study"), STUDIES.c.kind, BLOCKS.c.about
        query = (
            sa.select(SETTINGS, *about, *own, *MEASURES)
            .select_from(WANTED.join(SETTINGS).join(STUDIES).join(EPISODES).join(BLOCKS))
            .where(WANTED.c.episode_id == min(number, LARGEST_ID))
            .order_by(STUDIES.c.id.desc())
        )
        row = connection.execute(query).first()
        if row is None:
            raise UsageError(f"no study in {database.shown} has an episode {number}")
        setting = setting_of(row)
        same = EPISODES.c.work == row.work, EPISODES.c.block == row.block
        before = sa.select(EPISODES.c.seed).where(*same, EPISODES.c.order < row.order).order_by(EPISODES.c.order)
        earlier = tuple(connection.scalars(before)) if setting.depends_on_order else ()
    episode, store = Episode(setting, row.task, row.seed), Study(database, row.study, row.kind)
    return FoundEpisode(number, store, episode, dict(row._mapping), row.about, earlier)
