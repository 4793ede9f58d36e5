"""Composes the settings of a study, from its YAML and the command line, and of a rollout."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from kerv_cli.base.config import MOST_POINTS, Composer, compose, expand, split_words, swept_keys
from kerv_cli.base.errors import CheckpointError, UnknownName, UsageError
from kerv_cli.base.files import read_yaml_file
from kerv_cli.base.limits import check_label
from kerv_cli.base.manifests import read
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
    """The chosen study; overrides of `study…` and `results` go to the sweep, all others to each of its settings.

    Raises:
        UsageError: an unknown key or name; a key on the command line that the study itself varies; too many settings.
    """
    file = next((o for o in overrides if o.startswith("study=") and o.endswith((".yaml", ".yml"))), None)
    of_sweep = [o for o in overrides if o != file and _key(o).split(".")[0] in SweepSettings.__dataclass_fields__]
    of_settings = [o for o in overrides if o != file and (o not in of_sweep or o.startswith("results="))]
    sweep = compose("sweep", of_sweep, SweepSettings)
    if file is not None:
        names = {_key(o).removeprefix("study.") for o in of_sweep} & set(StudySettings.__dataclass_fields__)
        changes = {name: getattr(sweep.study, name) for name in names}
        sweep.study = dataclasses.replace(study_of_file(Path(file.split("=", 1)[1]).expanduser()), **changes)
    study = sweep.study
    study.name = study.name or next(o.split("=", 1)[1] for o in of_sweep if o.startswith("study="))
    keys = {_key(o) for o in of_settings}
    common = [o for o in split_words(study.common) if _key(o) not in keys] + of_settings
    points, varies, shared = _points(study)
    for words in points.values():
        varied = keys & {_key(word) for word in words}
        if varied:
            raise UsageError(f"study '{study.name}' sets {', '.join(sorted(varied))} itself: leave it out")
    if not points:
        raise UsageError(f"study '{study.name}' has no settings: see conf/study/demo.yaml for some")
    if study.baseline not in points:
        raise UsageError(
            f"study '{study.name}' has no setting '{study.baseline}', the baseline that its others are "
            f"compared with: add it, or name one of these by baseline=: {', '.join(points)}"
        )
    composer = Composer("rollout", RolloutSettings)
    settings = {label: composer.compose([*common, *words]) for label, words in points.items()}
    narrows = any(key.startswith("policy") for key in keys) and "task" not in keys  # to the policy named
    _settle(settings.values(), settings[study.baseline], narrows)
    texts = {label: " ".join(words) for label, words in points.items()}
    return ResolvedStudy(sweep, settings, texts, tuple(of_settings), varies, shared)


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


def study_of_file(path: Path) -> StudySettings:
    """The study in a file. Raises UsageError: no such file, or it is no study."""
    value = _read_study(path)
    for key in value:
        if key not in StudySettings.__dataclass_fields__:
            raise UnknownName(f"key in study={path}:", key, StudySettings.__dataclass_fields__)
    try:
        return read(StudySettings, {"name": path.stem, **value}, str(path))
    except CheckpointError as error:
        raise UsageError(str(error).replace(" is damaged", " is no study")) from error


def _read_study(path: Path) -> dict[str, Any]:
    """The study file's values. Raises UsageError where it cannot be read or is no mapping."""
    try:
        value = read_yaml_file(path)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or "it is not YAML"
        raise UsageError(f"study={path} cannot be read: {why}") from error
    if not isinstance(value, dict):
        raise UsageError(f"study={path} is no study: it needs the key settings, see conf/study/demo.yaml")
    return value


def study_name(study: str) -> str:
    """The name under which `kerv sweep study=…` stores a study: of a file its `name:`, else its stem.

    Raises:
        UsageError: a file that is there and is no study.
    """
    path = Path(study).expanduser()
    if path.suffix not in (".yaml", ".yml"):
        return study
    return str(_read_study(path).get("name", path.stem)) if path.is_file() else path.stem


def _key(override: str) -> str:
    return override.split("=", 1)[0]


def _varied_values(words: Sequence[str], varied: Collection[str]) -> dict[str, str]:
    """Return the words of a grid's keys: key -> value."""
    pairs = (word.lstrip("+").split("=", 1) for word in words)
    return {key: value for key, value in pairs if key in varied}


def _shown(values: Mapping[str, str]) -> list[str]:
    """Return a grid's values for a label: `threshold.r` 3 -> `r=3`."""
    return [f"{key.rpartition('.')[2]}={value}" for key, value in values.items()]


def _points(study: StudySettings) -> tuple[dict[str, list[str]], dict[str, dict[str, str]], dict[str, str]]:
    """Return label -> override words, label -> what varies, label -> name. A label has both: `spec_vla r=3`."""
    points: dict[str, list[str]] = {}
    varies: dict[str, dict[str, str]] = {}
    names: dict[str, str] = {}
    for name, text in study.settings.items():
        varied = swept_keys(text)
        for words in expand(text):
            values = _varied_values(words, varied)
            label = check_label(" ".join([name, *_shown(values)]))
            points[label], varies[label], names[label] = words, values, name
        if len(points) > MOST_POINTS:
            raise UsageError(f"study '{study.name}' has more than {MOST_POINTS} settings: leave some out")
    return points, varies, names
