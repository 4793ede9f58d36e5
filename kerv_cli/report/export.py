"""Export runs to other trackers (trackio, Weights & Biases offline, MLflow) or to files.

The trackers are optional packages.
"""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.files import atomic_path, write_text
from kerv_cli.catalogue.entries import RunEntry, description_of, store_of
from kerv_cli.catalogue.imports import export_database
from kerv_cli.episodes.rows import DECODE_SCHEMA
from kerv_cli.lab.store import StudyStore
from kerv_cli.report.measures import MICRO
from kerv_cli.report.plots import read_log
from kerv_cli.report.tables import csv_text, flatten, is_number, load_study, rows_of

PROJECT = "kerv"
FILES = ("csv", "parquet", "db")
"""Export formats that need no tracker."""
_AT_ONCE = 100  # episodes in memory at a time


@dataclass(frozen=True)
class Tracked:
    """A run in the form in which trackers take it.

    Attributes:
        name: Name of the run in the tracker.
        group: Group of the run in the tracker.
        config: Settings.
        history: (step, measures), one per episode, or one per validation of a training.
        summary: Measures of the whole run.
    """

    name: str
    group: str
    config: Mapping[str, object]
    history: list[tuple[int, dict[str, float]]]
    summary: dict[str, float]


def export(run: RunEntry, to: str, folder: Path) -> list[str]:
    """Export a run to a tracker or to files. Return the names of the tracker's runs or of the files.

    Args:
        run: The run.
        to: A tracker or file format: a key of TRACKERS or one of FILES.
        folder: Where the files or the tracker's local data go.

    Raises:
        UnknownName: There is no such tracker or format.
        UsageError: The tracker's package is not installed (the message says how to install it), or the run has no
            episodes.
    """
    if to not in (*FILES, *TRACKERS):
        raise UnknownName("tracker", to, (*FILES, *TRACKERS))
    if to == "db":
        return [str(export_database(store_of(run), folder / run.id))]
    if to == "parquet":
        return _to_parquet(store_of(run), folder / run.id)
    if to != "csv" and importlib.util.find_spec(to) is None:
        raise UsageError(f"--to {to} needs the package {to}: pip install 'kerv[{to}]'")
    folder.mkdir(parents=True, exist_ok=True)
    return [TRACKERS[to](tracked, folder) for tracked in tracked_runs(run)]


def _to_parquet(store: StudyStore, folder: Path) -> list[str]:
    """Write all episodes of a study to episodes.parquet and all its decodes to decodes.parquet."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    frame = store.frame()
    if frame.empty:
        raise UsageError(f"study '{store.name}' has no episode yet: {store.how_to_run()}")
    keys = ["label", "task", "seed", "repeat"]
    folder.mkdir(parents=True, exist_ok=True)
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
    return [str(episodes), str(decodes)]


def tracked_runs(run: RunEntry) -> Iterator[Tracked]:
    """Yield one tracked run per setting of a sweep or rollout. Any other run is a single tracked run."""
    if not run.has_episodes:
        log = read_log(run.folder) if run.is_training else pd.DataFrame()
        history = [(int(row.pop("step")), _numbers(row)) for row in rows_of(log)]
        config = {"kind": run.kind, **flatten(description_of(run).get("settings", {}))}
        yield Tracked(run.id, run.kind, config, history, dict(run.figures))
        return
    data = load_study(store_of(run))
    for row in rows_of(data.table, MICRO):
        episodes = data.episodes.loc[data.episodes["label"] == row["label"]]
        columns = episodes[["success", "steps", "forwards", "decodes", "seconds"]].astype(float)
        columns["ms_per_step"] = 1000 * columns["seconds"] / columns["steps"]
        setting = data.settings[row["label"]]
        config = {"kind": run.kind, "run": run.id, **flatten(setting.settings), **setting.identity}
        yield Tracked(f"{run.id} {row['label']}", run.id, config, list(enumerate(rows_of(columns))), _numbers(row))


def _numbers(row: Mapping[str, object]) -> dict[str, float]:
    return {name: float(value) for name, value in row.items() if is_number(value) and math.isfinite(value)}  # type: ignore[arg-type]


def _to_csv(tracked: Tracked, folder: Path) -> str:
    rows = [{"step": step, **numbers} for step, numbers in tracked.history]
    path = folder / f"{tracked.name.replace('/', '-').replace(' ', '_')}.csv"
    write_text(path, csv_text(pd.DataFrame(rows)))
    return str(path)


def _to_trackio(tracked: Tracked, folder: Path) -> str:
    os.environ.setdefault("TRACKIO_DIR", str(folder))  # trackio reads it when it is imported
    import trackio

    return _logged(trackio.init(project=PROJECT, name=tracked.name, config=tracked.config, embed=False), tracked)


def _to_wandb(tracked: Tracked, folder: Path) -> str:
    import wandb

    about = {"name": tracked.name, "group": tracked.group, "config": tracked.config}
    return _logged(wandb.init(project=PROJECT, mode="offline", dir=str(folder), **about), tracked)


def _logged(run: Any, tracked: Tracked) -> str:
    """Send history and summary to a run of trackio or wandb, whose interfaces are the same."""
    for step, numbers in tracked.history:
        run.log(numbers, step=step)
    if tracked.summary:
        run.log({f"summary/{name}": value for name, value in tracked.summary.items()})
    run.finish()
    return tracked.name


def _to_mlflow(tracked: Tracked, folder: Path) -> str:
    import mlflow

    mlflow.set_tracking_uri((folder / "mlruns").resolve().as_uri())
    mlflow.set_experiment(PROJECT)
    with mlflow.start_run(run_name=tracked.name, tags={"group": tracked.group}):
        mlflow.log_params({name: str(value)[:500] for name, value in tracked.config.items()})
        for step, numbers in tracked.history:
            mlflow.log_metrics(numbers, step=step)
        mlflow.log_metrics({f"summary.{name}": value for name, value in tracked.summary.items()})
    return tracked.name


TRACKERS: dict[str, Callable[[Tracked, Path], str]] = {
    "csv": _to_csv,
    "trackio": _to_trackio,
    "wandb": _to_wandb,
    "mlflow": _to_mlflow,
}
"""Tracker -> function that exports a run to it. The trackers' packages and kerv's extras have the same names."""
