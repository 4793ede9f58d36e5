"""The database of a results folder: tables of runs, studies and episodes (docs/formats.md).

By default it is SQLite in `<results>/kerv.db`. With `store=postgresql://USER@HOST/DB`, or the variable KERV_STORE, the
same tables are on a server. Every process that runs episodes writes them itself.
"""

from __future__ import annotations

import contextlib
import functools
import json
import sqlite3
import sys
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from kerv_cli.base.errors import CheckpointError, KervError, StorageError, UsageError, is_of_an_interrupt
from kerv_cli.base.files import storage_errors
from kerv_cli.base.paths import results_dir
from kerv_cli.episodes.rows import EPISODE_SCHEMA, FLAG, FLOAT, INT
from kerv_cli.lab.command import current_store, without_passwords

FILE = "kerv.db"
SCHEMA = "2"
"""Version of the tables. A database with another version is refused."""
LOCK_SECONDS = 60
"""Longest time to wait for another process's transaction in a SQLite file, seconds."""
STATEMENT_SECONDS = 30
"""Longest time that a statement may take on PostgreSQL, waiting for other transactions included, seconds."""
IDLE_SECONDS = 20
"""Longest time between two statements of a transaction on PostgreSQL, which may hold locks, seconds."""
CONNECT_SECONDS = 5
"""Longest time to wait for a connection to PostgreSQL, seconds."""

_META = sa.MetaData()


class Unanswered(StorageError):
    """The server is away or too slow, or another process has locked the file. Trying again may help."""


class Damaged(ValueError):
    """A stored value has the wrong type or form for its column. `Database` turns this into a CheckpointError."""


class _Text(sa.types.TypeDecorator[str]):
    """Text. Characters that databases refuse, such as NUL, are stored as escapes."""

    impl = sa.Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: sa.Dialect) -> str | None:
        if value is None:
            return None
        return value.encode("utf-8", "backslashreplace").decode().replace("\0", r"\x00")


_JSON = sa.JSON(none_as_null=True)


def _table(name: str, *columns: sa.schema.SchemaItem) -> sa.Table:
    # sqlite_autoincrement: the row number of a removed row is never given to another
    return sa.Table(name, _META, *columns, sqlite_autoincrement=isinstance(columns[0].type, sa.Integer))  # type: ignore[attr-defined]


def _required(kind: Any, *names: str) -> list[sa.Column[Any]]:
    return [sa.Column(name, kind, nullable=False) for name in names]


def _to(name: str, column: str, **options: Any) -> sa.Column[Any]:
    """Return a column that refers to a row of another table. Deleting that row deletes the rows that refer to it."""
    return sa.Column(name, sa.ForeignKey(column, ondelete="CASCADE"), **options)


ABOUT = _table("kerv", sa.Column("key", _Text, primary_key=True), sa.Column("value", _Text, nullable=False))
RUNS = _table(
    "runs",  # one row per command that was started
    # kind: sweep, rollout, or a kind of artifact; name: of the study or the artifact; started: ISO 8601, UTC;
    # command: command-line arguments without `kerv`
    sa.Column("id", _Text, primary_key=True),
    *_required(_Text, "kind", "name", "status", "host", "git_commit", "message", "started"),
    *_required(sa.Integer, "done", "total"),
    *_required(_JSON, "command"),
    sa.Column("finished", _Text),
    sa.Index("runs_of_name", "kind", "name"),
)
WORKERS = _table(
    "workers",  # one row per living command or worker; `lab/runs.py` says who lives
    sa.Column("name", _Text, primary_key=True),
    *_required(_Text, "run", "host"),  # run: id of the command for which it works; empty: any command
    *_required(sa.Double, "heartbeat"),  # newest sign of life, seconds since 1970 by the database's clock
)
STUDIES = _table(
    "studies",
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("name", _Text, nullable=False, unique=True),
    *_required(_Text, "kind", "created"),  # kind: sweep or rollout
    *_required(_JSON, "about"),  # title, baseline, axis, note, block, machines
)
SETTINGS = _table(
    "settings",  # a row of a study's table
    sa.Column("id", sa.Integer, primary_key=True),
    _to("study_id", "studies.id", nullable=False, index=True),
    sa.Column("work", _Text, nullable=False, index=True),  # hash of what determines a result
    *_required(sa.Integer, "position"),
    *_required(_Text, "label", "name", "method"),  # name: shared by the settings of a grid
    # varies: key -> value in a grid; identity: hashes of weights and data
    *_required(_JSON, "varies", "settings", "identity", "overrides"),  # overrides: from which it is composed
    sa.UniqueConstraint("study_id", "label"),
)
BLOCKS = _table(
    "blocks",  # one attempt to run a group of episodes in one process, with settings taking turns
    sa.Column("id", _Text, primary_key=True),
    *_required(_Text, "run", "seeds", "started"),
    *_required(_JSON, "about"),  # machine, versions, commit, workers
)
_TYPES = {FLAG: sa.Boolean, INT: sa.BigInteger, FLOAT: sa.Double}
MEASURES = tuple(sa.Column(field.name, _TYPES.get(field.type, _JSON)) for field in EPISODE_SCHEMA)
"""Columns of the table of episodes that are computed from an episode's record."""
EPISODES = _table(
    "episodes",
    sa.Column("id", sa.Integer, primary_key=True),
    *_required(_Text, "work", "task", "started"),
    *_required(sa.BigInteger, "seed"),
    *_required(sa.Integer, "order"),  # order: number of episodes that the block ran before it
    sa.Column("block", sa.ForeignKey("blocks.id"), nullable=False),
    *MEASURES,
    *_required(sa.LargeBinary, "decode_seconds"),  # (decodes,) little-endian float64
    # the same episode may run again in another block, with other settings
    sa.UniqueConstraint("work", "task", "seed", "block"),
)
DECODES = _table(
    "decodes", _to("episode_id", "episodes.id", primary_key=True), sa.Column("parquet", sa.LargeBinary, nullable=False)
)
WANTED = _table(
    "wanted",  # plan, queue and progress of every study: a row per setting, task and seed
    _to("setting_id", "settings.id", primary_key=True),
    sa.Column("task", _Text, primary_key=True),
    sa.Column("seed", sa.BigInteger, primary_key=True),
    *_required(sa.Integer, "study_id", "position"),  # study_id: that of the setting
    sa.Column("episode_id", sa.ForeignKey("episodes.id", ondelete="SET NULL")),
    sa.Column("error", _Text),  # if the last attempt failed: the error in one line, then its traceback
    sa.Column("block", sa.Integer),  # number of the block in which it runs or ran; null: nobody asks for it now
    sa.Column("worker", _Text),  # name of the worker that has claimed it, or ran it
    sa.Column("attempts", sa.Integer, nullable=False, default=0),  # workers that died in it, and the one that runs it
    sa.Column("anew", sa.Boolean, nullable=False, default=False),  # rerun=all: stored episodes do not count
)
UNFINISHED = sa.and_(WANTED.c.block.is_not(None), WANTED.c.episode_id.is_(None), WANTED.c.error.is_(None))
"""Condition: the row's episode waits for a worker, or runs. Rows without a block are not in the queue."""
for _name, _columns in {"wanted_blocks": ("study_id", "block"), "wanted_workers": ("worker",)}.items():
    sa.Index(_name, *(WANTED.c[one] for one in _columns), sqlite_where=UNFINISHED, postgresql_where=UNFINISHED)
_IS_THERE = WANTED.c.episode_id.is_not(None)
sa.Index("wanted_episodes", WANTED.c.episode_id, sqlite_where=_IS_THERE, postgresql_where=_IS_THERE)
PLANNED = WANTED.join(SETTINGS).join(STUDIES)
"""Each planned episode with its setting and its study."""


def now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class Database:
    """The tables of one results folder.

    The first write creates the database. Until then, all tables read as empty. Methods that read or write raise a
    StorageError if the server does not answer, or if the disk is full or not writable. They raise a CheckpointError if
    the file is damaged, or was written by a newer version of kerv.

    Args:
        results: The results folder.
        url: URL of the database. If empty, the SQLite file in the results folder is used.
    """

    def __init__(self, results: str | Path, url: str | sa.URL = "") -> None:
        self.results = results_dir(str(results))
        url = url or sa.URL.create("sqlite", database=str(self.results.absolute() / FILE))
        try:
            parsed = sa.make_url(url)
        except (sa.exc.ArgumentError, ValueError):
            parsed = None
        if parsed is None or parsed.drivername not in ("sqlite", "postgresql", "postgresql+psycopg"):
            raise UsageError(f"store={without_passwords(str(url))} is no database: write postgresql://USER@HOST/DB")
        self.file = Path(parsed.database or "") if parsed.drivername == "sqlite" else None
        self.shown = str(self.file or without_passwords(str(url)))
        self._url = parsed if self.file else parsed.set(drivername="postgresql+psycopg")
        self._engine: sa.Engine | None = None

    @property
    def store(self) -> str:
        """Value of KERV_STORE that makes other processes use this database. It includes the password.

        Empty for the SQLite file in the results folder.
        """
        if self.file is not None and self.file.absolute() == (self.results / FILE).absolute():
            return ""
        return self._url.render_as_string(hide_password=False)

    @property
    def words(self) -> list[str]:
        """Overrides that choose this database. Messages and pages append them to the commands that they suggest.

        Empty for the SQLite file in the folder `results`.
        """
        folder = [] if self.results == results_dir("results") else [f"results={self.results}"]
        url = self._url.render_as_string() if self.file else self.shown
        return folder + ([f"store={url}"] if self.store else [])

    @property
    def exists(self) -> bool:
        return self.file is None or self.file.exists()

    def close(self) -> None:
        if self._engine is not None:
            self._engine.dispose()
            self._engine = None

    @contextlib.contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """Yield a connection for reading. If there is no database yet, its tables are empty."""
        with self._errors():
            if self._engine is None and not self.exists:
                engine = sa.create_engine("sqlite://", poolclass=sa.pool.NullPool)
                with engine.connect() as connection:
                    _META.create_all(connection)
                    yield connection
                return
            with self._opened().connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
                yield connection

    @contextlib.contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """Yield a connection in a transaction, which is committed when the `with` block ends."""
        with self._errors():
            engine = self._opened(create=True).execution_options(kerv_writes=True)
            with engine.begin() as connection:
                yield connection

    def _opened(self, create: bool = False) -> sa.Engine:
        if self._engine is None:
            if self.file is not None and create:
                with storage_errors(self.file):
                    self.file.parent.mkdir(parents=True, exist_ok=True)
            engine = _server(self._url) if self.file is None else _file(self.file)
            with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
                version = _version(connection)
            if version is None:
                with engine.execution_options(kerv_writes=True).begin() as connection:
                    if _version(connection) is None:  # no other process has created the tables meanwhile
                        _META.create_all(connection)
                        connection.execute(sa.insert(ABOUT).values(key="schema_version", value=SCHEMA))
                    version = _version(connection)
            if version != SCHEMA:
                engine.dispose()
                raise CheckpointError(
                    f"{self.shown} is of another kerv (schema {version}, this one reads {SCHEMA}): choose another "
                    "folder with results=; 'kerv runs export NAME' of that kerv writes its tables"
                )
            self._engine = engine
        return self._engine

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        before = sys.exception()
        try:
            yield
        except sa.exc.DBAPIError as error:
            # the driver could not roll back what Ctrl-C has left; an error in the clean-up after Ctrl-C is another
            if is_of_an_interrupt(error) and not is_of_an_interrupt(before):
                raise KeyboardInterrupt from error
            raise self._explained(error) from error
        except (Damaged, json.JSONDecodeError, UnicodeDecodeError) as error:
            raise self._damaged(error) from error

    @contextlib.contextmanager
    def checking(self, what: str) -> Iterator[None]:
        """Report errors in the `with` block as damage of the database. The block converts stored values.

        Args:
            what: What is converted, for the message.
        """
        try:
            yield
        except (ValueError, TypeError, LookupError, AttributeError, OverflowError, OSError) as error:
            raise self._damaged(f"{what}: {type(error).__name__} {error}") from error

    def _damaged(self, why: object) -> CheckpointError:
        text = " ".join(str(why).split())[:160]
        return CheckpointError(f"{self.shown} is damaged ({text}): restore a copy of it, or move it aside")

    def _explained(self, error: sa.exc.DBAPIError) -> KervError:
        why = " ".join(str(error.orig).split())[:160]
        if self.file is None:
            is_away = isinstance(error, sa.exc.OperationalError | sa.exc.InterfaceError) or error.connection_invalidated
            hint = "check that the server runs, or leave out store=" if is_away else "check the rights of its user"
            kind = Unanswered if is_away else StorageError
            return kind(f"store={self.shown} {'failed' if is_away else 'refused a statement'} ({why}): {hint}")
        if any(words in why for words in ("malformed", "not a database", "decode")):
            return self._damaged(why)
        hint = ""
        if "lock" in why:
            hint = ": put results= on a local disk, or use a server, store=postgresql://USER@HOST/DB"
        elif "unable to open" in why or "readonly" in why:
            hint = f": copy {self.results} to a folder that you can write"
        return (Unanswered if "lock" in why else StorageError)(f"cannot use {self.file}: {why}{hint}")


def opened(results: str | Path) -> Database:
    """Return the database that the running command uses for a results folder.

    `store=` names the database. Without it, the variable KERV_STORE names it. Without both, it is the SQLite file in
    the folder. A command calls this function once and passes the database on.
    """
    return Database(results, current_store())


def clock(connection: sa.Connection) -> sa.ColumnElement[float]:
    """Return an SQL expression for the current time in seconds since 1970, by the database's own clock."""
    if connection.dialect.name == "postgresql":
        return sa.literal_column("CAST(EXTRACT(EPOCH FROM clock_timestamp()) AS double precision)", sa.Double)
    return sa.literal_column("(julianday('now') - 2440587.5) * 86400.0", sa.Double)


@functools.cache
def _server(url: sa.URL) -> sa.Engine:
    try:
        engine = sa.create_engine(url, pool_pre_ping=True)
    except ModuleNotFoundError:
        raise UsageError("store=postgresql:// needs the package psycopg: pip install 'kerv[postgres]'") from None
    sa.event.listen(engine, "do_connect", _limit)
    sa.event.listen(engine, "begin", _begin)
    return engine


def _limit(dialect: object, record: object, arguments: object, options: dict[str, Any]) -> None:
    """Set the time limits of a new connection to PostgreSQL."""
    limits = f"-c statement_timeout={STATEMENT_SECONDS}s -c idle_in_transaction_session_timeout={IDLE_SECONDS}s"
    options |= {"connect_timeout": CONNECT_SECONDS, "options": limits, "keepalives_idle": 10, "keepalives_interval": 5}
    options |= {"keepalives_count": 2, "tcp_user_timeout": 20_000}


_begun = threading.local()
"""The SQLite connection whose transaction this thread began last."""


def _file(path: Path) -> sa.Engine:
    engine = sa.create_engine("sqlite://", creator=functools.partial(_connection, path), poolclass=sa.pool.NullPool)
    sa.event.listen(engine, "begin", _begin)
    return engine


class _Connection(sqlite3.Connection):
    """A connection that rolls back before it is closed.

    Ctrl-C can leave a cursor open. An open cursor would keep the transaction after the connection is closed.
    """

    def close(self) -> None:
        with contextlib.suppress(sqlite3.Error):
            self.rollback()
        super().close()


def _connection(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, timeout=LOCK_SECONDS, check_same_thread=False, factory=_Connection)
    connection.isolation_level = None  # `_begin` begins the transactions
    deadline = time.monotonic() + LOCK_SECONDS
    while True:
        try:
            connection.execute("PRAGMA journal_mode=WAL")
            break
        except sqlite3.OperationalError as error:
            # while another process makes the same change, SQLite answers "locked" at once instead of waiting
            if "locked" not in str(error) or time.monotonic() > deadline:
                connection.close()
                raise
            time.sleep(0.01)
    # a commit survives the end of this process; the log is flushed to the disk when it is moved into the file
    for pragma in ("synchronous=NORMAL", "foreign_keys=ON"):
        connection.execute(f"PRAGMA {pragma}")
    return connection


def _begin(connection: sa.Connection) -> None:
    """Start a transaction. If it will write, first wait until no other process writes.

    So what a writer has read stays true until it commits.
    """
    if not connection.get_execution_options().get("kerv_writes"):
        return
    if connection.dialect.name == "postgresql":
        connection.exec_driver_sql("SELECT pg_advisory_xact_lock(5271009)")
        return
    roll_back()
    _begun.connection = connection.connection.dbapi_connection
    connection.exec_driver_sql("BEGIN IMMEDIATE")


def roll_back() -> None:
    """Roll back the transaction that Ctrl-C has left open in this thread, if there is one."""
    before: sqlite3.Connection | None = getattr(_begun, "connection", None)
    if before is not None:
        with contextlib.suppress(sqlite3.ProgrammingError):  # it is closed, as it should be
            before.rollback()


def _version(connection: sa.Connection) -> Any:
    if not sa.inspect(connection).has_table(ABOUT.name):
        return None
    return connection.scalar(sa.select(ABOUT.c.value).where(ABOUT.c.key == "schema_version"))
