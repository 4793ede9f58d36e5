"""Export the episodes of a run as CSV, Parquet, or a database of their own."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.files import atomic_path, write_text
from kerv_cli.catalogue.entries import RunEntry, store_of
from kerv_cli.catalogue.imports import export_database
from kerv_cli.episodes.rows import DECODE_SCHEMA
from kerv_cli.lab.database import Database
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.tables import csv_text

FORMATS = ("csv", "parquet", "db")
_AT_ONCE = 100  # episodes in memory at a time


def export(run: RunEntry, database: Database, to: str, folder: Path) -> list[Path]:
    """Export a run to files, and return their paths.

    Args:
        run: A sweep, rollout or import.
        database: Its database.
        to: A format: one of FORMATS.
        folder: Where the files go.

    Raises:
        UnknownName: There is no such format.
        UsageError: The run has no episodes.
        StorageError: The disk is full or not writable.
    """
    if to not in FORMATS:
        raise UnknownName("format", to, FORMATS)
    store = store_of(run, database)
    if to == "db":
        return [export_database(store, folder / run.id)]
    if to == "parquet":
        return _to_parquet(store, folder / run.id)
    path = folder / f"{run.id}.csv"
    write_text(path, csv_text(_episodes(store).drop(columns=["episode", "decode_seconds", "initial_state"])))
    return [path]


def _episodes(store: StudyStore) -> pd.DataFrame:
    """Return the table of a study's episodes that `StudyStore.frame` makes. Raise UsageError if there are none."""
    frame = store.frame()
    if frame.empty:
        raise UsageError(f"study '{store.name}' has no episode yet: {store.how_to_run()}")
    return frame


def _to_parquet(store: StudyStore, folder: Path) -> list[Path]:
    """Write all episodes of a study to episodes.parquet and all its decodes to decodes.parquet."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    frame, keys = _episodes(store), ["label", "task", "seed", "repeat"]
    episodes, decodes = folder / "episodes.parquet", folder / "decodes.parquet"
    with atomic_path(episodes) as path:
        table = pa.Table.from_pandas(frame.drop(columns=["episode", "decode_seconds"]), preserve_index=False)
        pq.write_table(table, path, compression="zstd")
    schema = pa.schema([*(table.schema.field(key) for key in keys), *DECODE_SCHEMA])
    with atomic_path(decodes) as path, pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for start in range(0, len(frame), _AT_ONCE):
            part = frame.iloc[start : start + _AT_ONCE]
            rows = store.decodes(list(part["episode"]))
            episode_keys = pa.Table.from_pandas(part[keys], preserve_index=False).take(rows["episode"])
            columns = [*episode_keys.columns, *(rows[name] for name in DECODE_SCHEMA.names)]
            writer.write_table(pa.table(columns, names=schema.names).cast(schema))
    return [episodes, decodes]
