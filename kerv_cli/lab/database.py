"""The database of a results folder: runs, studies, episodes and curves as rows (docs/formats.md).

By default it is SQLite in `<results>/kerv.db`. `store=postgresql://USER@HOST/DB`, or the variable KERV_STORE, puts the
same tables on a server. The process that starts a command writes; its workers hand their episodes back to it.
"""

from __future__ import annotations

import contextlib
import functools
import os
import secrets
import socket
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from kerv_cli.base.errors import CheckpointError, KervError, StorageError, UsageError
from kerv_cli.base.files import storage_errors
from kerv_cli.base.leftovers import is_alive
from kerv_cli.base.places import STORE, results_dir

VARIABLE = STORE
FILE = "kerv.db"
SCHEMA = 1
"""Version of the tables. A change of them raises it and adds the statements to MIGRATIONS."""
MIGRATIONS: dict[int, Sequence[str]] = {}
"""Version -> statements that turn its tables into those of the next one."""
STALE_SECONDS = 900.0
"""A process of another machine counts as dead after this many seconds without a heartbeat."""
LOCK_SECONDS = 60
"""A process waits at most this long for another one's transaction."""
BEAT_SECONDS = 5.0
"""At least this many seconds pass between two heartbeats of a run."""

RUNNING, COMPLETE, FAILED, INTERRUPTED = "running", "complete", "failed", "interrupted"

_META = sa.MetaData()
_JSON = sa.JSON(none_as_null=True)


def _table(name: str, *columns: sa.schema.SchemaItem) -> sa.Table:
    return sa.Table(name, _META, *columns)


def _to(name: str, column: str, **options: Any) -> sa.Column[Any]:
    """Return a column with a foreign key that goes with its row."""
    return sa.Column(name, sa.ForeignKey(column, ondelete="CASCADE"), **options)


ABOUT = _table("kerv", sa.Column("key", sa.Text, primary_key=True), sa.Column("value", sa.Text, nullable=False))
RUNS = _table(
    "runs",  # a row per command that was begun
    sa.Column("id", sa.Text, primary_key=True),
    sa.Column("kind", sa.Text, nullable=False),  # sweep, rollout, import, or a kind of artifact
    sa.Column("name", sa.Text, nullable=False),  # of the study or the artifact
    sa.Column("command", _JSON, nullable=False),  # the words after `kerv`
    sa.Column("status", sa.Text, nullable=False),
    sa.Column("done", sa.Integer, nullable=False, default=0),
    sa.Column("total", sa.Integer, nullable=False, default=0),
    sa.Column("message", sa.Text, nullable=False, default=""),
    sa.Column("host", sa.Text, nullable=False),
    sa.Column("pid", sa.Integer, nullable=False),
    sa.Column("started", sa.Text, nullable=False),  # ISO 8601, UTC
    sa.Column("finished", sa.Text),
    sa.Column("heartbeat", sa.Float, nullable=False),  # seconds since 1970
    sa.Column("git_commit", sa.Text, nullable=False),
    sa.Index("runs_of_name", "kind", "name"),
)
STUDIES = _table(
    "studies",
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("name", sa.Text, nullable=False, unique=True),
    sa.Column("kind", sa.Text, nullable=False),  # sweep, rollout, import
    sa.Column("created", sa.Text, nullable=False),
    sa.Column("about", _JSON, nullable=False),  # title, baseline, axis, note, block
)
SETTINGS = _table(
    "settings",  # what a study compares
    sa.Column("id", sa.Integer, primary_key=True),
    _to("study_id", "studies.id", nullable=False, index=True),
    sa.Column("position", sa.Integer, nullable=False),
    sa.Column("label", sa.Text, nullable=False),
    sa.Column("name", sa.Text, nullable=False),  # what the settings of a grid share
    sa.Column("method", sa.Text, nullable=False),
    sa.Column("varies", _JSON, nullable=False),  # key -> value of a grid
    sa.Column("overrides", sa.Text, nullable=False),
    sa.Column("work", sa.Text, nullable=False, index=True),  # hash of what determines a result
    sa.Column("settings", _JSON, nullable=False),
    sa.Column("identity", _JSON, nullable=False),  # hashes of weights and data
    sa.UniqueConstraint("study_id", "label"),
)
BLOCKS = _table(
    "blocks",  # one attempt to run some episodes in one process, in which settings take turns
    sa.Column("id", sa.Text, primary_key=True),
    sa.Column("run", sa.Text, nullable=False),
    sa.Column("claim", sa.Text),  # JSON: the study and its episodes; null once it has ended
    sa.Column("seeds", sa.Text, nullable=False),
    sa.Column("started", sa.Text, nullable=False),
    sa.Column("code", sa.Text, nullable=False),  # hash of the source; decides nothing
    sa.Column("about", _JSON, nullable=False),  # machine, versions, commit, executor, workers
)
_CLAIMED = BLOCKS.c.claim.is_not(None)
sa.Index("claimed", BLOCKS.c.id, sqlite_where=_CLAIMED, postgresql_where=_CLAIMED)


def _episode_columns() -> Iterator[sa.Column[Any]]:
    from kerv_cli.episodes.rows import EPISODE_SCHEMA, FLAG, FLOAT, INT, TEXT

    types = {INT: sa.BigInteger, FLOAT: sa.Double, TEXT: sa.Text, FLAG: sa.Boolean}
    return (sa.Column(field.name, types.get(field.type, _JSON)) for field in EPISODE_SCHEMA)


MEASURES = tuple(_episode_columns())
EPISODES = _table(
    "episodes",
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("work", sa.Text, nullable=False),
    sa.Column("task", sa.Text, nullable=False),
    sa.Column("seed", sa.BigInteger, nullable=False),
    sa.Column("repeat", sa.Integer, nullable=False),
    sa.Column("block", sa.ForeignKey("blocks.id"), nullable=False),
    sa.Column("order", sa.Integer, nullable=False),  # episodes that the block ran before it
    sa.Column("started", sa.Text, nullable=False),
    sa.Column("worker_pid", sa.Integer),
    *MEASURES,
    sa.Column("decode_seconds", sa.LargeBinary, nullable=False),  # (decodes,) little-endian float64
    # One meaning can be measured again: with other settings in turn, or by other code. Times belong to a block.
    sa.UniqueConstraint("work", "task", "seed", "repeat", "block"),
)
DECODES = _table(
    "decodes", _to("episode_id", "episodes.id", primary_key=True), sa.Column("parquet", sa.LargeBinary, nullable=False)
)
WANTED = _table(
    "wanted",  # the episodes of a study's settings; without an episode: still to run
    _to("setting_id", "settings.id", primary_key=True),
    sa.Column("task", sa.Text, primary_key=True),
    sa.Column("seed", sa.BigInteger, primary_key=True),
    sa.Column("repeat", sa.Integer, primary_key=True),
    sa.Column("position", sa.Integer, nullable=False),
    sa.Column("episode_id", sa.ForeignKey("episodes.id", ondelete="SET NULL"), index=True),
    sa.Column("error", sa.Text),  # traceback of the last attempt, until one succeeds
)
METRICS = _table(
    "metrics",  # curves of trainings
    sa.Column("kind", sa.Text, primary_key=True),
    sa.Column("name", sa.Text, primary_key=True),
    sa.Column("step", sa.Integer, primary_key=True),
    sa.Column("metric", sa.Text, primary_key=True),
    sa.Column("value", sa.Double, nullable=False),
)


def now() -> str:
    """Return the time in UTC, ISO 8601 with seconds."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def new_id() -> str:
    """Return an id for a run that begins now: `20260301T142530Z-0f1e2d`."""
    return f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(3)}"


def url_of(results: str | Path) -> str:
    """Return the URL of the results folder's database."""
    return os.environ.get(VARIABLE) or f"sqlite:///{results_dir(str(results)).absolute() / FILE}"


class Database:
    """The tables of one results folder.

    Nothing is created before the first write: reading where there is no database finds no rows.

    Args:
        results: The results folder.
        url: Where the tables are; by default `url_of(results)`.

    Raises:
        UsageError: The URL cannot be used. StorageError: The server does not answer, or the disk refuses.
        CheckpointError: The file is damaged, or of a newer kerv.
    """

    def __init__(self, results: str | Path, url: str = "") -> None:
        self.results = results_dir(str(results))
        self.url = url or url_of(results)
        try:
            parsed = sa.make_url(self.url)
        except (sa.exc.ArgumentError, ValueError) as error:
            raise UsageError(f"store={self.url} is no URL: write postgresql://USER@HOST/DB") from error
        self.file = Path(parsed.database or "") if parsed.drivername == "sqlite" else None
        if self.file is None and parsed.drivername not in ("postgresql", "postgresql+psycopg"):
            raise UsageError(f"store={parsed.drivername}:// is not supported: use postgresql://USER@HOST/DB")
        self.shown = str(self.file or parsed.render_as_string())
        self._url = parsed if self.file else parsed.set(drivername="postgresql+psycopg")
        self._engine: sa.Engine | None = None

    @property
    def is_there(self) -> bool:
        """Whether tables can be there: always on a server, else whether the file is."""
        return self.file is None or self.file.exists()

    def close(self) -> None:
        """Close all connections."""
        if self._engine is not None:
            self._engine.dispose()
            self._engine = None

    @contextlib.contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """Yield a connection for SELECTs; without a database, one to empty tables in memory."""
        with self._errors():
            if self._engine is None and not self.is_there:
                engine = sa.create_engine("sqlite://", poolclass=sa.pool.NullPool)
                with engine.connect() as connection:
                    _META.create_all(connection)
                    yield connection
                return
            with self._opened().connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
                yield connection

    @contextlib.contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """Yield a connection in a transaction, which is committed at the end of the block."""
        with self._errors():
            engine = self._opened(create=True).execution_options(kerv_writes=True)
            with engine.begin() as connection:
                yield connection

    def _opened(self, create: bool = False) -> sa.Engine:
        if self._engine is None:
            if self.file is not None and create:
                with storage_errors(self.file):
                    self.file.parent.mkdir(parents=True, exist_ok=True)
            self._engine = self._connected()
            self._check_schema()
        return self._engine

    def _connected(self) -> sa.Engine:
        if self.file is None:
            return _server(self._url)
        # a reader may look into a folder that it cannot write to, where SQLite cannot make its log
        frozen = self.file.exists() and not os.access(self.file.parent, os.W_OK)
        where = f"file:{self.file}?mode=ro&immutable=1&uri=true" if frozen else str(self.file)
        waiting = {"timeout": LOCK_SECONDS}
        engine = sa.create_engine(f"sqlite:///{where}", poolclass=sa.pool.NullPool, connect_args=waiting)
        sa.event.listen(engine, "connect", _configure)
        sa.event.listen(engine, "begin", _begin)
        return engine

    def _check_schema(self) -> None:
        """Create the tables, or bring those of an older kerv up to date."""
        assert self._engine is not None
        with self._engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            version = _version(connection)
        if version is None or version < SCHEMA:
            with self._engine.execution_options(kerv_writes=True).begin() as connection:
                version = _version(connection)
                if version is None:
                    _META.create_all(connection)
                    version = SCHEMA
                    connection.execute(sa.insert(ABOUT).values(key="schema_version", value=str(SCHEMA)))
                for step in range(version, SCHEMA):
                    for statement in MIGRATIONS[step]:
                        connection.execute(sa.text(statement))
                connection.execute(
                    sa.update(ABOUT).where(ABOUT.c.key == "schema_version").values(value=str(max(version, SCHEMA)))
                )
        if version > SCHEMA:
            self.close()
            raise CheckpointError(
                f"{self.shown} is of a newer kerv (schema {version}, this one reads {SCHEMA}): update kerv"
            )

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sa.exc.DBAPIError as error:
            raise self._explained(error) from error

    def _explained(self, error: sa.exc.DBAPIError) -> KervError:
        why = " ".join(str(error.orig).split())[:160]
        if self.file is None:
            if isinstance(error, sa.exc.OperationalError):
                return StorageError(
                    f"store={self.shown} does not answer ({why}): start the server, or leave out store="
                )
            return StorageError(f"store={self.shown} refused a statement: {why}")
        if "malformed" in why or "not a database" in why:
            return CheckpointError(f"{self.file} is damaged ({why}): restore a copy of it, or move it aside")
        if "lock" in why:
            return StorageError(
                f"{self.file} stays locked ({why}): put results= on a local disk, or the tables on a server with "
                "store=postgresql://USER@HOST/DB"
            )
        return StorageError(f"cannot use {self.file}: {why}")


@functools.cache
def _server(url: sa.URL) -> sa.Engine:
    """Return this process's connections to a server."""
    seconds = {"connect_timeout": 5, "options": f"-c lock_timeout={LOCK_SECONDS}s"}
    try:
        engine = sa.create_engine(url, connect_args=seconds, pool_pre_ping=True)
    except ModuleNotFoundError:
        raise UsageError("store=postgresql:// needs the package psycopg: pip install 'kerv[postgres]'") from None
    sa.event.listen(engine, "begin", _begin)
    return engine


def _configure(connection: Any, record: object) -> None:
    """Set up a new SQLite connection."""
    connection.isolation_level = None  # transactions begin where `_begin` says so
    for pragma in ("journal_mode=WAL", "foreign_keys=ON", f"busy_timeout={LOCK_SECONDS * 1000}"):
        with contextlib.suppress(Exception):  # a folder that cannot be written to refuses the first
            connection.execute(f"PRAGMA {pragma}")


def _begin(connection: sa.Connection) -> None:
    """Let one process write at a time: what it reads in its transaction stays true until it commits."""
    if connection.get_execution_options().get("kerv_writes"):
        postgresql = connection.dialect.name == "postgresql"
        connection.exec_driver_sql("SELECT pg_advisory_xact_lock(5271009)" if postgresql else "BEGIN IMMEDIATE")


def _version(connection: sa.Connection) -> int | None:
    if not sa.inspect(connection).has_table(ABOUT.name):
        return None
    row = connection.execute(sa.select(ABOUT.c.value).where(ABOUT.c.key == "schema_version")).first()
    return None if row is None else int(row.value)


def insert_or_ignore(connection: sa.Connection, table: sa.Table) -> Any:
    """Return an INSERT that leaves a row alone that is there already."""
    if connection.dialect.name == "postgresql":
        from sqlalchemy.dialects.postgresql import insert
    else:
        from sqlalchemy.dialects.sqlite import insert  # type: ignore[assignment]
    return insert(table).on_conflict_do_nothing()


def is_live(host: str, pid: int, heartbeat: float) -> bool:
    """Return whether the process that wrote a row may still be at work."""
    if host == socket.gethostname():
        return is_alive(pid)
    return time.time() - heartbeat < STALE_SECONDS
