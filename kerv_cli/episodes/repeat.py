"""Find the command that repeats a stored episode."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from kerv_cli.base.config import as_overrides, groups, split
from kerv_cli.base.errors import UsageError
from kerv_cli.base.registry import PART_GROUPS
from kerv_cli.episodes.identity import Identity, Plain, determining, flat, work_of
from kerv_cli.episodes.resolve import resolve_rollout
from kerv_cli.methods.settings import EXPERT


def repeating_words(settings: Plain, identity: Identity, typed: str, task: str, seeds: Sequence[int]) -> list[str]:
    """Return the arguments of `kerv` that run episodes again with stored settings.

    Args:
        settings: The stored settings.
        identity: Hashes of the weights and data that the stored settings use.
        typed: Overrides that defined the setting in its study.
        task: Name of the task.
        seeds: Seeds of the episodes, which must be successive. The command records all these episodes.

    Raises:
        UsageError: No command repeats the episodes, because the presets in conf/ have changed or the seeds have gaps.
    """
    if list(seeds) != list(range(seeds[0], seeds[0] + len(seeds))):
        raise UsageError("its skip rule adapts from episode to episode, and the seeds before it have gaps")
    place = [f"task={task}", f"seed={seeds[0]}", f"episodes={len(seeds)}", *(["record=-1"] if len(seeds) > 1 else [])]

    def composed() -> Plain:
        return asdict(resolve_rollout([*words, *place], multirun=False).first)

    words = [_first_word(settings, typed)]
    now = composed()
    # parts first: which other keys exist depends on them
    changed = [group for group in PART_GROUPS if group in settings and settings[group]["kind"] != now[group]["kind"]]
    words += [f"{group}={settings[group]['kind']}" for group in changed]
    have = _keys(composed())
    for key, value in _keys(settings).items():
        if have.get(key) != value:
            words.append(f"{key}={_text(value)}")
    if work_of(composed(), identity) != work_of(settings, identity):
        raise UsageError("the presets in conf/ have changed since: no command gives these settings any more")
    return ["rollout", *words, *place]


def _first_word(settings: Plain, typed: str) -> str:
    """Return the override that chooses the method, such as `method=kerv`, or `method=PATH` for a file of the user."""
    if settings["policy"]["kind"] == EXPERT:
        return "policy=expert"
    path = next((word for word in split(typed) if re.fullmatch(r"method=.+\.ya?ml", word)), "")
    known = settings["method"] in groups()["method"]
    return path or f"method={settings['method'] if known else 'ar'}"


def _keys(settings: Plain) -> dict[str, Any]:
    """Return all settings `policy.*` and the other settings that determine a result, with dotted keys."""
    policy: Mapping[str, Any] = settings["policy"]
    return {**flat({"policy": policy}), **flat(determining(settings))}


def _text(value: Any) -> str:
    """Write a value as Hydra reads it."""
    if isinstance(value, str) and (
        not re.fullmatch(r"[A-Za-z_./][\w./:+-]*", value) or value in ("null", "true", "false")
    ):
        return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"
    return as_overrides(x=value)[0].removeprefix("x=")
