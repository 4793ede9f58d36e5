"""The results folder of a study. A cell is either complete or absent.

results/studies/<name>/, results/rollouts/<run>/
    run.json                      the commands that ran it; see run_file.py
    plan.yaml                     what was asked for
    cells/<id>/                   config.yaml, episodes.parquet, decodes.parquet, status.json
    failures/<id>.txt             traceback of the last attempt, until one succeeds
    claims/                       the cells that sweeps compute now; see claims.py
    rollouts/*.rrd
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import yaml

from kerv_cli.decoding.record import EpisodeRecord
from kerv_cli.errors import CheckpointError, UsageError
from kerv_cli.files import atomic_path, read_json, sha256_of, storage_errors, sync
from kerv_cli.settings import StudySettings
from kerv_cli.studies import rows
from kerv_cli.studies.claims import is_alive, write_lock
from kerv_cli.studies.plan import Cell
from kerv_cli.studies.plan_file import StudyPlan, merge_plans, plan_from_text, plan_text
from kerv_cli.studies.rows import Circumstances

_CELL_FILES = ("config.yaml", "episodes.parquet", "decodes.parquet")
_STATUS = "status.json"
_TEMPORARY = re.compile(r"\.(?P<id>[0-9a-f]+)\.(?P<host>.+)\.(?P<pid>\d+)-[0-9a-f]+\.tmp")
_OTHER_HOSTS_STALE_HOURS = 7 * 24.0  # whether a process of another machine lives is unknown


@dataclass(frozen=True)
class StoredCell:
    """A complete cell, read from its folder."""

    id: str
    folder: Path
    config: dict[str, Any]  # the study's name and the fields of Cell
    status: dict[str, Any]  # provenance, run, seconds, sums
    episodes: pd.DataFrame  # columns of rows.EPISODE_SCHEMA, and decode_seconds: per episode (decodes,) seconds


STUDIES, ROLLOUTS = "studies", "rollouts"
"""Families of stores: what `kerv sweep` and what `kerv rollout` leaves, in the same files."""


class StudyStore:
    """`results/<family>/<name>`. Only a path: picklable, and nothing is created before the first write.

    Raises:
        UsageError: a name that is no plain folder name.
    """

    def __init__(self, results: Path | str, name: str, family: str = STUDIES) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
            raise UsageError(f"study name '{name}' must be letters, digits, '_', '-', '.'")
        self.name, self.family = name, family
        self.root = Path(results) / family / name
        self.cells = self.root / "cells"
        self.rollouts = self.root / "rollouts"
        self.plan_path = self.root / "plan.yaml"
        self.failures = self.root / "failures"
        self.claims = self.root / "claims"
        self.jobs = self.root / "jobs"  # an executor's own files

    def write_plan(self, study: StudySettings, cells: Sequence[Cell]) -> StudyPlan:
        """Writes plan.yaml -> the written plan. Cells of the stored plan are kept if they have the new plan's settings
        and seeds and a task that it does not name.

        So sweeps of one study over different tasks end in one report, and changed settings or seeds replace old cells.

        Raises:
            StorageError: the disk refused.
        """
        new = StudyPlan(study.name, study.title, study.baseline, study.axis, tuple(cells), study.note)
        with write_lock(self.plan_path):
            with contextlib.suppress(UsageError, CheckpointError):  # none yet, or damaged: replaced
                new = merge_plans(self.read_plan(), new)
            with atomic_path(self.plan_path) as temporary:
                temporary.write_text(plan_text(new), encoding="utf-8")
        return new

    def read_plan(self) -> StudyPlan:
        """The stored plan.

        Raises:
            UsageError: there is no such study; the message names what to run.
            CheckpointError: the plan is damaged.
        """
        try:
            return plan_from_text(self.plan_path.read_text(encoding="utf-8"))
        except (FileNotFoundError, NotADirectoryError):
            raise UsageError(f"no study '{self.name}' in {self.root.parent}: {self.how_to_run()}") from None
        except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError) as error:
            why = " ".join(str(error).split())[:120]
            raise CheckpointError(f"{self.plan_path} is damaged ({why}): {self.how_to_run()} again") from error

    def how_to_run(self) -> str:
        """The command that runs this study, for messages."""
        return f"run `kerv sweep study={self.name}`" if self.family == STUDIES else f"run `kerv runs rerun {self.name}`"

    def has_cell(self, name: str) -> bool:
        """Whether the cell is complete; its files are compared with their hashes.

        Raises:
            CheckpointError: its folder is damaged; the message names it and the remedy.
        """
        if not (self.cells / name).exists():
            return False
        self.status_of(name)
        return True

    def status_of(self, name: str) -> dict[str, Any]:
        """status.json of a complete cell, after every other file was compared with the hash in it.

        Raises:
            CheckpointError: as `has_cell`.
        """
        folder = self.cells / name
        try:
            status = read_json(folder / _STATUS)
            for file in _CELL_FILES:
                if sha256_of(folder / file) != status["files"][file]:
                    raise CheckpointError(f"{file} is not what was written")
        except (CheckpointError, KeyError, TypeError) as error:
            raise self._damaged(folder, error) from error
        return status

    def _damaged(self, folder: Path, error: Exception) -> CheckpointError:
        why = str(error).replace(f"{folder}/", "")
        return CheckpointError(f"cell {folder} is damaged ({why}): delete that folder and {self.how_to_run()} again")

    def write_cell(
        self,
        cell: Cell,
        records: Sequence[EpisodeRecord],
        status: Mapping[str, Any],
        circumstances: Sequence[Circumstances] = (),
    ) -> bool:
        """Writes a complete cell under a temporary name, syncs it and renames it.

        Args:
            cell: what ran.
            records: its episodes, in the order of `cell.seeds`.
            status: provenance, run and seconds, JSON values.
            circumstances: of each record; unknown if empty.

        Returns:
            False if another process completed the cell first; its result stays and this one is discarded.

        Raises:
            StorageError: the disk refused; the cell is absent.
            ValueError: the records are not of this cell's task and seeds.
        """
        if [(r.task, r.seed) for r in records] != [(cell.task, seed) for seed in cell.seeds]:
            raise ValueError(f"records of other episodes than cell {cell.id} asks for ({cell.task}, {cell.seeds})")
        folder = self.cells / cell.id
        temporary = self.cells / f".{cell.id}.{socket.gethostname()}.{os.getpid()}-{secrets.token_hex(4)}.tmp"
        files = self._cell_files(cell, records, status, circumstances or [Circumstances()] * len(records))
        try:
            with storage_errors(folder):
                temporary.mkdir(parents=True)
                for file, content in files.items():
                    _write_synced(temporary / file, content)
                sync(temporary)
                return rename_once(temporary, folder)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def _cell_files(
        self,
        cell: Cell,
        records: Sequence[EpisodeRecord],
        status: Mapping[str, Any],
        circumstances: Sequence[Circumstances],
    ) -> dict[str, bytes]:
        config = {"study": self.name, **vars(cell), "seeds": list(cell.seeds)}
        episodes = [
            rows.episode_row(record, at, cell.repeat) for record, at in zip(records, circumstances, strict=True)
        ]
        decodes = [row for record in records for row in rows.decode_rows(record)]
        files = {
            "config.yaml": yaml.safe_dump(config, sort_keys=False).encode(),
            "episodes.parquet": rows.parquet_bytes(episodes, rows.EPISODE_SCHEMA),
            "decodes.parquet": rows.parquet_bytes(decodes, rows.DECODE_SCHEMA),
        }
        full = {
            "state": "complete",
            "episodes": len(records),
            "successes": sum(r.success for r in records),
            "wall_seconds": sum(r.wall_seconds for r in records),
            "started": circumstances[0].started,
            **status,
            "files": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
        }
        files[_STATUS] = (json.dumps(full, indent=2, allow_nan=False) + "\n").encode()
        return files

    def read_cell(self, name: str) -> StoredCell:
        """A complete cell.

        Raises:
            CheckpointError: it is absent or damaged, or its columns are those of another version.
        """
        folder = self.cells / name
        if not folder.exists():
            raise CheckpointError(f"cell {folder} is missing: {self.how_to_run()}")
        status = self.status_of(name)
        try:
            config = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
            episodes = pq.read_table(folder / "episodes.parquet", columns=rows.EPISODE_SCHEMA.names).to_pandas()
            decodes = pq.read_table(folder / "decodes.parquet", columns=["seed", "seconds"]).to_pandas()
        except (OSError, yaml.YAMLError, pa.ArrowInvalid, pa.ArrowKeyError) as error:
            raise self._damaged(folder, error) from error
        seconds = {seed: group.to_numpy() for seed, group in decodes.groupby("seed")["seconds"]}
        episodes["decode_seconds"] = [seconds[seed] for seed in episodes["seed"]]
        return StoredCell(name, folder, config, status, episodes)

    def read_cells(self, cells: Iterable[Cell]) -> tuple[dict[str, StoredCell], list[Cell]]:
        """The complete ones of these cells by id, and those that are absent.

        Raises:
            CheckpointError: a cell is damaged.
            UsageError: not one is complete; the message names what to run.
        """
        found: dict[str, StoredCell] = {}
        absent: list[Cell] = []
        for cell in cells:
            if cell.id in found:
                continue
            if (self.cells / cell.id).exists():
                found[cell.id] = self.read_cell(cell.id)
            else:
                absent.append(cell)
        if not found:
            raise UsageError(f"study '{self.name}' has no complete cell: {self.how_to_run()}")
        return found, absent

    def executed_actions(self, cell_id: str) -> dict[int, np.ndarray]:
        """Seed -> the actions (T, D) that its episode executed, environment units, of a complete cell's repeat.

        Raises:
            CheckpointError: the cell is damaged.
        """
        folder = self.cells / cell_id
        try:
            decodes = pq.read_table(folder / "decodes.parquet", columns=["seed", "index", "actions"]).to_pandas()
            steps = pq.read_table(folder / "episodes.parquet", columns=["seed", "steps"]).to_pandas()
        except (OSError, pa.ArrowException) as error:
            raise self._damaged(folder, error) from error
        lengths = dict(zip(steps["seed"], steps["steps"], strict=True))
        ordered = decodes.sort_values(["seed", "index"]).groupby("seed")["actions"]
        # the last chunk of an episode may go beyond its end
        return {int(s): np.concatenate([np.stack(c) for c in chunks])[: lengths[s]] for s, chunks in ordered}

    def write_failure(self, name: str, text: str) -> None:
        """Stores the traceback of a cell that failed."""
        with atomic_path(self.failures / f"{name}.txt") as temporary:
            temporary.write_text(text, encoding="utf-8")

    def clear_failure(self, name: str) -> None:
        """Removes the traceback of an earlier attempt that failed."""
        with contextlib.suppress(OSError):
            (self.failures / f"{name}.txt").unlink(missing_ok=True)

    def clean_stale(self, hours: float = 6.0) -> list[Path]:
        """Removes temporary folders of processes that are gone, older than `hours` -> those removed."""
        removed: list[Path] = []
        for folder in sorted(self.cells.glob(".*.tmp")):
            named = _TEMPORARY.fullmatch(folder.name)
            if named and _is_stale(folder, named["host"], int(named["pid"]), hours):
                shutil.rmtree(folder, ignore_errors=True)
                removed.append(folder)
        return removed


def begun_studies(results: Path | str) -> list[str]:
    """Names of the studies with a readable plan and the folder of at least one planned cell."""
    names = []
    for path in sorted((Path(results) / "studies").glob("*/plan.yaml")):
        store = StudyStore(results, path.parent.name)
        with contextlib.suppress(CheckpointError):
            if any((store.cells / cell.id).exists() for cell in store.read_plan().cells):
                names.append(store.name)
    return names


def _is_stale(folder: Path, host: str, pid: int, hours: float) -> bool:
    try:
        age = (time.time() - folder.stat().st_mtime) / 3600
    except FileNotFoundError:  # its owner was faster
        return False
    if host != socket.gethostname():
        return age > max(hours, _OTHER_HOSTS_STALE_HOURS)
    return age > hours and not is_alive(pid)


def _write_synced(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def rename_once(temporary: Path, folder: Path) -> bool:
    """Renames `temporary` to `folder`; False if `folder` exists already."""
    try:
        os.rename(temporary, folder)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
            return False
        raise
    sync(folder.parent)
    return True
