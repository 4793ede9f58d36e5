"""The results folder of a study. A cell is either complete or absent.

results/studies/<name>/, results/rollouts/<run>/
    run.json                      the commands that ran it, as they were typed
    plan.yaml                     settings and cells, in the order in which they run
    cells/<id>/                   config.yaml, episodes.parquet, decodes.parquet, status.json
    failures/<id>.txt             traceback of the last attempt, until one succeeds
    claims/                       the cells that sweeps compute now; see claims.py
    rollouts/*.rrd
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import re
import secrets
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.files import (
    read_json,
    read_mapping,
    read_text,
    read_yaml,
    sha256_of,
    storage_errors,
    sync,
    to_yaml,
    visible,
    write_folder,
    write_json,
    write_text,
)
from kerv_cli.base.leftovers import clean
from kerv_cli.base.limits import check_name
from kerv_cli.base.manifests import read
from kerv_cli.base.provenance import git_commit
from kerv_cli.base.settings import StudySettings
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.lab import rows
from kerv_cli.lab.claims import write_lock
from kerv_cli.lab.identity import work_of
from kerv_cli.lab.plan import Cell, StudyPlan, merge_plans, plan_from_text, plan_text, unique_cells
from kerv_cli.lab.rows import Circumstances

_CELL_FILES = ("config.yaml", "episodes.parquet", "decodes.parquet")
_STATUS = "status.json"
_MOST_NAME = 32  # letters of the methods in a rollout's name
_READ_TOGETHER = 100  # cells whose columns are converted at once: many tables of a few rows take much memory


@dataclass(frozen=True)
class StoredCell:
    """A complete cell, read from its folder."""

    folder: Path
    config: dict[str, Any]  # the study's name and the fields of Cell
    status: dict[str, Any]  # provenance, run, seconds, sums
    # columns of rows.EPISODE_SCHEMA, and decode_seconds: per episode (decodes,) seconds
    episodes: pd.DataFrame

    def of(self, cell: Cell) -> pd.DataFrame:
        """The episodes of `cell`, which may ask for some of the seeds only."""
        if len(cell.seeds) == len(self.episodes):
            return self.episodes
        return self.episodes[self.episodes["seed"].isin(cell.seeds)]


@dataclass(frozen=True)
class Invocation:
    """One command that ran cells of a run. arguments: behind `kerv`. started, finished: ISO 8601, UTC; the second is
    empty where it was interrupted or failed. git_commit: of kerv."""

    arguments: tuple[str, ...]
    started: str
    git_commit: str
    finished: str = ""


@dataclass(frozen=True)
class _RunFile:
    """Contents of run.json, the oldest command first."""

    commands: tuple[Invocation, ...]
    format: int = 1


STUDIES, ROLLOUTS = "studies", "rollouts"
"""Families of stores: what `kerv sweep` and what `kerv rollout` leaves, in the same files."""
IMPORT = ("runs", "import")
"""The command whose episodes another harness ran."""


class StudyStore:
    """`results/<family>/<name>`. Only a path: picklable, and nothing is created before the first write.

    Raises:
        UsageError: a name that is no plain folder name.
    """

    def __init__(self, results: Path | str, name: str, family: str = STUDIES) -> None:
        self.name, self.family = check_name(name, "study name"), family
        self.root = Path(results) / family / name
        self.cells = self.root / "cells"
        self.rollouts = self.root / "rollouts"
        self.plan_path = self.root / "plan.yaml"
        self.run_path = self.root / "run.json"
        self.failures = self.root / "failures"
        self.damaged = self.root / "damaged"  # cells that were set aside
        self.claims = self.root / "claims"
        self.jobs = self.root / "jobs"  # an executor's own files

    def write_plan(self, study: StudySettings, cells: Sequence[Cell]) -> None:
        """Writes plan.yaml. Cells of the stored plan are kept if they have the new plan's settings and seeds and a task
        that it does not name.

        So sweeps of one study over different tasks end in one report, and changed settings or seeds replace old cells.

        Raises:
            StorageError: the disk refused.
        """
        new = _plan_of(study, cells)
        with write_lock(self.plan_path):
            with contextlib.suppress(UsageError, CheckpointError):  # none yet, or damaged: replaced
                new = merge_plans(self.read_plan(), new)
            write_text(self.plan_path, plan_text(new))

    def begin(self, study: StudySettings, cells: Sequence[Cell], arguments: Sequence[str]) -> None:
        """Writes the plan and notes the command. The folder of a new run appears with both in it.

        Raises:
            StorageError: the disk refused.
        """

        def fill(folder: Path) -> None:
            run = asdict(_RunFile((Invocation(tuple(arguments), _now(), git_commit()),)))
            (folder / self.plan_path.name).write_text(plan_text(_plan_of(study, cells)), encoding="utf-8")
            (folder / self.run_path.name).write_text(json.dumps(run, indent=2) + "\n", encoding="utf-8")

        if self.root.exists() or not write_folder(self.root, fill):
            self.write_plan(study, cells)
            self.note_command(arguments)

    def read_plan(self) -> StudyPlan:
        """The stored plan.

        Raises:
            UsageError: there is no such study; the message names what to run.
            CheckpointError: the plan is damaged.
        """
        try:
            # a folder that was renamed by hand is the study of its new name
            return replace(plan_from_text(read_text(self.plan_path)), name=self.name)
        except (FileNotFoundError, NotADirectoryError):
            raise UsageError(f"no study '{self.name}' in {self.root.parent}: {self.how_to_run()}") from None
        except (OSError, ValueError, CheckpointError) as error:
            why = " ".join(str(error).split())[:120]
            raise CheckpointError(f"{self.plan_path} is damaged ({why}): {self.how_to_run()} again") from error

    def how_to_run(self) -> str:
        """The command that runs this study, for messages."""
        if self.family == STUDIES:
            return f"run `{self.sweep_command()}`"
        return f"run `kerv runs rerun {self.name}`"

    def commands(self) -> tuple[Invocation, ...]:
        """The commands in run.json, the oldest first; none where it is missing or damaged."""
        with contextlib.suppress(CheckpointError):
            return read(_RunFile, read_json(self.run_path), str(self.run_path), tolerant=True).commands
        return ()

    @property
    def is_imported(self) -> bool:
        """Whether the episodes come from another harness (`kerv runs import`)."""
        return any(command.arguments[:2] == IMPORT for command in self.commands())

    def note_command(self, arguments: Sequence[str]) -> None:
        """Appends a command that begins now to run.json. Raises StorageError: the disk refused."""
        self._write_commands(*self.commands(), Invocation(tuple(arguments), _now(), git_commit()))

    def note_finished(self) -> None:
        """Notes that the last command came to its end. Raises StorageError: the disk refused."""
        *before, last = self.commands()
        self._write_commands(*before, replace(last, finished=_now()))

    def _write_commands(self, *commands: Invocation) -> None:
        write_json(self.run_path, asdict(_RunFile(commands)))

    def interrupted_since(self, arguments: Sequence[str]) -> str:
        """When the command was begun that this one goes on with: the same arguments, never finished. Empty where there
        is none."""
        since = ""
        for command in reversed(self.commands()):
            if command.arguments != tuple(arguments) or command.finished:
                break
            since = command.started
        return since

    def sweep_command(self, *further: str) -> str:
        """The command that runs the study, as it was typed last; without a record, by its name. further: overrides to
        add."""
        sweeps = (command.arguments for command in reversed(self.commands()) if command.arguments[:1] == ("sweep",))
        words: Iterable[str] = next(sweeps, ("sweep", f"study={self.name}"))
        words = (word for word in words if not word.startswith(("results=", "rerun=", "-")))
        return shlex.join(["kerv", *words, *further])

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
            status = read_mapping(folder / _STATUS)
            if status["sha256"] != _seal(status):
                raise CheckpointError(f"{_STATUS} is not what was written")
            for file in _CELL_FILES:
                if sha256_of(folder / file) != status["files"][file]:
                    raise CheckpointError(f"{file} is not what was written")
        except (CheckpointError, KeyError, TypeError, AttributeError) as error:
            raise _damaged(folder, error) from error
        return status

    def folders(self) -> list[Path]:
        """Folders of its cells, damaged ones among them; none that is being written or removed."""
        return [path for path in visible(self.cells) if path.is_dir()]

    def described(self, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
        """config.yaml and status.json of a cell, unchecked: ten thousand are read to plan a sweep.

        Raises:
            CheckpointError: they cannot be read.
        """
        folder = self.cells / name
        try:
            config = _read_config(read_text(folder / "config.yaml"))
            return config, read_mapping(folder / _STATUS)
        except (OSError, ValueError, CheckpointError) as error:
            raise _damaged(folder, error) from error

    def set_aside(self, name: str) -> Path:
        """Moves a damaged cell out of the way -> where it lies now. The next sweep computes it again.

        Raises:
            StorageError: the disk refused.
        """
        paths = (self.damaged / (name if not i else f"{name}-{i}") for i in range(10_000))
        path = next(path for path in paths if not path.exists())
        with storage_errors(path):
            self.damaged.mkdir(exist_ok=True)
            os.rename(self.cells / name, path)
            sync(self.damaged)
        return path

    def damages(self) -> list[tuple[str, CheckpointError]]:
        """Name of every cell that is not what was written -> why."""
        damages = []
        for folder in self.folders():
            try:
                self.status_of(folder.name)
            except CheckpointError as error:
                damages.append((folder.name, error))
        return damages

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
        at = circumstances or [Circumstances()] * len(records)
        sums = {
            "episodes": len(records),
            "successes": sum(r.success for r in records),
            "wall_seconds": sum(r.wall_seconds for r in records),
            "timed": all(r.timed for r in records),
            "started": at[0].started,
        }
        return self.write_tables(cell, rows.tables_of(records, at, cell.repeat), {**sums, **status})

    def write_tables(self, cell: Cell, tables: Mapping[str, pa.Table], status: Mapping[str, Any]) -> bool:
        """Writes a complete cell of these tables; returns and raises as `write_cell`. status: its entries, sums over
        the episodes among them."""
        config = {"study": self.name, **asdict(cell), "seeds": list(cell.seeds)}
        files = {"config.yaml": to_yaml(config).encode()}
        files |= {name: rows.table_bytes(table) for name, table in tables.items()}
        hashes = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
        full: dict[str, Any] = {"state": "complete", **status, "files": hashes}
        full["sha256"] = _seal(full)
        files[_STATUS] = (json.dumps(full, indent=2, allow_nan=False) + "\n").encode()

        def fill(temporary: Path) -> None:
            for file, content in files.items():
                (temporary / file).write_bytes(content)

        return write_folder(self.cells / cell.id, fill)

    def read_cell(self, name: str) -> StoredCell:
        """A complete cell.

        Raises:
            CheckpointError: it is absent or damaged.
        """
        return self._read([name])[0]

    def _read(self, names: Sequence[str]) -> list[StoredCell]:
        """Complete cells, whose columns are converted at once; raises as `read_cell`."""
        described, tables = [], []
        for folder in (self.cells / name for name in names):
            if not folder.exists():
                raise CheckpointError(f"cell {folder} is missing: {self.how_to_run()}")
            status = self.status_of(folder.name)
            try:
                config = _read_config(read_text(folder / "config.yaml"))
                tables.append(rows.read_tables(folder))
            except (OSError, ValueError, pa.ArrowException) as error:
                raise _damaged(folder, error) from error
            described.append((folder, config, status))
        frames = rows.frames_of(tables)
        return [StoredCell(*one, frame) for one, frame in zip(described, frames, strict=True)]

    def read_cells(self, cells: Iterable[Cell]) -> tuple[dict[str, StoredCell], list[Cell]]:
        """The complete ones of these cells by id, and those that are absent.

        Raises:
            CheckpointError: a cell is damaged, or is not of these settings.
            UsageError: not one is complete; the message names what to run.
        """
        unique = unique_cells(cells)
        on_disk = [cell for cell in unique if (self.cells / cell.id).exists()]
        if not on_disk:
            raise UsageError(f"study '{self.name}' has no complete cell: {self.how_to_run()}")
        results: dict[str, StoredCell] = {}
        for first in range(0, len(on_disk), _READ_TOGETHER):
            part = on_disk[first : first + _READ_TOGETHER]
            for cell, result in zip(part, self._read([cell.id for cell in part]), strict=True):
                if not is_result_of(result.config, cell):
                    raise CheckpointError(
                        f"{self.plan_path} is damaged (it says something else of cell {cell.id} than the cell): "
                        f"{self.how_to_run()} again"
                    )
                results[cell.id] = result
            pa.default_memory_pool().release_unused()
        return results, [cell for cell in unique if cell.id not in results]

    @property
    def recordings(self) -> list[Path]:
        """Its .rrd files, by name."""
        return sorted(self.rollouts.glob("[!.]*.rrd"))

    def write_failure(self, name: str, text: str) -> None:
        """Stores the traceback of a cell that failed."""
        write_text(self.failures / f"{name}.txt", text)

    def clear_failure(self, name: str) -> None:
        """Removes the traceback of an earlier attempt that failed."""
        with contextlib.suppress(OSError):
            (self.failures / f"{name}.txt").unlink(missing_ok=True)
            self.failures.rmdir()  # refused where others are left


def _damaged(folder: Path, error: Exception) -> CheckpointError:
    why = str(error).replace(f"{folder}/", "")
    return CheckpointError(f"cell {folder} is damaged ({why}): `kerv doctor --repair` sets it aside")


def _plan_of(study: StudySettings, cells: Sequence[Cell]) -> StudyPlan:
    return StudyPlan(study.name, study.title, study.baseline, study.axis, tuple(cells), study.note)


def _read_config(text: str) -> dict[str, Any]:
    """config.yaml, entry by entry: the settings, by far the longest, are those of many cells and are read once."""
    entries = (_read_entry(entry) for entry in re.split(r"^(?=\w)", text, flags=re.MULTILINE) if entry)
    return {key: value for entry in entries for key, value in entry.items()}


@functools.lru_cache(maxsize=1024)
def _read_entry(text: str) -> dict[str, Any]:
    entry = read_yaml(text)
    if not isinstance(entry, dict):
        raise ValueError(f"'{text[:40]}' is no entry")
    return entry


def is_result_of(config: Mapping[str, Any], cell: Cell) -> bool:
    """Whether a stored cell's config.yaml holds the work of `cell` on all of its seeds, whatever the engine was."""
    try:
        work = work_of(config["settings"], config["identity"]), config["task"], config["repeat"]
        return work == cell.work and set(cell.seeds) <= set(config["seeds"])
    except (KeyError, TypeError, AttributeError, ValueError):
        return False


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def new_run_id() -> str:
    """The id of a run that begins now, which its cells name: `20260301T142530Z-0f1e2d`."""
    return f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(3)}"


def _seal(status: Mapping[str, Any]) -> str:
    """Hash of all entries of a status but its own."""
    text = json.dumps({key: value for key, value in status.items() if key != "sha256"}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def stores(results: Path | str, family: str = STUDIES) -> list[StudyStore]:
    """The runs of a family in a results folder, by name; neither hidden folders nor those without a plan. What a killed
    command left among them is removed."""
    with contextlib.suppress(OSError):
        clean(Path(results) / family)
    folders = visible(Path(results) / family)
    return [StudyStore(results, folder.name, family) for folder in folders if (folder / "plan.yaml").is_file()]


def begun_studies(results: Path | str) -> list[str]:
    """Names of the studies with a readable plan and the folder of at least one planned cell."""
    names = []
    for store in stores(results):
        with contextlib.suppress(CheckpointError):
            if any((store.cells / cell.id).exists() for cell in store.read_plan().cells):
                names.append(store.name)
    return names


def new_rollout(results: str | Path, cells: Sequence[Cell]) -> StudyStore:
    """The folder of a new rollout, not yet created, by date, time and methods: `20260301-142530-ar-spec_vla`."""
    methods = "-".join(dict.fromkeys(str(cell.settings["method"]) for cell in cells))
    name = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{re.sub(r'[^A-Za-z0-9_.-]', '_', methods)[:_MOST_NAME]}"
    store = StudyStore(results, name, ROLLOUTS)
    return StudyStore(results, f"{name}-{secrets.token_hex(2)}", ROLLOUTS) if store.root.exists() else store
