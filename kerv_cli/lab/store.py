"""Studies as they are stored: their plans, their episodes and their decodes. `lab/study.py` plans and saves them."""

from __future__ import annotations

import functools
import json
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa

from kerv_cli.base.config import as_overrides, groups
from kerv_cli.base.errors import UsageError, did_you_mean
from kerv_cli.base.limits import check_label
from kerv_cli.base.paths import check_name
from kerv_cli.episodes.identity import Setting
from kerv_cli.lab.database import (
    BLOCKS,
    DECODES,
    EPISODES,
    MEASURES,
    PLANNED,
    RUNS,
    SETTINGS,
    STUDIES,
    WANTED,
    Damaged,
    Database,
)
from kerv_cli.lab.plan import Episode, Key
from kerv_cli.lab.runs import run_rows

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

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
        axis: Configuration key on the x axis of plots. If empty, plots show speed and success of each setting.
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


_AT_ONCE = 500  # most values in one SQL IN (…)
_ROWS = 2000  # rows of a frame that are read at a time


def row_of(study: Study) -> Any:
    """Return the row of a study in the table STUDIES. None if the study is not stored."""
    with study.database.reading() as connection:
        return connection.execute(sa.select(STUDIES).where(STUDIES.c.name == study.name)).first()


def how_to_run(study: Study) -> str:
    """Return advice for error messages, such as: run `kerv sweep study=NAME`."""
    shown = f"`kerv runs show {study.name}` prints its command"
    return f"run `{sweep_command(study)}`" if study.kind == SWEEP else shown


def sweep_command(study: Study, *overrides: str) -> str:
    """Return the newest command that ran the study as a sweep, or `kerv sweep study=NAME` if none is stored.

    If commands with other tasks ran the study before, the tasks of all of them are named.

    Args:
        overrides: Further overrides to append. They replace stored overrides of the same keys.
    """
    sweeps = _sweeps(study)
    typed = next(iter(sweeps), ("sweep", f"study={study.name}"))
    if len({tuple(word for word in words if word.startswith("task=")) for words in sweeps}) > 1 and study.tasks:
        overrides = *overrides, *as_overrides(task=study.tasks)
    replaced = {"results", "store", "rerun", *(word.partition("=")[0] for word in overrides)}
    kept = [word for word in typed if word.partition("=")[0] not in replaced and not word.startswith("-")]
    return shlex.join(["kerv", *kept, *overrides, *study.database.words])


def swept_by(study: Study) -> tuple[str, ...]:
    return next(iter(_sweeps(study)), ())


def _sweeps(study: Study) -> list[tuple[str, ...]]:
    """Return the commands that ran the study as a sweep, newest first."""
    rows = run_rows(study.database, SWEEP, study.name)
    return [tuple(row.command) for row in rows if row.command[:1] == ["sweep"]]


def studies(database: Database) -> list[Study]:
    """Return all studies in the database, newest first."""
    query = sa.select(STUDIES.c.name, STUDIES.c.kind).order_by(STUDIES.c.id.desc())
    with database.reading() as connection:
        return [Study(database, row.name, row.kind) for row in connection.execute(query)]


def loaded(study: Study, episodes: bool = True) -> Study:
    """Return the study with its newest plan. `episodes=False` leaves out the episodes, which take long to read."""
    row = row_of(study)
    if row is None:
        stored = [study.name for study in studies(study.database)]
        hint = did_you_mean(study.name, stored) or "'kerv runs list' shows what is there"
        hint = how_to_run(study) if study.name in groups()["study"] else hint
        raise UsageError(f"no study '{study.name}' in {study.database.shown}: {hint}")
    with study.database.reading() as connection, study.database.checking(f"study {study.name}"):
        of_study = sa.select(SETTINGS).where(SETTINGS.c.study_id == row.id).order_by(SETTINGS.c.position)
        settings = {one.id: setting_of(one) for one in connection.execute(of_study)}
        wanted = sa.select(*WANTED.c["setting_id", "task", "seed"]).order_by(WANTED.c.position)
        rows = connection.execute(wanted.where(WANTED.c.study_id == row.id)) if episodes else ()
        planned = tuple(Episode(settings[number], *rest) for number, *rest in rows)
        return Study(study.database, study.name, row.kind, tuple(settings.values()), planned, **row.about)


def setting_of(row: Any) -> Setting:
    """Return the setting that a row of the table `settings` describes."""
    texts = [row.settings.get("method"), *row.identity.values()]
    if not all(isinstance(text, str) for text in texts):
        raise Damaged(f"the method or the identity of setting {row.label}")
    return Setting(
        check_label(row.label), tuple(map(str, row.overrides)), row.settings, row.identity, row.varies, row.name
    )


def rows_of(connection: sa.Connection, name: str) -> Sequence[Any]:
    """Return the rows of a study in the table WANTED, each with the label and the hash of its setting."""
    query = sa.select(SETTINGS.c.label, SETTINGS.c.work, WANTED).select_from(PLANNED)
    query = query.where(STUDIES.c.name == name).order_by(WANTED.c.position)
    return connection.execute(query).all()


RAN = EPISODES.join(BLOCKS).outerjoin(RUNS, RUNS.c.id == BLOCKS.c.run)
"""Each stored episode with the command that ran it."""
IS_NO_ROLLOUT = sa.func.coalesce(RUNS.c.kind, "") != ROLLOUT
"""Condition: no rollout ran the episode. Sweeps reuse only such episodes."""


def stored_episodes(connection: sa.Connection, study: Study) -> dict[Key, list[Any]]:
    """Return the stored episodes that a study may reuse, by `Episode.key`, each list with the oldest first."""
    works = EPISODES.c.work.in_({setting.work for setting in study.settings})
    columns = *EPISODES.c["work", "task", "seed", "id", "block"], *BLOCKS.c["started", "seeds"]
    query = sa.select(*columns).select_from(RAN).where(works).order_by(EPISODES.c.id)
    query = query if study.kind == ROLLOUT else query.where(IS_NO_ROLLOUT)
    stored: dict[Key, list[Any]] = {}
    for row in connection.execute(query):
        stored.setdefault((row.work, row.task, row.seed), []).append(row)
    return stored


def counts_of(study: Study) -> tuple[int, int]:
    """Return how many of the study's planned episodes have been run, and how many episodes are planned."""
    done, total, _ = _facts(study)
    return int(done), int(total)


def version_of(study: Study) -> str:
    """Return a text that changes whenever episodes of the study are added, replaced or removed."""
    return "/".join(map(str, _facts(study)))


def _facts(study: Study) -> Sequence[Any]:
    facts = sa.func.count(WANTED.c.episode_id), sa.func.count(), sa.func.sum(WANTED.c.episode_id)
    query = sa.select(*facts).select_from(PLANNED).where(STUDIES.c.name == study.name)
    with study.database.reading() as connection:
        return connection.execute(query).one()


def _same_episode() -> sa.ColumnElement[bool]:
    """Return the SQL condition that joins a study's planned episodes to all stored rows of the same episodes.

    WANTED joined to SETTINGS has the planned episodes. EPISODES has the stored episodes.
    """
    of_setting = EPISODES.c.work == SETTINGS.c.work, EPISODES.c.task == WANTED.c.task
    return sa.and_(*of_setting, EPISODES.c.seed == WANTED.c.seed)


def whole_runs(study: Study) -> list[str]:
    """Return the ids of the commands that each ran all episodes of the study, oldest first."""
    wanted = PLANNED.join(EPISODES, _same_episode()).join(BLOCKS)
    keys = WANTED.c.setting_id, WANTED.c.task, WANTED.c.seed
    ran = sa.select(BLOCKS.c.run, *keys).distinct().select_from(wanted).where(STUDIES.c.name == study.name).subquery()
    _, total = counts_of(study)
    whole = sa.select(ran.c.run).where(ran.c.run != "").group_by(ran.c.run).having(sa.func.count() == total)
    with study.database.reading() as connection:
        return sorted(connection.scalars(whole))


def frame_of(study: Study, episodes: Iterable[Episode] | None = None, run: str | None = None) -> pd.DataFrame:
    """Return the episodes that have been run, in the study's order: one row per label, task and seed.

    The frame has the columns of the table `episodes` (`decode_seconds` as an array, `initial_state` as a tuple),
    `run`, and the machine and versions that ran the episode.

    Args:
        episodes: Only these episodes; None for all.
        run: Only episodes that the command with this id ran. If None, the episodes that the study uses now.
    """
    import numpy as np
    import pandas as pd

    which = WANTED.c.episode_id == EPISODES.c.id if run is None else _same_episode()
    circumstances = EPISODES.c["block", "order", "started", "decode_seconds"]
    # the settings of a study share initial states: each is decoded once
    state = sa.cast(EPISODES.c.initial_state, sa.Text).label("initial_state")
    with study.database.reading() as connection, study.database.checking(f"episodes of {study.name}"):
        measures = [one for one in MEASURES if one.name != state.name]
        query = (
            sa.select(
                SETTINGS.c.label, WANTED.c.task, WANTED.c.seed, EPISODES.c.id.label("episode"),
                *measures, state, *circumstances, BLOCKS.c.run,
            )
            .select_from(PLANNED.join(EPISODES, which).join(BLOCKS))
            .where(STUDIES.c.name == study.name, *([] if run is None else [BLOCKS.c.run == run]))
            .order_by(WANTED.c.position)
        )  # fmt: skip
        found = connection.execute(query)
        # part by part: the rows as Python objects take ten times the frame's memory
        rows = (list(map(tuple, some)) for some in found.partitions(_ROWS))
        parts = [pd.DataFrame.from_records(some, columns=list(found.keys())) for some in rows]
        if not parts:
            return pd.DataFrame()
        frame = pd.concat(parts, ignore_index=True)
        works = sa.select(SETTINGS.c.work).join(STUDIES).where(STUDIES.c.name == study.name)
        ran = sa.select(EPISODES.c.block).where(EPISODES.c.work.in_(works))
        blocks = sa.select(BLOCKS.c.id, BLOCKS.c.about).where(BLOCKS.c.id.in_(ran))
        about = {row.id: row.about for row in connection.execute(blocks)}
        numbers = [column.name for column in MEASURES if isinstance(column.type, sa.Double | sa.BigInteger)]
        frame[numbers] = frame[numbers].apply(pd.to_numeric)
        unknown = frame[numbers].isna().all()
        frame = frame.astype(dict.fromkeys(unknown.index[unknown], float))
        frame["decode_seconds"] = frame["decode_seconds"].map(lambda blob: np.frombuffer(blob, "<f8"))
        frame["initial_state"] = frame["initial_state"].map(functools.cache(lambda text: tuple(json.loads(text))))
    if episodes is not None:
        chosen = [(one.setting.label, one.task, one.seed) for one in episodes]
        frame = frame[pd.MultiIndex.from_frame(frame[["label", "task", "seed"]]).isin(chosen)]
    return frame.join(pd.DataFrame.from_dict(about, orient="index"), on="block").reset_index(drop=True)


def decodes_of(study: Study, episodes: Sequence[int], columns: Sequence[str] | None = None) -> pa.Table:
    """Return the decodes of several episodes in one table. Its column `episode` is an index into `episodes`.

    Args:
        episodes: Row numbers of the episodes.
        columns: Columns to read; None for all.
    """
    import pyarrow as pa

    from kerv_cli.episodes.rows import read_decodes

    blobs: dict[int, bytes] = {}
    with study.database.reading() as connection:
        for first in range(0, len(episodes), _AT_ONCE):
            part = list(map(int, episodes[first : first + _AT_ONCE]))
            found = sa.select(DECODES.c.episode_id, DECODES.c.parquet).where(DECODES.c.episode_id.in_(part))
            blobs |= dict(connection.execute(found).all())
    tables = []
    with study.database.checking(f"decodes of {study.name}"):
        for index, number in enumerate(episodes):
            table = read_decodes(blobs[int(number)], columns and list(columns))
            tables.append(table.append_column("episode", pa.array([index] * table.num_rows, pa.int64())))
    return pa.concat_tables(tables, promote_options="default")


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
