"""Studies in the database: what each wants, what it has, and its folder of files."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import sqlalchemy as sa

from kerv_cli.base.errors import UsageError
from kerv_cli.base.limits import check_name
from kerv_cli.episodes.rows import read_decodes, seconds_blob, table_blob
from kerv_cli.lab.database import (
    BLOCKS,
    DECODES,
    EPISODES,
    MEASURES,
    RUNS,
    SETTINGS,
    STUDIES,
    WANTED,
    Database,
    insert_or_ignore,
    now,
)
from kerv_cli.lab.plan import NEVER, Measured, Setting, Split, Study, Wanted, explain, split
from kerv_cli.lab.runs import Run, run_rows

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

SWEEP, ROLLOUT, IMPORT = "sweep", "rollout", "import"
"""Kinds of studies: what `kerv sweep`, `kerv rollout` and `kerv runs import` leave."""
_FOLDERS = {SWEEP: "studies", ROLLOUT: "rollouts", IMPORT: "studies"}
_AT_ONCE = 500  # values of an IN (...)
_ABOUT = ("title", "baseline", "axis", "note", "block")
PROVENANCE = ("host", "device_name", "git_commit", "engine", "executor", "workers")
"""Columns of an episode's block that tables show, besides versions."""


@dataclass(frozen=True)
class Foreign:
    """An episode that another program ran.

    Attributes:
        wanted: What it means.
        row: Columns of the table `episodes`, as far as they are known.
        decodes: Table with the columns of rows.DECODE_SCHEMA.
        block: Id of the block in which settings took turns.
        about: Provenance of that block.
        run: Id of the run; empty: that of the import.
        seeds: Of the block, as `seeds_text` writes them.
        code: Hash of the source that ran it.
    """

    wanted: Wanted
    row: Mapping[str, Any]
    decodes: pa.Table
    block: str
    about: Mapping[str, Any]
    run: str = ""
    seeds: str = ""
    code: str = ""


class StudyStore:
    """A study in the database of a results folder, and its folder of files.

    The folder holds what is no row: `rollouts/*.rrd` and `report.html`.

    Raises:
        UsageError: The name is no plain folder name.
    """

    def __init__(self, results: Path | str | Database, name: str, kind: str = "") -> None:
        self.database = results if isinstance(results, Database) else Database(results)
        self.name = check_name(name, "study name")
        self._kind = kind

    @property
    def kind(self) -> str:
        """Sweep, rollout or import; of a study that is not there what the constructor was told, else sweep."""
        if not self._kind:
            row = self._row()
            self._kind = SWEEP if row is None else row.kind
        return self._kind

    @property
    def root(self) -> Path:
        """The folder of its files."""
        return self.database.results / _FOLDERS[self.kind] / self.name

    @property
    def rollouts(self) -> Path:
        """The folder of its recordings."""
        return self.root / "rollouts"

    @property
    def recordings(self) -> list[Path]:
        """Its .rrd files, by name."""
        return sorted(self.rollouts.glob("[!.]*.rrd"))

    @property
    def is_there(self) -> bool:
        """Whether the database has the study."""
        return self._row() is not None

    def _row(self) -> Any:
        with self.database.reading() as connection:
            return connection.execute(sa.select(STUDIES).where(STUDIES.c.name == self.name)).first()

    def how_to_run(self) -> str:
        """Return the command that runs it, for messages."""
        return f"run `{self.sweep_command()}`" if self.kind == SWEEP else f"run `kerv runs rerun {self.name}`"

    def sweep_command(self, *further: str) -> str:
        """Return the command that swept the study last; without one, by its name. further: overrides to add."""
        typed = (row.command for row in run_rows(self.database, SWEEP, self.name) if row.command[:1] == ("sweep",))
        words: Iterable[str] = next(typed, ("sweep", f"study={self.name}"))
        words = (word for word in words if not word.startswith(("results=", "rerun=", "-")))
        return shlex.join(["kerv", *words, *further])

    def load(self) -> Study:
        """Return the study as it was planned last.

        Raises:
            UsageError: There is no such study; the message names what to run.
        """
        row = self._row()
        if row is None:
            raise UsageError(f"no study '{self.name}' in {self.database.shown}: {self.how_to_run()}")
        with self.database.reading() as connection:
            query = sa.select(SETTINGS).where(SETTINGS.c.study_id == row.id).order_by(SETTINGS.c.position)
            settings = {
                one.id: Setting(one.label, one.overrides, one.settings, one.identity, one.varies, one.name)
                for one in connection.execute(query)
            }
            wanted = connection.execute(
                sa.select(WANTED.c.setting_id, WANTED.c.task, WANTED.c.seed, WANTED.c.repeat)
                .where(WANTED.c.setting_id.in_(settings))
                .order_by(WANTED.c.position)
            )
            episodes = tuple(Wanted(settings[one.setting_id], one.task, one.seed, one.repeat) for one in wanted)
        return Study(self.name, tuple(settings.values()), episodes, row.kind, **row.about)

    def save(self, plan: Split, whole: bool = True) -> None:
        """Write what the study wants, and which rows it has of that.

        Episodes of other tasks stay if they have the new plan's settings and seeds: sweeps of one study over different
        tasks end in one report. Changed settings or seeds replace the old ones.

        Args:
            plan: The study.
            whole: Replace; False: add to what is there, as sweeps until an answer do.
        """
        study = plan.study
        about = {name: getattr(study, name) for name in _ABOUT}
        with self.database.writing() as connection:
            connection.execute(
                insert_or_ignore(connection, STUDIES).values(
                    name=self.name, kind=study.kind, created=now(), about=about
                )
            )
            row = connection.execute(sa.select(STUDIES).where(STUDIES.c.name == self.name)).one()
            if whole and row.about != about:
                if row.about["baseline"] != study.baseline:
                    connection.execute(sa.delete(SETTINGS).where(SETTINGS.c.study_id == row.id))
                connection.execute(sa.update(STUDIES).where(STUDIES.c.id == row.id).values(about=about))
            ids = self._save_settings(connection, row.id, study.settings, whole)
            if whole:
                self._forget(connection, study, ids)
            first = connection.scalar(
                sa.select(sa.func.coalesce(sa.func.max(WANTED.c.position) + 1, 0)).where(
                    WANTED.c.setting_id.in_(ids.values())
                )
            )
            rows = [
                {
                    "setting_id": ids[one.setting.label],
                    "task": one.task,
                    "seed": one.seed,
                    "repeat": one.repeat,
                    "position": int(first or 0) + position,
                    "episode_id": plan.there[one].id if one in plan.there else None,
                }
                for position, one in enumerate(study.wanted)
            ]
            if rows:
                connection.execute(insert_or_ignore(connection, WANTED), rows)

    def _save_settings(
        self, connection: sa.Connection, study: int, settings: Sequence[Setting], whole: bool
    ) -> dict[str, int]:
        """Write the settings -> their ids by label. One of other work replaces its row, and what that wanted."""
        stored = {row.label: row for row in connection.execute(sa.select(SETTINGS).where(SETTINGS.c.study_id == study))}
        labels = {setting.label for setting in settings}
        ids = {}
        for label, row in stored.items():
            if whole and label not in labels:
                connection.execute(sa.delete(SETTINGS).where(SETTINGS.c.id == row.id))
        for position, setting in enumerate(settings):
            values = {
                "position": position,
                "name": setting.name,
                "method": str(setting.settings["method"]),
                "varies": dict(setting.varies),
                "overrides": setting.overrides,
                "work": setting.work,
                "settings": dict(setting.settings),
                "identity": dict(setting.identity),
            }
            old = stored.get(setting.label)
            if old is not None and old.work != setting.work:
                connection.execute(sa.delete(SETTINGS).where(SETTINGS.c.id == old.id))
                old = None
            if old is None:
                added = sa.insert(SETTINGS).values(study_id=study, label=setting.label, **values)
                ids[setting.label] = connection.execute(added.returning(SETTINGS.c.id)).scalar_one()
            else:
                connection.execute(sa.update(SETTINGS).where(SETTINGS.c.id == old.id).values(**values))
                ids[setting.label] = old.id
        return ids

    def _forget(self, connection: sa.Connection, study: Study, ids: Mapping[str, int]) -> None:
        """Delete what the study wants anew, and what it does not want any more."""
        tasks = study.tasks
        for label, number in ids.items():
            of_label = [(one.seed, one.repeat) for one in study.wanted if one.setting.label == label]
            seeds, repeats = {seed for seed, _ in of_label}, {repeat for _, repeat in of_label}
            rows = connection.execute(
                sa.select(WANTED.c.seed, WANTED.c.repeat, WANTED.c.task).where(WANTED.c.setting_id == number)
            ).all()
            gone = {(row.seed, row.repeat) for row in rows if row.seed not in seeds or row.repeat not in repeats}
            connection.execute(sa.delete(WANTED).where(WANTED.c.setting_id == number, WANTED.c.task.in_(tasks)))
            for seed, repeat in gone:
                connection.execute(
                    sa.delete(WANTED).where(
                        WANTED.c.setting_id == number, WANTED.c.seed == seed, WANTED.c.repeat == repeat
                    )
                )

    def counts(self) -> tuple[int, int]:
        """Return (episodes that are there, episodes that are wanted)."""
        with self.database.reading() as connection:
            row = connection.execute(
                sa.select(sa.func.count(WANTED.c.episode_id), sa.func.count())
                .select_from(WANTED.join(SETTINGS).join(STUDIES))
                .where(STUDIES.c.name == self.name)
            ).one()
        return int(row[0]), int(row[1])

    def frame(self, wanted: Iterable[Wanted] | None = None) -> pd.DataFrame:
        """Return the episodes that are there, in the study's order: a row per label, task, seed and repeat.

        Columns: label, the columns of the table `episodes` with `decode_seconds` as an array, `run`, `code` and the
        provenance of their blocks. wanted: only these.
        """
        import pandas as pd

        keys = ("label", "task", "seed", "repeat")
        measures = [EPISODES.c[column.name] for column in MEASURES]
        circumstances = [EPISODES.c[name] for name in ("block", "order", "started", "decode_seconds")]
        query = (
            sa.select(
                SETTINGS.c.label, WANTED.c.task, WANTED.c.seed, WANTED.c.repeat, EPISODES.c.id.label("episode"),
                *measures, *circumstances, BLOCKS.c.run, BLOCKS.c.code, BLOCKS.c.about,
            )
            .select_from(WANTED.join(EPISODES).join(BLOCKS).join(SETTINGS).join(STUDIES))
            .where(STUDIES.c.name == self.name)
            .order_by(WANTED.c.position)
        )  # fmt: skip
        with self.database.reading() as connection:
            frame = pd.DataFrame(connection.execute(query).mappings().all())
        if frame.empty:
            return frame
        if wanted is not None:
            chosen = {(one.setting.label, one.task, one.seed, one.repeat) for one in wanted}
            frame = frame[[key in chosen for key in zip(*(frame[name] for name in keys), strict=True)]]
        numbers = [
            column.name
            for column in MEASURES
            if isinstance(column.type, sa.Double)
            or (isinstance(column.type, sa.BigInteger) and frame[column.name].isna().any())
        ]
        frame = frame.astype(dict.fromkeys(numbers, float))
        frame["decode_seconds"] = frame["decode_seconds"].map(lambda blob: np.frombuffer(blob, "<f8"))
        about = pd.DataFrame(list(frame.pop("about")), index=frame.index)
        return pd.concat([frame, about], axis=1).reset_index(drop=True)

    def decodes(self, episodes: Sequence[int], columns: Sequence[str] | None = None) -> pa.Table:
        """Return the decodes of these episodes, in their order, with the column `episode`: the position in the list."""
        import pyarrow as pa

        blobs: dict[int, bytes] = {}
        with self.database.reading() as connection:
            for at in range(0, len(episodes), _AT_ONCE):
                part = [int(number) for number in episodes[at : at + _AT_ONCE]]
                found = connection.execute(sa.select(DECODES).where(DECODES.c.episode_id.in_(part)))
                blobs |= {row.episode_id: row.parquet for row in found}
        tables = []
        for position, number in enumerate(episodes):
            table = read_decodes(blobs[int(number)], columns and list(columns))
            tables.append(table.append_column("episode", pa.array([position] * table.num_rows, pa.int64())))
        return pa.concat_tables(tables, promote_options="default")

    def add(self, study: Study, episodes: Iterable[Foreign], command: Sequence[str]) -> None:
        """Write a study whose episodes another program ran, in one transaction.

        Args:
            study: Its settings and all that it wants.
            episodes: Those that are there.
            command: Words after `kerv`, for the row of the run.
        """
        self.save(Split(study))
        blocks: set[str] = set()
        with Run(self.database, study.kind, self.name, command) as record, self.database.writing() as connection:
            for one in episodes:
                if one.block not in blocks:
                    blocks.add(one.block)
                    values = {"seeds": one.seeds, "started": one.row.get("started") or now()}
                    values |= {"code": one.code, "about": one.about, "run": one.run or record.id}
                    connection.execute(insert_or_ignore(connection, BLOCKS).values(id=one.block, **values))
                self._add(connection, one)

    def _add(self, connection: sa.Connection, one: Foreign) -> None:
        work, task, seed, repeat = one.wanted.key
        key = {"work": work, "task": task, "seed": seed, "repeat": repeat, "block": one.block}
        same = sa.and_(*(EPISODES.c[name] == value for name, value in key.items()))
        number = connection.scalar(sa.select(EPISODES.c.id).where(same))
        if number is None:
            seconds = seconds_blob(one.decodes["seconds"].to_pylist())
            row = {"order": 0, "started": "", **one.row, **key, "decode_seconds": seconds}
            number = connection.execute(sa.insert(EPISODES).values(row).returning(EPISODES.c.id)).scalar_one()
            blob = table_blob(one.decodes)
            connection.execute(sa.insert(DECODES).values(episode_id=number, parquet=blob))
        connection.execute(self.wants(one.wanted).values(episode_id=number))

    def wants(self, one: Wanted) -> sa.Update:
        """Return the UPDATE of the rows that want an episode; labels of equal settings share it."""
        settings = sa.select(SETTINGS.c.id).join(STUDIES).where(STUDIES.c.name == self.name)
        settings = settings.where(SETTINGS.c.work == one.setting.work)
        same = (WANTED.c.task == one.task, WANTED.c.seed == one.seed, WANTED.c.repeat == one.repeat)
        return sa.update(WANTED).where(WANTED.c.setting_id.in_(settings), *same)

    def remove(self) -> None:
        """Delete the study, and those of its episodes that no other study wants."""
        linked = sa.select(WANTED.c.episode_id).where(WANTED.c.episode_id.is_not(None))
        with self.database.writing() as connection:
            mine = linked.select_from(WANTED.join(SETTINGS).join(STUDIES)).where(STUDIES.c.name == self.name)
            ids = list(connection.scalars(mine))
            connection.execute(sa.delete(STUDIES).where(STUDIES.c.name == self.name))
            for at in range(0, len(ids), _AT_ONCE):
                part = EPISODES.c.id.in_(ids[at : at + _AT_ONCE])
                connection.execute(sa.delete(EPISODES).where(part, EPISODES.c.id.not_in(linked)))
            used = sa.select(EPISODES.c.block)
            connection.execute(sa.delete(BLOCKS).where(BLOCKS.c.id.not_in(used), BLOCKS.c.claim.is_(None)))


def stock_of(
    database: Database, works: Iterable[str], rollouts: bool = True
) -> dict[tuple[str, str, int, int], list[Measured]]:
    """Return the episodes of these settings that the database has, by what they mean.

    Args:
        database: Where they are.
        works: Hashes of the settings.
        rollouts: Those of `kerv rollout` too. A sweep leaves them out: no other setting took turns with them.
    """
    stock: dict[tuple[str, str, int, int], list[Measured]] = {}
    works = sorted(set(works))
    columns = (
        EPISODES.c.id, EPISODES.c.work, EPISODES.c.task, EPISODES.c.seed, EPISODES.c.repeat, BLOCKS.c.id.label("block"),
        BLOCKS.c.started, BLOCKS.c.code, BLOCKS.c.seeds,
    )  # fmt: skip
    with database.reading() as connection:
        for at in range(0, len(works), _AT_ONCE):
            query = sa.select(*columns).join(BLOCKS, EPISODES.c.block == BLOCKS.c.id)
            if not rollouts:
                query = query.outerjoin(RUNS, RUNS.c.id == BLOCKS.c.run).where(
                    sa.or_(RUNS.c.kind.is_(None), RUNS.c.kind != ROLLOUT)
                )
            for row in connection.execute(query.where(EPISODES.c.work.in_(works[at : at + _AT_ONCE]))):
                measured = Measured(row.id, row.block, row.started, row.code, row.seeds)
                stock.setdefault((row.work, row.task, row.seed, row.repeat), []).append(measured)
    return stock


def split_of(database: Database, study: Study, rerun: str = NEVER, since: str = "") -> Split:
    """Return what a study wants, split into what the database has and what is to run; see `split`."""
    made = split(
        study, stock_of(database, (setting.work for setting in study.settings), study.kind == ROLLOUT), rerun, since
    )
    return explain(made, _earlier(database, study))


def _earlier(database: Database, study: Study) -> dict[str, tuple[Setting, str]]:
    """Return the newest stored setting of each of the study's labels that has run, with its `work`."""
    ran = sa.select(WANTED.c.setting_id).where(WANTED.c.episode_id.is_not(None))
    query = (
        sa.select(SETTINGS).where(SETTINGS.c.label.in_(study.labels), SETTINGS.c.id.in_(ran)).order_by(SETTINGS.c.id)
    )
    with database.reading() as connection:
        return {
            row.label: (
                Setting(row.label, row.overrides, row.settings, row.identity, row.varies, row.name),
                row.work,
            )
            for row in connection.execute(query)
        }


def studies(database: Database, kind: str | None = None) -> list[StudyStore]:
    """Return the studies of the database, the newest first; those of a kind if one is given."""
    query = sa.select(STUDIES.c.name, STUDIES.c.kind).order_by(STUDIES.c.id.desc())
    query = query if kind is None else query.where(STUDIES.c.kind == kind)
    with database.reading() as connection:
        return [StudyStore(database, row.name, row.kind) for row in connection.execute(query)]
