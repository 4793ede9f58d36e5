"""Composes the settings of a study, from its YAML and the command line, and of a rollout."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from kerv_cli.base.config import MOST_POINTS, compose, expand, preset_file, split, swept_keys
from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.files import read_yaml_lines
from kerv_cli.base.limits import check_label
from kerv_cli.base.registry import METHOD_KINDS
from kerv_cli.episodes.identity import without_effect
from kerv_cli.episodes.policy import tasks_of, trained_tasks
from kerv_cli.episodes.settings import RolloutSettings, StudySettings, SweepSettings
from kerv_cli.worlds import resolve_tasks, settled, spec_of

MOST_SEEDS = 10_000
"""Seeds of a block. The settings of a rollout take turns in a single one."""


@dataclass(frozen=True)
class ResolvedStudy:
    """A study whose settings are composed and checked."""

    sweep: SweepSettings
    settings: Mapping[str, RolloutSettings]  # by label, the study's order
    overrides: Mapping[str, str]  # by label, as written
    common: tuple[str, ...] = ()  # of the command line, for every setting
    varies: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  # label -> the grid's keys and values
    names: Mapping[str, str] = field(default_factory=dict)  # label -> what the settings of its grid share

    @property
    def study(self) -> StudySettings:
        """Which settings are compared."""
        return self.sweep.study

    @property
    def first(self) -> RolloutSettings:
        """The first setting, for what all have in common: tasks, results folder, processes."""
        return next(iter(self.settings.values()))

    @property
    def tasks(self) -> tuple[str, ...]:
        """Full names of the tasks, which all settings have in common."""
        return resolve_tasks(self.first.task)


def resolve(overrides: Sequence[str]) -> ResolvedStudy:
    """Return the chosen study with its settings composed.

    Args:
        overrides: Those of the sweep and its `study`; all others, and `results`, go to each setting.

    Raises:
        UsageError: An unknown key or name; a key on the command line that the study itself varies; too many settings.
    """
    of_sweep = [o for o in overrides if _key(o).split(".")[0] in SweepSettings.__dataclass_fields__]
    of_settings = [o for o in overrides if o not in of_sweep or o.startswith("results=")]
    sweep = compose("sweep", of_sweep, SweepSettings)
    study = sweep.study
    name = next((o.partition("=")[2] for o in of_sweep if _key(o) == "study"), SweepSettings.groups["study"])
    path = preset_file("study", name)
    study.name = study.name or path.stem
    keys = {_key(o) for o in of_settings}
    with _line_of(path, keys, "common"):
        common = _outranked(split(study.common), of_settings)
    points, varies, shared = _points(study, path)
    for point in points.values():
        varied = keys & {_key(override) for override in point}
        if varied:
            raise UsageError(f"study '{study.name}' sets {', '.join(sorted(varied))} itself: leave it out")
    if not points:
        raise UsageError(f"study '{study.name}' has no settings: see conf/study/demo.yaml for some")
    if study.baseline not in points:
        raise UsageError(
            f"study '{study.name}' has no setting '{study.baseline}', the baseline that its others are "
            f"compared with: add it, or name one of these by baseline=: {', '.join(points)}"
        )
    settings: dict[str, RolloutSettings] = {}
    for label, point in points.items():
        with _line_of(path, keys, f"settings.{shared[label]}", {_key(o): "common" for o in common}):
            settings[label] = compose("rollout", _outranked(common, point), RolloutSettings)
    if study.axis and not any(_has(setting, study.axis) for setting in settings.values()):
        with _line_of(path, (), "axis"):
            raise UnknownName("axis", study.axis, dict.fromkeys(key for values in varies.values() for key in values))
    narrows = any(key.startswith("policy") for key in keys) and "task" not in keys  # to the policy named
    _settle(settings.values(), settings[study.baseline], narrows)
    texts = {label: " ".join(point) for label, point in points.items()}
    return ResolvedStudy(sweep, settings, texts, tuple(of_settings), varies, shared)


@contextmanager
def _line_of(path: Path, typed: Collection[str], place: str, others: Mapping[str, str] = {}) -> Iterator[None]:
    """Put a study's file and line before the message of a UsageError.

    Args:
        path: The study's file.
        typed: Keys on the command line; a mistake in these has no line.
        place: The key in the file of what is read.
        others: Key of a setting -> key in the file, for settings that are written elsewhere.
    """
    try:
        yield
    except UsageError as error:
        line = read_yaml_lines(path, "study")[1].get(others.get(error.key, place))
        if line is None or error.key in typed:
            raise
        raise UsageError(f"{path}:{line}: {error}", error.key) from error


def _has(settings: Any, key: str) -> bool:
    """Tell whether composed settings have a dotted key."""
    for name in key.split("."):
        if not hasattr(settings, name):
            return False
        settings = getattr(settings, name)
    return True


def resolve_rollout(overrides: Sequence[str], multirun: bool) -> ResolvedStudy:
    """The settings of `kerv rollout`: one, or with -m every point of the grid that comma lists form. Tasks are no axis
    of the grid: every point runs on all of them. The first point without a drafter is the baseline. A label is the
    method's name, the parts that the command line puts in place of the method's, and the grid's values.

    Raises:
        UsageError: an unknown key or name, a value that cannot be, a grid over `results`.
    """
    shared = [word for word in overrides if word.startswith("task=")]
    words = [word for word in overrides if word not in shared]
    varied = [key for key in swept_keys(words) if key != "method"] if multirun else []
    if "results" in varied:
        raise UsageError("results= names one folder: a run lies in one place")
    settings: dict[str, RolloutSettings] = {}
    texts: dict[str, str] = {}
    varies: dict[str, dict[str, str]] = {}
    names: dict[str, str] = {}
    for point in expand(words) if multirun else [words]:
        composed = compose("rollout", [*shared, *point], RolloutSettings)
        values = _shown(_varied_values(point, varied))
        parts = [word for word in point if _key(word) in METHOD_KINDS and _key(word) not in varied]
        name = " ".join([composed.method, *parts])
        label = check_label(" ".join([name, *values]))
        names[label] = name
        settings[label], texts[label], varies[label] = composed, " ".join(point), _varied_values(point, varied)
    baseline = next((label for label, s in settings.items() if _is_ar(s)), next(iter(settings)))
    _settle(settings.values(), settings[baseline])
    study = StudySettings(name="rollout", title="", baseline=baseline, block=MOST_SEEDS)
    return ResolvedStudy(SweepSettings(study=study), settings, texts, varies=varies, names=names)


def _settle(settings: Iterable[RolloutSettings], first: RolloutSettings, narrows: bool = False) -> None:
    """Fills what the settings leave open, as `first` does: tasks, camera and horizon. narrows: of the tasks only those
    that its target was trained on stay, or where that are none, all that it was trained on."""
    trained = list(trained_tasks(first)) if narrows else []
    tasks = [task for task in tasks_of(first) if task in trained] or trained or list(tasks_of(first))
    for setting in settings:
        setting.task = tasks if trained else setting.task or tasks
        setting.world = settled(setting.world, spec_of(resolve_tasks(setting.task)[0]))


def _is_ar(settings: RolloutSettings) -> bool:
    drafts = (settings.prefill_draft, settings.proposer, settings.skip)
    return all(part.kind == "none" for part in drafts) and settings.method == "ar"


def idle_overrides(resolved: ResolvedStudy) -> dict[str, str]:
    """Overrides without effect -> why: a setting's words that it does not read, and words of the command line that no
    setting reads."""
    reasons: dict[str, str] = {}
    for label, settings in resolved.settings.items():
        idle = without_effect(settings, resolved.overrides[label].split(), sweep=True)
        reasons |= {f"{label}: {word}": why for word, why in idle.items()}
    common = [without_effect(settings, resolved.common, sweep=True) for settings in resolved.settings.values()]
    return reasons | {word: why for word, why in common[0].items() if all(word in idle for idle in common)}


def study_name(study: str) -> str:
    """Return the name under which `kerv sweep study=…` stores a study: for a file its `name:`, else its stem.

    Raises:
        UsageError: A file that is there and is no study.
    """
    path = Path(study).expanduser()
    if path.suffix not in (".yaml", ".yml"):
        return study
    return str(read_yaml_lines(path, f"study={path}")[0].get("name", path.stem)) if path.is_file() else path.stem


def _outranked(overrides: Iterable[str], by: Sequence[str]) -> list[str]:
    """Return `overrides` without the keys that `by` sets, then `by`."""
    keys = {_key(override) for override in by}
    return [*(override for override in overrides if _key(override) not in keys), *by]


def _key(override: str) -> str:
    return override.split("=", 1)[0]


def _varied_values(words: Sequence[str], varied: Collection[str]) -> dict[str, str]:
    """Return the words of a grid's keys: key -> value."""
    pairs = (word.lstrip("+").split("=", 1) for word in words)
    return {key: value for key, value in pairs if key in varied}


def _shown(values: Mapping[str, str]) -> list[str]:
    """Return a grid's values for a label: `threshold.r` 3 -> `r=3`."""
    return [f"{key.rpartition('.')[2]}={value}" for key, value in values.items()]


def _points(study: StudySettings, path: Path) -> tuple[dict[str, list[str]], dict[str, dict[str, str]], dict[str, str]]:
    """Return label -> override words, label -> what varies, label -> name. A label has both: `spec_vla r=3`."""
    points: dict[str, list[str]] = {}
    varies: dict[str, dict[str, str]] = {}
    names: dict[str, str] = {}
    for name, text in study.settings.items():
        with _line_of(path, (), f"settings.{name}"):
            overrides = split(text)
            varied = swept_keys(overrides)
            for point in expand(overrides):
                values = _varied_values(point, varied)
                label = check_label(" ".join([name, *_shown(values)]))
                points[label], varies[label], names[label] = point, values, name
        if len(points) > MOST_POINTS:
            raise UsageError(f"study '{study.name}' has more than {MOST_POINTS} settings: leave some out")
    return points, varies, names
