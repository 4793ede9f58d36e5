"""Results folders of version 0.1.0: a folder per study with plan.yaml, run.json and a folder per cell."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import sqlalchemy as sa

from kerv_cli.base.errors import CheckpointError, KervError, UnknownName, UsageError
from kerv_cli.base.files import read_mapping, read_yaml_file, sha256_of, visible
from kerv_cli.base.foreign import foreign_table
from kerv_cli.base.limits import check_label
from kerv_cli.base.manifests import read
from kerv_cli.base.registry import SETTINGS_GROUPS, part_of
from kerv_cli.catalogue.stored import left_out, take
from kerv_cli.episodes.identity import ENGINE
from kerv_cli.episodes.rows import DECODE_SCHEMA, EPISODE_SCHEMA
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.database import COMPLETE, INTERRUPTED, RUNS, Database, new_id
from kerv_cli.lab.plan import Setting, Study, Wanted, plain_settings
from kerv_cli.lab.store import ROLLOUT, SWEEP, Foreign, StudyStore
from kerv_cli.methods.settings import with_artifacts

_FOLDERS = {"studies": SWEEP, "rollouts": ROLLOUT}
_PLANS = "[!.]*/plan.yaml"
_ROW = (*EPISODE_SCHEMA.names, "order", "started", "worker_pid")
_NOT_OF_BLOCK = {"state", "episodes", "successes", "seconds", "wall_seconds", "timed", "started", "files", "sha256",
                 "run", "pid", "code"}  # fmt: skip
_DAMAGE = (OSError, ValueError, KeyError, TypeError, AttributeError, pa.ArrowException, KervError)


def is_older(path: Path) -> bool:
    """Return whether a folder holds studies or rollouts as version 0.1.0 wrote them."""
    return any(True for name in _FOLDERS for _ in path.glob(f"{name}/{_PLANS}"))


def import_older(results: Database, path: Path, name: str = "") -> tuple[list[str], list[str]]:
    """Copy every study and rollout into the database -> (their names, lines about what is left out).

    Recordings and artifacts are files and stay where they are.

    Args:
        results: Where they go.
        path: The older results folder.
        name: Of the study here; empty: as there.

    Raises:
        UsageError: A name for several studies. StorageError: The disk refused.
    """
    plans = [(kind, plan.parent) for room, kind in _FOLDERS.items() for plan in sorted(path.glob(f"{room}/{_PLANS}"))]
    if name and len(plans) != 1:
        raise UsageError(f"name={name}: {path} holds {len(plans)} studies, a name is for one")
    names, notes = [], []
    for kind, folder in plans:
        store = StudyStore(results, name or folder.name, kind)
        try:
            study, cells = _study_of(folder, store.name, kind)
            commands = _commands(folder)
        except _DAMAGE as error:
            notes.append(f"{folder} was left out: {_why(error)}")
            continue
        words = tuple(commands[-1]["arguments"]) if commands else ("runs", "import", str(path))
        if take(store, study, _episodes(folder, cells, notes), words):
            _note_earlier(results, store, commands[:-1])
            names.append(store.name)
        else:
            notes.append(left_out(store))
    return names, notes


def _why(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__} {error}".split())[:160]


def _study_of(folder: Path, name: str, kind: str) -> tuple[Study, list[tuple[str, list[Wanted]]]]:
    """Return the study of a plan.yaml, and the id of each of its cells with the episodes that it holds."""
    plan = read_yaml_file(folder / "plan.yaml")
    settings = {
        str(label): Setting(
            check_label(str(label)), str(one["overrides"]), completed(one["settings"]), dict(one["identity"])
        )
        for label, one in plan["labels"].items()
    }
    cells = []
    for cell in plan["cells"]:
        setting, repeat = settings[str(cell["label"])], int(cell["repeat"])
        seeds = _seeds(str(cell["seeds"]))
        cells.append((str(cell["id"]), [Wanted(setting, str(cell["task"]), seed, repeat) for seed in seeds]))
    title, baseline, axis, note = (str(plan[key] or "") for key in ("title", "baseline", "axis", "note"))
    if baseline not in settings:
        raise ValueError(f"the baseline '{baseline}' is no setting of it")
    wanted = tuple(dict.fromkeys(one for _, part in cells for one in part))
    return Study(name, tuple(settings.values()), wanted, kind, title, baseline, axis, note), cells


def completed(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return stored settings with today's defaults for what they lack, without what no longer exists.

    A part that is not registered here keeps its settings as they are.
    """
    plain = dataclasses.asdict(read(RolloutSettings, with_artifacts(stored), "a stored setting", tolerant=True))
    for group in SETTINGS_GROUPS:
        value = stored.get(group)
        if isinstance(value, Mapping):
            plain[group] = dict(value)
            with contextlib.suppress(UnknownName):
                schema = part_of(group, value["kind"]).settings
                plain[group] = dataclasses.asdict(read(schema, value, f"a stored setting's {group}", tolerant=True))
    return plain_settings(plain)


def _seeds(text: str) -> list[int]:
    """Return the seeds of `seeds_text`: "5-7;9" -> 5, 6, 7, 9."""
    ends = [(part.partition("-")[0], part.partition("-")[2]) for part in text.split(";")]
    return [seed for first, last in ends for seed in range(int(first), int(last or first) + 1)]


def _episodes(folder: Path, cells: list[tuple[str, list[Wanted]]], notes: list[str]) -> Iterator[Foreign]:
    """Yield the episodes of every whole cell; a damaged or missing one leaves a line in `notes`."""
    for name, wanted in cells:
        # what was run again is beside it as ID-2, ID-3, …; the newest counts
        again = [path for path in visible(folder / "cells") if path.name.startswith(f"{name}-")]
        again.sort(key=lambda path: (len(path.name), path.name))
        cell = again[-1] if again else folder / "cells" / name
        if not cell.is_dir():
            continue  # it had not run yet
        try:
            rows = list(_of_cell(cell, wanted))
        except _DAMAGE as error:
            notes.append(f"{cell} was left out: {_why(error)}")
            continue
        yield from rows


def _of_cell(cell: Path, wanted: list[Wanted]) -> Iterator[Foreign]:
    status = read_mapping(cell / "status.json")
    for file, digest in status["files"].items():
        if sha256_of(cell / Path(file).name) != digest:
            raise CheckpointError(f"{file} is not as it was written")
    if status.get("engine", 1) != ENGINE:
        raise CheckpointError(f"its tokens are of engine {status['engine']}, those of today of engine {ENGINE}")
    rows = {row["seed"]: row for row in foreign_table(cell / "episodes.parquet").to_pylist()}
    decodes = foreign_table(cell / "decodes.parquet")
    about = {"engine": 1, **{name: value for name, value in status.items() if name not in _NOT_OF_BLOCK}}
    run, code = str(status.get("run", "")), str(status.get("code", ""))
    for one in wanted:
        row = rows[one.seed]
        values = {name: _plain(row.get(name)) for name in _ROW}
        mine = decodes.filter(pa.compute.equal(decodes["seed"], one.seed))
        columns = [_column(mine, field) for field in DECODE_SCHEMA]
        yield Foreign(one, values, pa.table(columns, schema=DECODE_SCHEMA), str(row["block"]), about, run, code=code)


def _column(table: pa.Table, field: pa.Field) -> pa.ChunkedArray | pa.Array:
    present = field.name in table.column_names
    return table[field.name].cast(field.type) if present else pa.nulls(table.num_rows, field.type)


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def _commands(folder: Path) -> list[dict[str, Any]]:
    path = folder / "run.json"
    return [dict(one) for one in read_mapping(path)["commands"]] if path.is_file() else []


def _note_earlier(results: Database, store: StudyStore, commands: list[dict[str, Any]]) -> None:
    """Write a row for each command before the last, whose row the import itself has."""
    with results.writing() as connection:
        for one in commands:
            connection.execute(
                sa.insert(RUNS).values(
                    id=new_id(), kind=store.kind, name=store.name, command=list(one["arguments"]),
                    status=COMPLETE if one.get("finished", "-") else INTERRUPTED, host="", pid=0, heartbeat=0.0,
                    started=str(one.get("started", "")), finished=one.get("finished") or None,
                    git_commit=str(one.get("git_commit", "")), done=0, total=0, message="",
                )
            )  # fmt: skip
