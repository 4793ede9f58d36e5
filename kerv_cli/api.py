"""The commands as Python functions: `import kerv_cli as kerv`, then `kerv.rollout(method="one_pass", task="reach")`.

Settings are text (`"threshold.r=5"`) or keywords. A setting with a dot in its name is a mapping, `threshold={"r": 5}`.
None means null. Nothing is printed. Errors are KervErrors with a message of one line.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command does before numpy loads, so that times are equal

import numpy as np
import pandas as pd

from kerv_cli.base.config import as_overrides, compose
from kerv_cli.base.errors import KervError, UnknownName, UsageError
from kerv_cli.base.wire import Message
from kerv_cli.catalogue.entries import RunEntry, find_run, find_runs, matching, store_of
from kerv_cli.episodes.resolve import resolve, resolve_rollout, study_name
from kerv_cli.lab.command import chosen_store
from kerv_cli.lab.database import opened
from kerv_cli.lab.store import ROLLOUT
from kerv_cli.lab.store import Study as StoredStudy
from kerv_cli.lab.study import check, plan
from kerv_cli.lab.workers import run
from kerv_cli.report.measures import Row
from kerv_cli.report.report import report as write_reports
from kerv_cli.report.tables import load_study as load_data
from kerv_cli.report.viewing import save_recording
from kerv_cli.serve.openpi import EXECUTED, RESET, OpenPi, metadata
from kerv_cli.serve.policy import Policy as Served
from kerv_cli.serve.settings import ServeSettings

TABLES = ("settings", "tasks", "episodes")


@dataclass(frozen=True)
class Study:
    """The complete episodes of a sweep or a rollout. Each call of a method reads them from the database again."""

    store: StoredStudy

    @property
    def name(self) -> str:
        """Name by which `load_study` and the commands find the study."""
        return self.store.name

    @property
    def folder(self) -> Path:
        return self.store.root

    def to_pandas(self, table: str = "settings") -> pd.DataFrame:
        """Return a table of results. docs/methods.md §7 and §8 explain the columns.

        Args:
            table: `settings` has a row per setting, over all tasks. `tasks` has a row per task and setting. `episodes`
                has a row per episode, with success, steps, forwards, seconds, tokens, ….

        Raises:
            UsageError: There is no such table, or no complete episode.
            CheckpointError: The database is damaged.
        """
        if table not in TABLES:
            raise UnknownName("table", table, TABLES)
        data = load_data(self.store)
        if table == "episodes":
            return data.episodes
        results = data.task_results if table == "tasks" else data.results
        return pd.DataFrame([row.columns() for row in results])

    def episodes(self) -> list[Row]:
        """Return the rows of the table `episodes`, with the same errors as `to_pandas`."""
        rows: list[Any] = self.to_pandas("episodes").to_dict("records")
        return rows

    def report(self) -> list[Path]:
        """Write the tables and page of a sweep, as `kerv report` does. Return their paths.

        Raises:
            UsageError: The study is a rollout, which has no report.
            KervError: The report could not be written.
        """
        if self.store.kind == ROLLOUT:
            raise UsageError(f"{self.name} is a rollout: kerv reports sweeps")
        (written,) = write_reports(self.store.database, self.name)
        return written.files


def rollout(*overrides: str, grid: bool = False, **settings: object) -> Study:
    """Run episodes of one method, as `kerv rollout` does. The same call continues an interrupted rollout.

    Args:
        *overrides: Settings as text, such as `"threshold.r=5"`.
        grid: Whether commas separate several values, as with -m. `method="ar,one_pass"` then runs both methods.
        **settings: Settings as keywords, such as `method="spec_vla", task="reach"`.

    Raises:
        UsageError: A setting or the policy does not exist, or a value is impossible.
        CheckpointError: The policy is damaged, or an artifact that the method needs is missing or damaged.
        Interrupted: The user pressed Ctrl-C. Complete episodes are kept.
        KervError: An episode failed.
    """
    with chosen_store(as_overrides(*overrides, **settings)) as typed:
        resolved = resolve_rollout(typed, grid)
        command = ["rollout", *(["-m"] if grid else []), *typed]
        planned = plan(resolved, check(resolved), opened(resolved.first.results), command, ROLLOUT)
        run(planned, write=save_recording)
    return Study(planned.study)


def sweep(study: str | Path, *overrides: str, **settings: object) -> Study:
    """Run the missing episodes of a study, as `kerv sweep` does: each setting on every task, with the same seeds.

    Args:
        study: Name of a file in conf/study, or the path of such a file.
        *overrides: Overrides as text, such as `"episodes=5"`, for everything that the study compares.
        **settings: Overrides as keyword arguments.

    Raises:
        KervError: Some episodes failed. All complete episodes are kept. Other errors are those of `rollout`.
    """
    with chosen_store(as_overrides(f"study={study}", *overrides, **settings)) as typed:
        resolved = resolve(typed)
        database, command = opened(resolved.first.results), ["sweep", *typed]
        planned = plan(resolved, check(resolved), database, command)
        failed = run(planned, write=save_recording).failed
    if failed:
        one, lost = failed[0].episodes[0], sum(len(failure.episodes) for failure in failed)
        of_all = f"{lost} of {len(planned.study.episodes)} episodes failed"
        raise KervError(f"{of_all}, {one.setting.label} on {one.task}: {failed[0].reason}")
    return Study(planned.study)


def load_study(name: str, results: str | Path = "results", store: str = "") -> Study:
    """Return an existing sweep or rollout.

    Args:
        name: The study's name or a unique part of the name, `last` for the newest, or the path of a study's file.
        results: Folder that kerv writes to.
        store: URL of the database. By default that of the environment variable KERV_STORE, or else an SQLite file in
            `results`.

    Raises:
        UsageError: Nothing matches the name, several entries match, or the match is no sweep or rollout.
    """
    with chosen_store([f"store={store}"] if store else []):
        database = opened(results)
    return Study(store_of(find_run(database, study_name(name)), database))


def runs(results: str | Path = "results", store: str = "", **filters: str) -> pd.DataFrame:
    """Return a table of all runs, the newest first, as `kerv runs list` shows it.

    Args:
        results: Folder that kerv writes to.
        store: URL of the database, as for `load_study`.
        **filters: Conditions that runs must meet: `kind`, `method`, `task` (a name, or a pattern such as `drawer*`),
            `state`.

    Raises:
        UsageError: There is no such filter or kind.
    """
    with chosen_store([f"store={store}"] if store else []):
        there = matching(find_runs(opened(results)), filters)
    return pd.DataFrame(there, columns=list(RunEntry.__dataclass_fields__))


class Policy:
    """A policy that decodes with one method, in this process, with the same answers as `kerv serve` (docs/serving.md).

    Attributes:
        info: Description of inputs and outputs: cameras, image_size (pixels), names of the numbers in the state, names
            and limits of the D numbers of an action, control_hz, chunk (H, the most actions in an answer).
        last: The last answer with all details, such as `policy_timing` (milliseconds) and `decode` (forwards, tokens,
            mode). Empty before the first answer.
    """

    def __init__(self, served: Served) -> None:
        self.info: dict[str, Any] = metadata(served)
        self.last: dict[str, Any] = {}
        self._client = OpenPi(served)
        self._begins = True

    def reset(self) -> None:
        """Start a new episode with the next observation. The history of earlier actions is forgotten."""
        self._begins = True

    def act(self, observation: Message, executed: int | None = None) -> np.ndarray:
        """Return the next actions for an observation.

        Args:
            observation: Mapping with these keys:
                `observation/<camera>`: Image (size, size, 3) uint8, or (size, size × views, 3) for several views side
                    by side. With a single camera the key can be `observation/image`.
                `observation/state`: The numbers that `info` names, or the whole state. Positions are in metres.
                `prompt`: The instruction.
            executed: Number of actions of the last answer that were executed. If None, all were executed.

        Returns:
            (h, D) float64 actions in environment units, to execute one per control step. h is at most H.

        Raises:
            UsageError: A value is missing, has a wrong shape or type, or is not finite. The message names the value.
        """
        extra = {} if executed is None else {EXECUTED: executed}
        self.last = self._client.act({**observation, **extra, RESET: self._begins})
        self._begins = False
        return self.last["actions"]


def load_policy(
    target: str = "mt10-h1", *overrides: str, method: str = "one_pass", task: str = "", **settings: object
) -> Policy:
    """Load a policy that turns observations into actions, and warm it up so that the first answer is not slower.

    Args:
        target: Name of a trained or shipped policy, or the path of its folder.
        *overrides: Settings of `kerv serve` as text, such as `"threshold.r=5"`.
        method: Name of a file in conf/method, or the path of such a file.
        task: Name of the task. Needed only by methods with calibrated constants per task, such as KERV.
        **settings: The same as keywords, such as `gripper="signed"`.

    Raises:
        UsageError: A setting or the policy does not exist, or a value is impossible.
        CheckpointError: The policy is damaged, or an artifact that the method needs is missing or belongs to another
            policy.
    """
    typed = as_overrides(*overrides, **{"policy.target": target, "method": method, "task_name": task}, **settings)
    return Policy(Served(compose("serve", typed, ServeSettings)))
