"""Tables of a study from its stored cells: per task and aggregated, as data frames and CSV files."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from kerv_cli.base.files import write_text
from kerv_cli.base.provenance import PACKAGES
from kerv_cli.base.settings import MODEL
from kerv_cli.lab.identity import (
    NOT_DETERMINING,
    NOT_DETERMINING_RUNTIME,
    OBSERVATION,
    Plain,
    flat,
    stress_of,
    without,
    work_of,
)
from kerv_cli.lab.plan import Cell, StudyPlan, seeds_text
from kerv_cli.lab.store import StoredCell, StudyStore
from kerv_cli.report.measures import MACRO, MICRO, Row, measure
from kerv_cli.worlds import specs

_MACHINE = ("executor", "workers", "device_name", "host")
_CODE = ("git_commit", "engine", "code", "run")
_STATUS_COLUMNS = (*_MACHINE, *(f"{name}_version" for name in PACKAGES), "python_version", *_CODE)


@dataclass(frozen=True)
class StudyData:
    """A study's plan and the episodes of its complete cells; its tables are computed once."""

    plan: StudyPlan
    cells: dict[str, StoredCell]  # by id
    episodes: pd.DataFrame  # one row per label and episode
    absent: list[Cell]  # planned, not complete

    @functools.cached_property
    def references(self) -> dict[str, str]:
        """Label -> the label that it is compared with: the baseline's setting under its own stress where the study has
        it, else the baseline."""
        first = {cell.label: cell for cell in reversed(self.plan.cells)}
        baseline = first.get(self.plan.baseline)
        if baseline is None:
            return dict.fromkeys(first, self.plan.baseline)
        same = {_stress(cell): label for label, cell in first.items() if _unstressed(cell) == _unstressed(baseline)}
        same[_stress(baseline)] = self.plan.baseline
        return {label: same.get(_stress(cell), self.plan.baseline) for label, cell in first.items()}

    @functools.cached_property
    def complete(self) -> dict[str, list[Cell]]:
        """Label -> its complete cells, in the plan's order."""
        cells: dict[str, list[Cell]] = {}
        for cell in self.plan.cells:
            if cell.id in self.cells:
                cells.setdefault(cell.label, []).append(cell)
        return cells

    @functools.cached_property
    def table(self) -> pd.DataFrame:
        """Two rows per label: micro over tasks and macro over difficulty groups."""
        return _frame([row for averaging in (MICRO, MACRO) for row in _rows(self, self.episodes, averaging)])

    @functools.cached_property
    def per_task(self) -> pd.DataFrame:
        """One row per task and label: tasks by name, labels in the plan's order."""
        by_task = [episodes for _, episodes in self.episodes.groupby("task", sort=True)]
        return _frame([row for episodes in by_task for row in _rows(self, episodes, "one task")])


def _stress(cell: Cell) -> tuple[str, int]:
    stress = stress_of(cell.settings)
    return stress["kind"], stress["level"]


def _unstressed(cell: Cell) -> str:
    """Hash of what determines a setting, apart from its stress."""
    plain = {**cell.settings, "world": without(cell.settings["world"], {"stress"})}
    return work_of(plain, cell.identity)


def load_study(store: StudyStore, cells: Sequence[Cell] | None = None) -> StudyData:
    """The study's plan and complete cells; with `cells`, a plan of only those cells.

    Raises:
        UsageError: no such study, or no complete cell.
        CheckpointError: a cell is damaged.
    """
    plan = store.read_plan()
    if cells is not None:
        plan = replace(plan, cells=tuple(cells))
    complete, absent = store.read_cells(plan.cells)
    episodes = _labelled_episodes([cell for cell in plan.cells if cell.id in complete], complete)
    return StudyData(plan, complete, episodes, absent)


def _labelled_episodes(cells: Sequence[Cell], complete: Mapping[str, StoredCell]) -> pd.DataFrame:
    """The episodes of the cells in order, with the columns of their cells that the tables need. complete: by id."""
    stored = [complete[cell.id] for cell in cells]
    frames = [one.of(cell) for one, cell in zip(stored, cells, strict=True)]
    episodes = pd.concat(frames, ignore_index=True)
    groups = {task: difficulty_of(task) for task in {cell.task for cell in cells}}
    columns: dict[str, list[Any]] = {
        "label": [cell.label for cell in cells],
        "cell": [cell.id for cell in cells],
        "difficulty": [groups[cell.task] for cell in cells],
        "run": [one.status["run"] for one in stored],
        "device": [cell.settings["runtime"]["device"] for cell in cells],
        "device_name": [one.status["device_name"] for one in stored],
        "dtype": [cell.settings["runtime"]["dtype"] for cell in cells],
        "threads": [cell.settings["runtime"]["threads"] for cell in cells],
    }
    lengths = [len(part) for part in frames]
    spread = {
        name: np.repeat(np.array(values, dtype=object if isinstance(values[0], str) else None), lengths)
        for name, values in columns.items()
    }
    states = episodes["initial_state"].map(tuple)  # comparable
    # strings as Python objects: these frames are cut into hundreds of small ones, which arrow's arrays are slow at
    texts = {name: episodes[name].astype(object) for name in ("task", "block", "started")}
    return episodes.assign(initial_state=states, **texts, **spread)


def difficulty_of(task: str) -> str:
    """The task's difficulty group; `other` for a task that no environment has."""
    return next((spec.tasks[task].difficulty for spec in specs().values() if task in spec.tasks), "other")


Sections = list[Row]
"""One row of a table as sections of columns. A column that only some settings have stays within its section."""


def _frame(rows: Sequence[Sections]) -> pd.DataFrame:
    """Rows as a table; within each section, columns that only later rows have are appended."""
    columns = [name for parts in zip(*rows, strict=True) for part in parts for name in part]
    merged = [{name: value for part in row for name, value in part.items()} for row in rows]
    return pd.DataFrame(merged, columns=list(dict.fromkeys(columns)))


def _rows(data: StudyData, episodes: pd.DataFrame, averaging: str) -> Iterator[Sections]:
    """One row per label that has episodes here."""
    for label in data.plan.labels:
        group = episodes[episodes["label"] == label]
        if len(group):
            baseline = episodes[episodes["label"] == data.references[label]]
            yield _row(data, label, group, baseline, averaging)


def _row(data: StudyData, label: str, episodes: pd.DataFrame, baseline: pd.DataFrame, averaging: str) -> Sections:
    tasks = sorted(set(episodes["task"]))
    cells = [cell for cell in data.complete[label] if cell.task in tasks]
    head = {
        "study": data.plan.name,
        "averaging": averaging,
        "label": label,
        "method": cells[0].settings["method"],
        "task": ";".join(tasks),
        "tasks": len(tasks),
        "difficulty": _joined(sorted(set(episodes["difficulty"]))),
        "seeds": seeds_text(episodes["seed"]),
        "repeats": int(episodes["repeat"].nunique()),
        "episodes": len(episodes),
        "baseline": data.references[label],
    }
    measures = measure(episodes, baseline, averaging)
    return [head, measures, *_origin(data, cells)]


def _origin(data: StudyData, cells: Sequence[Cell]) -> Sections:
    """Settings, weights and provenance of a row; where its cells differ, the values are joined by semicolons."""
    settings, policy = cells[0].settings, cells[0].settings["policy"]
    world, runtime, stress = settings["world"], settings["runtime"], stress_of(settings)
    statuses = [data.cells[cell.id].status for cell in cells]
    parts = without(settings, {*NOT_DETERMINING, "world", "runtime"})
    weights = {
        "policy.kind": policy.get("kind", MODEL),
        "target": policy["target"],
        "drafter": policy.get("drafter"),
        "early": policy.get("early"),
        OBSERVATION: cells[0].identity.get(OBSERVATION, ""),
        **{f"{name}_sha256": value for name, value in sorted(cells[0].identity.items()) if name != OBSERVATION},
    }
    surroundings = {
        "horizon": world["horizon"],
        "camera": world["camera"]["name"],
        **flatten({"camera": without(world["camera"], {"name"})}),
        "stress": stress["kind"],
        "stress_level": stress["level"],
        **without(runtime, NOT_DETERMINING_RUNTIME),
        **{key: _joined(status.get(key, "") for status in statuses) for key in _STATUS_COLUMNS},
        "cell": ";".join(cell.id for cell in cells),
    }
    return [{"overrides": cells[0].overrides}, flatten(parts), weights, surroundings]


def is_autoregressive(settings: Plain) -> bool:
    """Whether a setting is a model that decodes token by token: nothing drafts, nothing is skipped."""
    drafts = any(settings[part]["kind"] != "none" for part in ("prefill_draft", "proposer", "skip"))
    return not drafts and settings["policy"]["kind"] == MODEL


def flatten(settings: Plain) -> Row:
    """Nested settings as dotted keys: {"threshold": {"r": 5}} -> {"threshold.r": 5}; lists joined by semicolons."""
    return {k: _joined(v) if isinstance(v, list | tuple) else v for k, v in flat(settings).items()}


def _joined(values: Iterable[object]) -> str:
    return ";".join(dict.fromkeys(str(value) for value in values))


def values_of(table: pd.DataFrame, column: str) -> set[str]:
    """The values of a column whose rows join several by semicolons."""
    return {value for text in table[column].astype(str) for value in text.split(";")}


def csv_text(table: pd.DataFrame) -> str:
    """CSV with six significant digits; empty where a value does not exist."""
    return table.to_csv(index=False, float_format="%.6g", lineterminator="\n")


def write_csv(table: pd.DataFrame, path: Path) -> Path:
    """Writes `csv_text` atomically.

    Raises:
        StorageError: the disk refused.
    """
    write_text(path, csv_text(table))
    return path


def is_number(value: Any) -> bool:
    """Whether a value exists: neither None nor NaN."""
    return value is not None and not math.isnan(value)


def is_baseline(row: Row) -> bool:
    """Whether the row of a table is that of the setting which it is compared with."""
    return bool(row["label"] == row["baseline"])


def rows_of(table: pd.DataFrame, averaging: str | None = None) -> list[Row]:
    """The table's rows, or those of one averaging, as dicts by column."""
    rows = table if averaging is None else table[table["averaging"] == averaging]
    return [{str(name): value for name, value in row.items()} for row in rows.to_dict("records")]
