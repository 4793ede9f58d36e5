"""Runs a stored study again, from the settings that the database has, not from the command that was typed."""

from __future__ import annotations

import dataclasses

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.settings import CommandSettings
from kerv_cli.catalogue.entries import RunEntry, store_of
from kerv_cli.episodes.identity import OBSERVATION
from kerv_cli.episodes.policy import check
from kerv_cli.episodes.settings import settings_from
from kerv_cli.lab.database import Database
from kerv_cli.lab.plan import Setting, Wanted
from kerv_cli.lab.store import ROLLOUT
from kerv_cli.lab.study import Plan, new_name, plan_again


def plan_of(run: RunEntry, results: str) -> Plan:
    """Plan a repetition of a sweep or a rollout, or the rest of one that was interrupted.

    Raises:
        CheckpointError: The weights or the data that the run used are not there any more.
        UsageError: As `policy.check`.
    """
    database, study = Database(results), store_of(run).load()
    new = {setting.label: _checked(setting, study.tasks, results) for setting in study.settings}
    wanted = tuple(Wanted(new[one.setting.label], one.task, one.seed, one.repeat) for one in study.wanted)
    study = dataclasses.replace(study, settings=tuple(new.values()), wanted=wanted)
    name = new_name(database, study) if study.kind == ROLLOUT else f"{run.id}-again"
    return plan_again(database, study, name, again_words(run, results))


def again_words(run: RunEntry, results: str) -> list[str]:
    """Return the words after `kerv` that repeat a run, or go on with an interrupted repetition."""
    default = CommandSettings().results
    return ["runs", "rerun", run.id, *([] if results == default else [f"results={results}"])]


def _checked(setting: Setting, tasks: list[str], results: str) -> Setting:
    """Return a stored setting for this results folder, whose weights and data are the same still."""
    stored = {**setting.settings, "results": results}
    identity = check(settings_from({**stored, "task": tasks}))
    for kind in setting.identity.keys() | identity.keys():
        was, now = setting.identity.get(kind, "none"), identity.get(kind, "none")
        if kind != OBSERVATION and was != now:
            raise CheckpointError(
                f"the {kind} of {setting.label} was {was[:12]} and is {now[:12]} now: it cannot run again"
            )
    return Setting(setting.label, setting.overrides, stored, identity, setting.varies, setting.name)
