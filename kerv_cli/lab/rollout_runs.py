"""`kerv rollout` as a run: one folder below results/rollouts with the files of a study, one cell per episode."""

from __future__ import annotations

import contextlib
import re
import secrets
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from kerv_cli.base.config import compose, expand, swept_keys
from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.settings import RolloutSettings, StudySettings
from kerv_cli.lab.plan import Cell, unique_cells
from kerv_cli.lab.resolve import ResolvedStudy
from kerv_cli.lab.reuse import Stock, cover
from kerv_cli.lab.store import ROLLOUTS, StudyStore, stores
from kerv_cli.worlds import resolve_tasks, settled, spec_of

EPISODES_PER_CELL = 1
"""Ctrl-C loses at most the episode that runs."""

_MOST_NAME = 32  # letters of the methods in a run's name


def resolve_rollout(overrides: Sequence[str], multirun: bool) -> ResolvedStudy:
    """The settings of `kerv rollout`: one, or with -m every point of the grid that comma lists form. Tasks are no axis
    of the grid: every point runs on all of them. The first point without a drafter is the baseline.

    Raises:
        UsageError: an unknown key or name, a value that cannot be, a grid over `results`.
    """
    shared = [word for word in overrides if word.startswith("task=")]
    words = [word for word in overrides if word not in shared]
    varied = [key for key in swept_keys(words) if key != "method"] if multirun else []
    if "results" in varied:
        raise UsageError("results= names one folder: a run lies in one place")
    settings: dict[str, RolloutSettings] = {}
    written: dict[str, str] = {}
    for point in expand(words) if multirun else [words]:
        composed = compose("rollout", [*shared, *point], RolloutSettings)
        composed.world = settled(composed.world, spec_of(resolve_tasks(composed.task)[0]))
        values = [f"{key.rsplit('.', 1)[-1]}={_value(point, key)}" for key in varied]
        label = " ".join([composed.method, *values])
        settings[label], written[label] = composed, " ".join(point)
    baseline = next((label for label, s in settings.items() if _is_ar(s)), next(iter(settings)))
    study = StudySettings(name="rollout", title="", baseline=baseline, block=EPISODES_PER_CELL)
    return ResolvedStudy(study, settings, written)


def _value(point: Sequence[str], key: str) -> str:
    return next(word.split("=", 1)[1] for word in point if word.split("=", 1)[0] == key)


def _is_ar(settings: RolloutSettings) -> bool:
    drafts = (settings.prefill_draft, settings.proposer, settings.skip)
    return all(part.kind == "none" for part in drafts) and settings.method == "ar"


def begin(results: str, cells: Sequence[Cell]) -> tuple[StudyStore, list[Cell], int]:
    """Where the cells are stored, the cells under the names that they have there, and how many of them are complete:
    in a new folder, or in the newest run of the same cells that was interrupted. A run that is complete is not reused:
    a rollout is asked for in order to be run."""
    work = {(*cell.work, cell.seeds) for cell in cells}
    for store in reversed(stores(Path(results).expanduser(), ROLLOUTS)):
        with contextlib.suppress(UsageError, CheckpointError):
            if {(*cell.work, cell.seeds) for cell in store.read_plan().cells} != work:
                continue
            there = cover(cells, Stock(store, others=False))
            if there.reasons:
                return store, there.cells, len(there.cells) - len(there.reasons)
    return StudyStore(results, new_name(results, cells), ROLLOUTS), list(cells), 0


def new_name(results: str | Path, cells: Sequence[Cell]) -> str:
    """A free name: date, time and methods, e.g. `20260301-142530-ar-spec_vla`."""
    methods = "-".join(dict.fromkeys(str(cell.settings["method"]) for cell in unique_cells(cells)))
    name = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{re.sub(r'[^A-Za-z0-9_.-]', '_', methods)[:_MOST_NAME]}"
    taken = (Path(results).expanduser() / ROLLOUTS / name).exists()
    return f"{name}-{secrets.token_hex(2)}" if taken else name
