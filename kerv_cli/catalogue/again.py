"""Runs a stored study again, with its settings from the database."""

from __future__ import annotations

import dataclasses
import itertools

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.settings import CommandSettings
from kerv_cli.catalogue.entries import RunEntry, store_of
from kerv_cli.episodes.identity import OBSERVATION
from kerv_cli.episodes.policy import check
from kerv_cli.episodes.settings import settings_from
from kerv_cli.lab.database import Database
from kerv_cli.lab.plan import ALL, Episode, Setting
from kerv_cli.lab.runs import unfinished
from kerv_cli.lab.store import ROLLOUT, Plan, StudyStore, plan_study
from kerv_cli.lab.study import new_name


def again_words(run: RunEntry, results: str) -> list[str]:
    """Return the command-line arguments (without `kerv`) that repeat a run in a results folder, or resume this."""
    return ["runs", "rerun", run.id, *([] if results == CommandSettings().results else [f"results={results}"])]


def plan_of(run: RunEntry, results: str) -> Plan:
    """Plan to run a sweep or a rollout again. If an earlier repetition was interrupted, plan the rest of that one.

    Args:
        run: The sweep or rollout to repeat.
        results: The results folder.

    Raises:
        CheckpointError: The weights or data of the run have changed since.
        UsageError: A setting cannot run.
    """
    database, study = Database(results), store_of(run).load()
    new = {setting.label: _checked(setting, study.tasks, results) for setting in study.settings}
    episodes = tuple(Episode(new[one.setting.label], one.task, one.seed, one.repeat) for one in study.episodes)
    study = dataclasses.replace(study, settings=tuple(new.values()), episodes=episodes)
    command = again_words(run, results)
    row = unfinished(database, study.kind, command)
    if row is not None:
        name = row.name
    elif study.kind == ROLLOUT:
        name = new_name(database, study)
    else:
        names = (f"{run.id}-again{number if number > 1 else ''}" for number in itertools.count(1))
        name = next(one for one in names if not StudyStore(database, one).exists)
    study = dataclasses.replace(study, name=name)
    return plan_study(database, study, ALL, row.started if row else "", command=command)


def _checked(setting: Setting, tasks: list[str], results: str) -> Setting:
    """Return a stored setting for this results folder. Refuse it if its weights or data have changed."""
    stored = {**setting.settings, "results": results}
    identity = check(settings_from({**stored, "task": tasks}))
    for kind in setting.identity.keys() | identity.keys():
        before, now = setting.identity.get(kind, "none"), identity.get(kind, "none")
        if kind != OBSERVATION and before != now:
            raise CheckpointError(
                f"the {kind} of {setting.label} has changed from {before[:12]} to {now[:12]}: it cannot run again"
            )
    return dataclasses.replace(setting, settings=stored, identity=identity)
