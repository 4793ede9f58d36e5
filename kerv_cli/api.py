"""The commands as Python functions: `import kerv_cli as kerv`, then `kerv.rollout(method="one_pass", task="reach")`.

Settings are those of the commands. Write them as they are typed (`"threshold.r=5"`) or as keywords: a list is a list, a
mapping sets what lies below its key (`threshold={"r": 5}`), None is null. Nothing is printed. What kerv raises
deliberately is a KervError, whose message is one line.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command, where numpy is not loaded yet: times compare

import numpy as np
import pandas as pd

from kerv_cli.base.config import as_overrides, compose
from kerv_cli.base.errors import KervError, UnknownName, UsageError
from kerv_cli.base.places import results_dir
from kerv_cli.catalogue.entries import RunEntry, find_run, find_runs, matching, store_of
from kerv_cli.episodes.resolve import resolve, resolve_rollout, study_name
from kerv_cli.lab.command import chosen_store
from kerv_cli.lab.store import ROLLOUT, StudyStore
from kerv_cli.lab.study import plan, plan_rollout, run
from kerv_cli.report import decide
from kerv_cli.report.measures import MICRO, Row
from kerv_cli.report.report import report as write_report
from kerv_cli.report.tables import load_study as load_data
from kerv_cli.report.tables import rows_of
from kerv_cli.report.viewing import save_recording
from kerv_cli.serve.interface import Message
from kerv_cli.serve.openpi import EXECUTED, RESET, OpenPi, metadata
from kerv_cli.serve.policy import Policy as Served
from kerv_cli.serve.settings import ServeSettings

TABLES = ("settings", "tasks", "episodes")


@dataclass(frozen=True)
class Study:
    """The complete episodes of a sweep or a rollout. Every call reads them from the database."""

    store: StudyStore

    @property
    def name(self) -> str:
        """The name that `load_study` and the commands take."""
        return self.store.name

    @property
    def folder(self) -> Path:
        """The folder with its files."""
        return self.store.root

    def to_pandas(self, table: str = "settings") -> pd.DataFrame:
        """Return one of its tables. Their columns are in docs/methods.md, sections 7 and 8.

        Args:
            table: settings: a row per setting, over all tasks. tasks: a row per task and setting. episodes: a row per
                setting, task, seed and repeat, with success, steps, forwards, seconds, tokens, ….

        Raises:
            UsageError: No such table, or no complete episode.
            CheckpointError: The database is damaged.
        """
        if table not in TABLES:
            raise UnknownName("table", table, TABLES)
        data = load_data(self.store)
        if table == "episodes":
            return data.episodes
        if table == "tasks":
            return data.per_task
        return data.table[data.table["averaging"] == MICRO].reset_index(drop=True)

    def episodes(self) -> list[Row]:
        """Return the rows of the table of episodes; errors as `to_pandas`."""
        return rows_of(self.to_pandas("episodes"))

    def report(self) -> list[Path]:
        """Write a sweep's tables, plots and page, as `kerv report` does, and return their files.

        Raises:
            UsageError: It is a rollout.
            KervError: As `kerv report`.
        """
        if self.store.kind == ROLLOUT:
            raise UsageError(f"{self.name} is a rollout: kerv reports sweeps")
        return write_report(self.store.database.results, self.name).files


def rollout(*overrides: str, grid: bool = False, **settings: object) -> Study:
    """Run episodes of one method, as `kerv rollout`. An interrupted rollout goes on.

    Args:
        *overrides: Settings as they are typed: `"threshold.r=5"`.
        grid: Texts with commas are grids, as with `-m`: `method="ar,one_pass"`.
        **settings: Settings as keywords: `method="spec_vla", task="reach"`.

    Raises:
        UsageError: A setting that does not exist or cannot be.
        CheckpointError: No such policy, or a damaged one.
        Interrupted: Ctrl-C; complete episodes are kept.
        KervError: An episode failed.
    """
    with chosen_store(as_overrides(*overrides, **settings)) as typed:
        resolved = resolve_rollout(typed, grid)
        planned = plan_rollout(resolved, ["rollout", *(["-m"] if grid else []), *typed])
        run(planned, save=save_recording)
    return Study(planned.store)


def sweep(study: str | Path, *overrides: str, **settings: object) -> Study:
    """Run the missing episodes of a study, as `kerv sweep`: every setting on every task with the same seeds, in turn.

    Args:
        study: A name in conf/study, or the path of such a file.
        *overrides: Settings as they are typed; they hold for each of the study's settings.
        **settings: The same as keywords.

    Raises:
        UsageError: As `rollout`.
        CheckpointError: As `rollout`.
        Interrupted: As `rollout`.
        KervError: Episodes failed; the others are kept.
    """
    with chosen_store(as_overrides(f"study={study}", *overrides, **settings)) as typed:
        resolved = resolve(typed)
        planned = plan(resolved, ["sweep", *typed])
        analysis = decide.judge(resolved.sweep.loss, print) if resolved.sweep.until == "decided" else None
        failed = run(planned, save=save_recording, analysis=analysis).failed
    if failed:
        one, lost = failed[0].episodes[0], sum(len(failure.episodes) for failure in failed)
        of_all = f"{lost} of {len(planned.study.episodes)} episodes failed"
        raise KervError(f"{of_all}, {one.setting.label} on {one.task}: {failed[0].reason}")
    return Study(planned.store)


def load_study(name: str, results: str | Path = "results", store: str = "") -> Study:
    """Return a sweep or rollout of a results folder.

    Args:
        name: As `kerv runs show` takes it: its name, a unique part of it, `last`, or a study's file.
        results: Folder that kerv writes to.
        store: URL of its database; empty: KERV_STORE, else SQLite in the folder.

    Raises:
        UsageError: None or several have that name, or it has no episodes.
    """
    with chosen_store([f"store={store}"] if store else []):
        return Study(store_of(find_run(results_dir(str(results)), study_name(name))))


def runs(results: str | Path = "results", store: str = "", **filters: str) -> pd.DataFrame:
    """Return what a results folder holds, as `kerv runs list`: a row per sweep, rollout, training, …, the newest first.

    Args:
        results: Folder that kerv writes to.
        store: As for `load_study`.
        **filters: kind, method, task (patterns such as `drawer*` too), state and since (ISO 8601, UTC).

    Raises:
        UsageError: No such filter or kind.
    """
    with chosen_store([f"store={store}"] if store else []):
        there = matching(find_runs(results_dir(str(results))), filters)
    return pd.DataFrame([asdict(run) for run in there], columns=[column.name for column in fields(RunEntry)])


class Policy:
    """A policy with a method, in this process. It answers what `kerv serve` answers (docs/serving.md).

    Attributes:
        info: Its inputs and outputs: cameras, image_size (pixels), names of the numbers in the state, names and limits
            of the D actions, control_hz, chunk (H control steps).
        last: The whole last answer, with `policy_timing` (milliseconds) and `decode` (forwards, tokens, mode).
    """

    def __init__(self, served: Served) -> None:
        self.info: dict[str, Any] = metadata(served)
        self.last: dict[str, Any] = {}
        self._client = OpenPi(served)
        self._begins = True

    def reset(self) -> None:
        """Begin a new episode with the next observation: histories are forgotten."""
        self._begins = True

    def act(self, observation: Message, executed: int | None = None) -> np.ndarray:
        """Return the actions (h, D) to execute now, float64, environment units; h ≤ H.

        Args:
            observation: `observation/<camera>`: (size, size, 3) uint8; for several views side by side
                (size, size × views, 3); `observation/image` if there is one camera. `observation/state`: the numbers
                that `info` names, or the whole state; positions in metres. `prompt`: the instruction.
            executed: Control steps of the last answer that were executed; None: all of them.

        Raises:
            UsageError: Something is missing, of another shape or type, or not finite; the message names it.
        """
        extra = {} if executed is None else {EXECUTED: executed}
        self.last = self._client.act({**observation, **extra, RESET: self._begins})
        self._begins = False
        actions: np.ndarray = self.last["actions"]
        return actions


def load_policy(
    target: str = "mt10-vision", *overrides: str, method: str = "one_pass", task: str = "", **settings: object
) -> Policy:
    """Return a policy that answers observations, warmed up.

    Args:
        target: Name of a policy of the results folder or of a shipped one, or the path of its folder.
        *overrides: Settings of `kerv serve` as they are typed.
        method: Name in conf/method, or the path of such a file.
        task: Name of the task, for parts whose levels differ between tasks.
        **settings: Settings of `kerv serve` as keywords: `gripper="signed"`, `results="results"`.

    Raises:
        UsageError: A setting that does not exist or cannot be.
        CheckpointError: No such policy, or an artifact that the method needs is missing or of another policy.
    """
    typed = as_overrides(*overrides, **{"policy.target": target, "method": method, "task_name": task}, **settings)
    return Policy(Served(compose("serve", typed, ServeSettings)))
