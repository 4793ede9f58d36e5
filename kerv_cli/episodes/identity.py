"""What determines an episode's result: settings, weights and data, task, seed and `ENGINE`.

Two episodes with the same identity have the same tokens, so studies share them. Commit, versions, machine and number of
workers are stored beside the result.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from kerv_cli.base.settings import read_settings
from kerv_cli.episodes.settings import RolloutSettings

# Version of the decoding. Increase it with every change of the code that alters tokens or actions.
# tests/test_golden.py checks this.
# 2: a streak compares the first source's draft on its own path, and the filter of KERV's code waits for four actions.
# 3: a streak judges the chunk's last token, and `hold_strict=false` releases drafted strict DoFs.
ENGINE = 3

Plain = Mapping[str, Any]  # a rollout's settings as nested dictionaries, lists and plain values, as they are stored

# Hashes of the weights and data that a setting uses, e.g. {"target": sha256, "drafter": sha256}.
Identity = Mapping[str, str]

OBSERVATION = "observation"  # key of the identity's only entry that is not a hash: what the target observes

# Left out of a setting's hash: they do not change a result (folders, recording, names), or are stored separately (task
# and seed; the policy by its hashes). All other settings are hashed.
NOT_DETERMINING = frozenset(
    {"task", "episodes", "seed", "policy", "method", "results", "store", "record", "record_size"}
)
NOT_DETERMINING_RUNTIME = frozenset({"workers", "launch"})
NO_LONGER = frozenset({"ar_ms", "batch"})  # settings `rollout.*` of earlier versions, which stored settings may hold


@dataclass(frozen=True, eq=False)
class Setting:
    """One setting that a study compares: a method with all its options. It is a row of the study's table."""

    label: str  # the setting's name in the study
    overrides: tuple[str, ...]  # all overrides, `key=value`, from which the setting is composed
    settings: Plain  # the rollout's settings as nested plain values, without the task
    identity: Identity  # hashes of the weights and data that the setting reads
    # this setting's values for the keys that differ within its grid, by key. An entry of the study expands into a
    # grid of settings if an override has several values.
    varies: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""  # name of the grid. If empty, it becomes the label.

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or self.label)

    @functools.cached_property
    def work(self) -> str:
        """Hash of the settings, weights and data that determine a result. Task and seed are not included."""
        return work_of(self.settings, self.identity)

    @property
    def depends_on_order(self) -> bool:
        skip = self.settings["skip"]
        return bool(skip.get("up") or skip.get("down"))

    def on(self, *tasks: str) -> RolloutSettings:
        settings = {**self.settings, "task": list(tasks)}
        if isinstance(rollout := settings.get("rollout"), Mapping):
            settings["rollout"] = without(rollout, NO_LONGER)
        return read_settings(RolloutSettings, settings)


def differences(new: Setting, old: Setting | None) -> str:
    """Describe in a few words how a setting differs from the stored setting with the same label (None: not stored)."""
    target = new.settings["policy"]["target"]
    if old is None or old.settings["policy"]["target"] != target:
        return "new setting"
    changes = []
    for kind in _differing(new.identity, old.identity):
        if kind == "target":
            changes.append(f"weights of {target} changed")
        elif kind != OBSERVATION:
            changes.append(f"{kind} changed")
    before, after = flat(determining(old.settings)), flat(determining(new.settings))
    changes += [f"{key} {before.get(key)} → {after.get(key)}" for key in _differing(after, before)]
    return ", ".join(changes[:3]) or f"the decoding has changed since, to engine {ENGINE}"


def _differing(new: Mapping[str, Any], old: Mapping[str, Any]) -> list[str]:
    return [key for key in dict.fromkeys([*new, *old]) if new.get(key) != old.get(key)]


def hash_of(value: object) -> str:
    """Return a short hash of a JSON value: 16 hexadecimal digits of the SHA-256 of its canonical text."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()[:16]


def work_of(settings: Plain, identity: Identity) -> str:
    """Return the hash of all that determines results except task and seed: settings, weights, data and ENGINE."""
    hashes = {f"{name}_sha256": value for name, value in without(identity, {OBSERVATION}).items()}
    policy = {"kind": settings["policy"]["kind"], **hashes}
    return hash_of({"settings": determining(settings), "policy": policy, "engine": ENGINE})


def determining(settings: Plain) -> dict[str, Any]:
    runtime = without(settings["runtime"], NOT_DETERMINING_RUNTIME)
    return {**without(settings, NOT_DETERMINING), "runtime": runtime}


def stress_of(settings: Plain) -> dict[str, Any]:
    """Return the kind and level of a setting's stress (docs/stress.md). At level 0 the kind is `none`."""
    stress = settings["world"]["stress"]
    level = int(stress["level"])
    return {"kind": stress["kind"] if level else "none", "level": level}


def stress_text(settings: Plain) -> str:
    stress = stress_of(settings)
    return f", stress {stress['kind']} {stress['level']}" if stress["level"] else ""


def flat(settings: Plain, prefix: str = "") -> dict[str, Any]:
    pairs: dict[str, Any] = {}
    for key, value in settings.items():
        pairs |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return pairs


def without(settings: Plain, names: Collection[str]) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if key not in names}
