"""A study: its settings, its episodes that are in the database, and its missing episodes."""

from __future__ import annotations

import functools
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa

from kerv_cli.base.config import groups
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
    UNFINISHED,
    WANTED,
    Damaged,
    Database,
    now,
)
from kerv_cli.lab.plan import Episode, Key, StoredEpisode
from kerv_cli.lab.runs import run_rows

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

SWEEP, ROLLOUT = "sweep", "rollout"
"""Kinds of studies, made by `kerv sweep` and `kerv rollout`."""
_FOLDERS = {SWEEP: "studies", ROLLOUT: "rollouts"}
_AT_ONCE = 500  # most values in one SQL IN (…)
_ROWS = 2000  # rows of a frame that are read at a time
ABOUT = ("title", "baseline", "axis", "note", "block", "machines")
"""Fields of a `Study` that are stored as one JSON value."""


def _same_episode() -> sa.ColumnElement[bool]:
    """Return the SQL condition that joins a study's planned episodes to all stored rows of the same episodes.

    WANTED joined to SETTINGS has the planned episodes. EPISODES has the stored episodes.
    """
    of_setting = EPISODES.c.work == SETTINGS.c.work, EPISODES.c.task == WANTED.c.task
    return sa.and_(*of_setting, EPISODES.c.seed == WANTED.c.seed)


@dataclass(frozen=True, eq=False)
class Study:
    """A comparison of several settings, in a database.

    `Study(database, name)` alone names a study: `load` returns it with its settings and episodes.

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

    Raises:
        UsageError: The name is not a plain folder name.
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
        """Labels of the settings, in order."""
        return [setting.label for setting in self.settings]

    @property
    def tasks(self) -> list[str]:
        """Names of the tasks, in order."""
        return list(dict.fromkeys(map(attrgetter("task"), self.episodes)))

    @property
    def root(self) -> Path:
        """The study's folder, `<results>/studies/<name>` or `<results>/rollouts/<name>`."""
        return self.database.results / _FOLDERS[self.kind] / self.name

    @property
    def rollouts(self) -> Path:
        """The folder of the study's recordings."""
        return self.root / "rollouts"

    @property
    def recordings(self) -> list[Path]:
        """Paths of the study's .rrd files, sorted by name."""
        return sorted(self.rollouts.glob("[!.]*.rrd"))

    @property
    def exists(self) -> bool:
        """Whether the study is in the database."""
        return self._row() is not None

    def _row(self) -> Any:
        with self.database.reading() as connection:
            return connection.execute(sa.select(STUDIES).where(STUDIES.c.name == self.name)).first()

    def how_to_run(self) -> str:
        """Return advice for error messages, such as: run `kerv sweep study=NAME`."""
        shown = f"`kerv runs show {self.name}` prints its command"
        return f"run `{self.sweep_command()}`" if self.kind == SWEEP else shown

    def sweep_command(self, *overrides: str) -> str:
        """Return the newest command that ran the study as a sweep, or `kerv sweep study=NAME` if none is stored.

        Args:
            overrides: Further overrides to append. They replace stored overrides of the same keys.
        """
        typed = self._swept() or ("sweep", f"study={self.name}")
        replaced = {"results", "rerun"}
        for word in overrides:
            replaced.add(word.partition("=")[0])
        kept = [word for word in typed if word.partition("=")[0] not in replaced and not word.startswith("-")]
        return shlex.join(["kerv", *kept, *overrides, *self.database.words])

    def _swept(self) -> tuple[str, ...]:
        rows = run_rows(self.database, SWEEP, self.name)
        return next((row.command for row in rows if row.command[:1] == ("sweep",)), ())

    def check_source(self, command: Sequence[str]) -> None:
        """Refuse a sweep whose file has the name of a study that another file describes. A file may have moved."""
        ours, theirs = (
            next((word.partition("=")[2] for word in words if word.startswith("study=")), "")
            for words in (command, self._swept())
        )
        is_there = Path(theirs).is_file() if "/" in theirs else theirs in groups()["study"]
        if is_there and theirs != ours:
            raise UsageError(
                f"study={ours} would replace study '{self.name}' of {theirs} in {self.database.shown}: "
                "choose another study.name=NAME"
            )

    def load(self, episodes: bool = True) -> Study:
        """Return the study as it was planned last. `episodes=False` leaves out its episodes, which take time."""
        row = self._row()
        if row is None:
            stored = [study.name for study in studies(self.database)]
            hint = did_you_mean(self.name, stored) or "'kerv runs list' shows what is there"
            hint = self.how_to_run() if self.name in groups()["study"] else hint
            raise UsageError(f"no study '{self.name}' in {self.database.shown}: {hint}")
        with self.database.reading() as connection, self.database.checking(f"study {self.name}"):
            settings = stored_settings(connection, row.id)
            planned = planned_episodes(connection, settings) if episodes else ()
            return Study(self.database, self.name, row.kind, tuple(settings.values()), planned, **row.about)

    def counts(self) -> tuple[int, int]:
        """Return how many of the study's planned episodes have been run, and how many episodes are planned."""
        with self.database.reading() as connection:
            row = connection.execute(
                sa.select(sa.func.count(WANTED.c.episode_id), sa.func.count())
                .select_from(PLANNED)
                .where(STUDIES.c.name == self.name)
            ).one()
        return int(row[0]), int(row[1])

    def version(self) -> str:
        """Return a text that changes whenever episodes of the study are added, replaced or removed."""
        facts = sa.func.count(), sa.func.count(WANTED.c.episode_id), sa.func.sum(WANTED.c.episode_id)
        query = sa.select(*facts).select_from(PLANNED).where(STUDIES.c.name == self.name)
        with self.database.reading() as connection:
            return "/".join(map(str, connection.execute(query).one()))

    def whole_runs(self) -> list[str]:
        """Return the ids of the commands that each ran all episodes of the study, oldest first."""
        wanted = PLANNED.join(EPISODES, _same_episode()).join(BLOCKS)
        keys = WANTED.c.setting_id, WANTED.c.task, WANTED.c.seed
        ran = (
            sa.select(BLOCKS.c.run, *keys).distinct().select_from(wanted).where(STUDIES.c.name == self.name).subquery()
        )
        _, total = self.counts()
        whole = sa.select(ran.c.run).where(ran.c.run != "").group_by(ran.c.run).having(sa.func.count() == total)
        with self.database.reading() as connection:
            return sorted(connection.scalars(whole))

    def frame(self, episodes: Iterable[Episode] | None = None, run: str | None = None) -> pd.DataFrame:
        """Return the episodes that have been run, in the study's order: one row per label, task and seed.

        Its columns are those of the table `episodes`, with `decode_seconds` as an array and `initial_state` as a tuple,
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
        with self.database.reading() as connection, self.database.checking(f"episodes of {self.name}"):
            measures = [one for one in MEASURES if one.name != state.name]
            query = (
                sa.select(
                    SETTINGS.c.label, WANTED.c.task, WANTED.c.seed, EPISODES.c.id.label("episode"),
                    *measures, state, *circumstances, BLOCKS.c.run,
                )
                .select_from(PLANNED.join(EPISODES, which).join(BLOCKS))
                .where(STUDIES.c.name == self.name, *([] if run is None else [BLOCKS.c.run == run]))
                .order_by(WANTED.c.position)
            )  # fmt: skip
            found = connection.execute(query)
            # part by part: the rows as Python objects take ten times the frame's memory
            rows = (list(map(tuple, some)) for some in found.partitions(_ROWS))
            parts = [pd.DataFrame.from_records(some, columns=list(found.keys())) for some in rows]
            if not parts:
                return pd.DataFrame()
            frame = pd.concat(parts, ignore_index=True)
            works = sa.select(SETTINGS.c.work).join(STUDIES).where(STUDIES.c.name == self.name)
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

    def decodes(self, episodes: Sequence[int], columns: Sequence[str] | None = None) -> pa.Table:
        """Return the decodes of several episodes in one table. Its column `episode` is an index into `episodes`.

        Args:
            episodes: Row numbers of the episodes.
            columns: Columns to read; None for all.
        """
        import pyarrow as pa

        from kerv_cli.episodes.rows import read_decodes

        blobs: dict[int, bytes] = {}
        with self.database.reading() as connection:
            for first in range(0, len(episodes), _AT_ONCE):
                part = list(map(int, episodes[first : first + _AT_ONCE]))
                found = sa.select(DECODES.c.episode_id, DECODES.c.parquet).where(DECODES.c.episode_id.in_(part))
                blobs |= dict(connection.execute(found).all())
        tables = []
        with self.database.checking(f"decodes of {self.name}"):
            for index, number in enumerate(episodes):
                table = read_decodes(blobs[int(number)], columns and list(columns))
                tables.append(table.append_column("episode", pa.array([index] * table.num_rows, pa.int64())))
        return pa.concat_tables(tables, promote_options="default")

    def remove(self) -> None:
        """Delete the study, and its episodes that no other study uses.

        Also delete episodes that `rerun=all` has replaced, if commands of this study ran them.
        """
        used = sa.select(WANTED.c.episode_id).select_from(PLANNED)
        used = used.where(WANTED.c.episode_id.is_not(None))
        mine, of_others = used.where(STUDIES.c.name == self.name), used.where(STUDIES.c.name != self.name)
        own_runs = sa.select(RUNS.c.id).where(RUNS.c.kind == self.kind, RUNS.c.name == self.name)
        own_blocks = sa.select(BLOCKS.c.id).where(BLOCKS.c.run.in_(own_runs))
        unused = sa.or_(EPISODES.c.id.in_(mine), EPISODES.c.block.in_(own_blocks)), EPISODES.c.id.not_in(of_others)
        with self.database.writing() as connection:
            connection.execute(sa.delete(EPISODES).where(*unused))
            connection.execute(sa.delete(STUDIES).where(STUDIES.c.name == self.name))
            full = sa.select(EPISODES.c.block)
            connection.execute(sa.delete(BLOCKS).where(BLOCKS.c.id.not_in(full)))


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


def rows_of(connection: sa.Connection, name: str) -> Sequence[Any]:
    """Return the rows of a study in the table WANTED, each with the label and the hash of its setting."""
    columns = SETTINGS.c.label, SETTINGS.c.work, WANTED, sa.case((UNFINISHED, True), else_=False).label("is_unfinished")
    query = sa.select(*columns).select_from(PLANNED).where(STUDIES.c.name == name).order_by(WANTED.c.position)
    return connection.execute(query).all()


def stored_episodes(
    connection: sa.Connection, kind: str, works: Iterable[str], tasks: Iterable[str] = (), seeds: Iterable[int] = ()
) -> dict[Key, list[StoredEpisode]]:
    """Return the stored episodes that a study may reuse, by `Episode.key`, each list with the oldest first.

    Sweeps do not reuse episodes of rollouts: no other setting took turns with them, so their times cannot be compared.

    Args:
        connection: The database.
        kind: Kind of the study.
        works: Hashes of the settings.
        tasks: Only episodes of these tasks; empty for all.
        seeds: Only episodes with these seeds; empty for all.
    """
    columns = EPISODES.c["work", "task", "seed", "id"], BLOCKS.c["id", "started", "seeds"]
    query = sa.select(*columns[0], *columns[1]).join(BLOCKS, EPISODES.c.block == BLOCKS.c.id)
    wanted: dict[Any, set[Any]] = {
        EPISODES.c.work: set(works),
        EPISODES.c.task: set(tasks),
        EPISODES.c.seed: set(seeds),
    }
    for column, values in wanted.items():
        if values:
            query = query.where(column.in_(values))
    if kind != ROLLOUT:
        query = query.outerjoin(RUNS, RUNS.c.id == BLOCKS.c.run)
        query = query.where(sa.func.coalesce(RUNS.c.kind, "") != ROLLOUT)
    stored: dict[Key, list[StoredEpisode]] = {}
    for work, task, seed, *row in connection.execute(query.order_by(EPISODES.c.id)):
        stored.setdefault((work, task, seed), []).append(StoredEpisode(*row))
    return stored


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


def setting_of(row: Any) -> Setting:
    """Return the setting that a row of the table `settings` describes.

    Raises:
        Damaged: The row names no method, or a hash of weights or data in it is not text.
    """
    texts = [row.settings.get("method"), *row.identity.values()]
    if not all(isinstance(text, str) for text in texts):
        raise Damaged(f"the method or the identity of setting {row.label}")
    return Setting(
        check_label(row.label), tuple(map(str, row.overrides)), row.settings, row.identity, row.varies, row.name
    )


def stored_settings(connection: sa.Connection, study: int) -> dict[int, Setting]:
    """Return a study's settings by their ids. `study` is the study's row number."""
    query = sa.select(SETTINGS).where(SETTINGS.c.study_id == study).order_by(SETTINGS.c.position)
    return {one.id: setting_of(one) for one in connection.execute(query)}


def planned_episodes(connection: sa.Connection, settings: Mapping[int, Setting]) -> tuple[Episode, ...]:
    """Return the episodes of `stored_settings`, in the study's order."""
    wanted = sa.select(WANTED.c.setting_id, WANTED.c.task, WANTED.c.seed)
    wanted = wanted.where(WANTED.c.setting_id.in_(settings)).order_by(WANTED.c.position)
    return tuple(Episode(settings[number], *rest) for number, *rest in connection.execute(wanted))


def studies(database: Database) -> list[Study]:
    """Return all studies in the database, newest first."""
    query = sa.select(STUDIES.c.name, STUDIES.c.kind).order_by(STUDIES.c.id.desc())
    with database.reading() as connection:
        return [Study(database, row.name, row.kind) for row in connection.execute(query)]
