"""Runs a stored study again, from the settings in the database."""

from __future__ import annotations

import dataclasses

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.settings import CommandSettings
from kerv_cli.catalogue.entries import RunEntry, store_of
from kerv_cli.episodes.identity import OBSERVATION
from kerv_cli.episodes.policy import check
from kerv_cli.episodes.settings import settings_from
from kerv_cli.lab.database import Database
from kerv_cli.lab.plan import Episode, Setting
from kerv_cli.lab.store import ROLLOUT, Plan
from kerv_cli.lab.study import new_name, plan_again


def plan_of(run: RunEntry, results: str) -> Plan:
    """Plan a repetition of a sweep or a rollout, or the rest of one that was interrupted.

    Raises:
        CheckpointError: The weights or the data of the run have changed.
        UsageError: A setting cannot run.
    """
    database, study = Database(results), store_of(run).load()
    new = {setting.label: _checked(setting, study.tasks, results) for setting in study.settings}
    episodes = tuple(Episode(new[one.setting.label], one.task, one.seed, one.repeat) for one in study.episodes)
    study = dataclasses.replace(study, settings=tuple(new.values()), episodes=episodes)
    name = new_name(database, study) if study.kind == ROLLOUT else f"{run.id}-again"
    return plan_again(database, study, name, again_words(run, results))


def again_words(run: RunEntry, results: str) -> list[str]:
    """Return the words after `kerv` that repeat a run, or go on with an interrupted repetition."""
    default = CommandSettings().results
    return ["runs", "rerun", run.id, *([] if results == default else [f"results={results}"])]


def _checked(setting: Setting, tasks: list[str], results: str) -> Setting:
    """Return a stored setting for this results folder. Check that its weights and data are the same."""
    stored = {**setting.settings, "results": results}
    identity = check(settings_from({**stored, "task": tasks}))
    for kind in setting.identity.keys() | identity.keys():
        before, now = setting.identity.get(kind, "none"), identity.get(kind, "none")
        if kind != OBSERVATION and before != now:
            raise CheckpointError(
                f"the {kind} of {setting.label} was {before[:12]} and is {now[:12]} now: it cannot run again"
            )
    return dataclasses.replace(setting, settings=stored, identity=identity)
