"""Export the episodes of a run as CSV, Parquet, a database of their own, or a trace."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from kerv_cli.base.errors import KervError, UnknownName, UsageError
from kerv_cli.base.files import atomic_path, read_mapping, write_text
from kerv_cli.base.paths import find_target
from kerv_cli.catalogue.entries import RunEntry, store_of
from kerv_cli.catalogue.imports import export_database
from kerv_cli.engine.cost import READ_PHASES
from kerv_cli.engine.record import PARALLEL
from kerv_cli.episodes.rows import DECODE_SCHEMA
from kerv_cli.lab.database import Database
from kerv_cli.lab.store import Study
from kerv_cli.report.measures import csv_text
from kerv_cli.report.reprice import READ, levels_of
from kerv_cli.targets.settings import prompt_tokens

FORMATS = ("csv", "parquet", "db", "trace")
_AT_ONCE = 100  # episodes in memory at a time


def export(run: RunEntry, database: Database, to: str, folder: Path) -> list[Path]:
    """Export a run to files, and return their paths.

    Args:
        run: A sweep, rollout or import.
        database: The database that has the run.
        to: One of FORMATS. `trace` is a text file with one line of JSON per decode (docs/trace.md).
        folder: Folder to write to.

    Raises:
        UnknownName: There is no such format.
        UsageError: The run has no episodes. Or `to` is `trace` and the policy's chunks differ in length (FAST tokens).
        StorageError: The disk is full or not writable.
    """
    if to not in FORMATS:
        raise UnknownName("format", to, FORMATS)
    store = store_of(run, database)
    if to == "db":
        return [export_database(store, folder / run.id)]
    episodes = store.frame()
    if episodes.empty:
        raise UsageError(f"study '{store.name}' has no episode yet: {store.how_to_run()}")
    if to == "parquet":
        return _to_parquet(store, episodes.assign(**run.labels), folder / run.id)
    path = folder / (f"{run.id}.jsonl" if to == "trace" else f"{run.id}.csv")
    if to == "trace":
        _to_trace(store, episodes, path)
    else:
        shown = episodes.assign(**run.labels).drop(columns=["episode", "decode_seconds", "initial_state"])
        write_text(path, csv_text(shown))
    return [path]


def _to_parquet(store: Study, frame: pd.DataFrame, folder: Path) -> list[Path]:
    """Write the episodes of a study to episodes.parquet and their decodes to decodes.parquet."""
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
            rows = store.decodes(list(part["episode"]))
            episode_keys = pa.Table.from_pandas(part[keys], preserve_index=False).take(rows["episode"])
            columns = [*episode_keys.columns, *rows.select(DECODE_SCHEMA.names).columns]
            writer.write_table(pa.table(columns, names=schema.names).cast(schema))
    return [episodes, decodes]


def _to_trace(store: Study, frame: pd.DataFrame, path: Path) -> None:
    """Write every decode of a study's episodes as a line of a trace (docs/trace.md).

    Raises:
        UsageError: The chunks of a setting's policy differ in length (FAST tokens).
    """
    settings = {one.label: one.settings for one in store.load().settings}
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for label, part in frame.groupby("label", sort=False):
            chosen = settings.get(str(label), {})
            target = _target(store, chosen)
            if target.get("actions", {}).get("code"):
                raise UsageError(f"--to trace: chunks of {label} differ in length, and a trace has one length")
            size = max((len(row["tokens"]) for row in _decodes(store, part, ["tokens"])), default=0)
            prompt, levels = prompt_tokens(target), levels_of(chosen)
            for row in _decodes(store, part, READ):
                about = {"episode": row["episode"], "setting": label, "prompt": prompt, "tokens": size}
                file.write(json.dumps({**about, **_line(row, levels)}) + "\n")


def _decodes(store: Study, episodes: pd.DataFrame, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the decodes of some episodes as dictionaries. The key `episode` has the text TASK/SEED.

    A hundred episodes are read at a time.
    """
    for start in range(0, len(episodes), _AT_ONCE):
        some = episodes.iloc[start : start + _AT_ONCE]
        names = [f"{task}/{seed}" for task, seed in some[["task", "seed"]].to_numpy()]
        for row in store.decodes(list(some["episode"]), columns).to_pylist():
            yield {**row, "episode": names[row["episode"]]}


def _target(store: Study, settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the `target.json` of a setting's policy. Empty if the policy's files cannot be read here."""
    name = settings.get("policy", {}).get("target") or ""
    try:
        return read_mapping(find_target(str(store.database.results), name) / "target.json")
    except KervError:
        return {}


def _line(row: Mapping[str, Any], levels: int) -> dict[str, Any]:
    """Return a decode as one line of a trace, without the keys that all decodes of its episode share.

    Args:
        row: Columns `READ` of the decode.
        levels: Number of levels of a drafted tree, for episodes of older versions of kerv, which did not store it.
    """
    seconds = {phase: row[f"seconds.{phase}"] for phase in READ_PHASES if row[f"seconds.{phase}"] is not None}
    rounds = []
    for one in row["rounds"]:
        own_levels = levels if one.get("levels") is None else one["levels"]
        line = {
            "mode": one["mode"] if one["mode"] in ("skip", PARALLEL) else "forward",
            "proposer": one["proposer"],
            "start": one["start"],
            "nodes": one["tree_size"],
            "levels": own_levels if one["tree_size"] else 0,
            "accepted": one["accepted"],
            "committed": one["committed"],
        }
        rounds.append(line)
    searched, encoded = row["similarity"] is not None, bool(seconds.pop("vision", 1.0))
    return {"encoded": encoded, "searched": searched, "seconds": seconds, "rounds": rounds}
