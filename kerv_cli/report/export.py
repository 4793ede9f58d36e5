"""Export the episodes of a run as CSV or Parquet."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.files import atomic_path, write_text
from kerv_cli.catalogue.entries import RunEntry, store_of
from kerv_cli.episodes.rows import DECODE_SCHEMA
from kerv_cli.lab.database import Database
from kerv_cli.lab.read import decodes_of, frame_of, how_to_run
from kerv_cli.lab.store import Study

FORMATS = ("csv", "parquet")
_AT_ONCE = 100  # episodes in memory at a time


def export(run: RunEntry, database: Database, to: str, folder: Path) -> list[Path]:
    if to not in FORMATS:
        raise UnknownName("format", to, FORMATS)
    store = store_of(run, database)
    episodes = frame_of(store)
    if episodes.empty:
        raise UsageError(f"study '{store.name}' has no episode yet: {how_to_run(store)}")
    if to == "parquet":
        return _to_parquet(store, episodes, folder / run.id)
    path = folder / f"{run.id}.csv"
    shown = episodes.drop(columns=["episode", "decode_seconds", "initial_state"])
    write_text(path, shown.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
    return [path]


def _to_parquet(store: Study, frame: pd.DataFrame, folder: Path) -> list[Path]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    keys = ["label", "task", "seed"]
    episodes, decodes = folder / "episodes.parquet", folder / "decodes.parquet"
    with atomic_path(episodes) as path:
        table = pa.Table.from_pandas(frame.drop(columns=["episode", "decode_seconds"]), preserve_index=False)
        pq.write_table(table, path, compression="zstd")
    schema = pa.schema([*map(table.schema.field, keys), *DECODE_SCHEMA])
    with atomic_path(decodes) as path, pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for start in range(0, len(frame), _AT_ONCE):
            part = frame.iloc[start : start + _AT_ONCE]
            rows = decodes_of(store, list(part["episode"]))
            episode_keys = pa.Table.from_pandas(part[keys], preserve_index=False).take(rows["episode"])
            columns = [*episode_keys.columns, *rows.select(DECODE_SCHEMA.names).columns]
            writer.write_table(pa.table(columns, names=schema.names).cast(schema))
    return [episodes, decodes]
