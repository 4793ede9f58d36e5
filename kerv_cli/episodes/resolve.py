"""Compose the settings of a study or of a rollout, from preset files and the command line. It loads no torch."""

from __future__ import annotations

import functools
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path

from kerv_cli.base.config import PRESETS, compose, expand, preset_file, split, swept_keys
from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.files import read_yaml_lines
from kerv_cli.base.limits import check_label
from kerv_cli.base.paths import find_target
from kerv_cli.base.registry import METHOD_KINDS, AcceptancePart, ArtifactPart
from kerv_cli.episodes.identity import NOT_DETERMINING, NOT_DETERMINING_RUNTIME, Setting, flat, work_of
from kerv_cli.episodes.settings import (
    CONSTANT,
    DEFAULT_TASKS,
    PROFILE,
    REAL,
    WAITS,
    RolloutSettings,
    StudySettings,
    SweepSettings,
)
from kerv_cli.methods.compose import Method
from kerv_cli.methods.settings import MODEL, REMOTE
from kerv_cli.worlds import resolve_tasks, settled

# Number of seeds in a block of a rollout. It is so large that all seeds of a task usually form one block.
MOST_SEEDS = 10_000


@dataclass(frozen=True)
class Point:
    """One setting of a study, given by its overrides. Overrides with several values expand into a grid of points."""

    name: str  # name of the grid. All points of a grid have the same name.
    overrides: tuple[str, ...]  # this point's overrides, `key=value`
    # this point's values for the keys that differ within the grid, by key
    varies: Mapping[str, str] = field(default_factory=dict)
    # all overrides of the setting: the study file's and the command line's
    words: tuple[str, ...] = ()

    @classmethod
    def of(cls, name: str, overrides: Sequence[str], varied: Collection[str]) -> Point:
        pairs = (override.lstrip("+").split("=", 1) for override in overrides)
        varies = {key: value for key, value in pairs if key in varied}
        return cls(name, tuple(overrides), varies, tuple(overrides))

    @property
    def label(self) -> str:
        words = [self.name]
        for key, value in self.varies.items():
            words.append(re.sub(r"\\(.)", r"\1", f"{key.rpartition('.')[2]}={value}"))  # Hydra writes ws\://HOST
        return check_label(" ".join(words))


@dataclass(frozen=True)
class ResolvedStudy:
    """A study (a comparison of several settings) whose settings are composed and checked."""

    sweep: SweepSettings
    settings: Mapping[str, RolloutSettings]  # by label, in the study's order
    points: Mapping[str, Point]  # by label
    common: tuple[str, ...] = ()  # overrides of the command line, for every setting

    @property
    def study(self) -> StudySettings:
        return self.sweep.study

    @property
    def first(self) -> RolloutSettings:
        return next(iter(self.settings.values()))

    @functools.cached_property
    def tasks(self) -> tuple[str, ...]:
        return resolve_tasks(self.first.task)

    @property
    def unseen(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {}
        for one in {one.policy.target: one for one in self.settings.values()}.values():
            trained = trained_tasks(one)
            if unseen := [task for task in self.tasks if trained and task not in trained]:
                found[one.policy.target] = unseen
        return found


def resolve(overrides: Sequence[str]) -> ResolvedStudy:
    """Compose all settings of the study that the command line chooses.

    Settings of `kerv sweep` configure the sweep. `results` and all other overrides apply to every setting of the study.
    """
    of_sweep = [one for one in overrides if _key(one).split(".")[0] in SweepSettings.__dataclass_fields__]
    of_settings = [one for one in overrides if one not in of_sweep or one.startswith("results=")]
    sweep = compose("sweep", of_sweep, SweepSettings)
    files = dict(override.split("=", 1) for override in of_sweep)
    study, path = sweep.study, preset_file("study", files.get("study", SweepSettings.groups["study"]))
    study.name, typed = study.name or path.stem, set(map(_key, of_settings))
    with _line_of(path, typed, "common"):
        common = _outranked(split(study.common), of_settings)
    points = _points(study, path, typed)
    settings: dict[str, RolloutSettings] = {}
    for label, point in points.items():
        with _line_of(path, typed, f"settings.{point.name}", dict.fromkeys(map(_key, common), "common")):
            words = _outranked(common, point.overrides)
            settings[label] = compose("rollout", words, RolloutSettings)
            points[label] = replace(point, words=tuple(words))
    if study.axis and not any(study.axis in flat(asdict(setting)) for setting in settings.values()):
        varies = chain.from_iterable(point.varies for point in points.values())
        with _line_of(path, (), "axis"):
            raise UnknownName("axis", study.axis, dict.fromkeys(varies))
    narrows = any(key.startswith("policy") for key in typed) and "task" not in typed
    _settle(settings.values(), settings[study.baseline], narrows)
    return ResolvedStudy(sweep, settings, points, tuple(of_settings))


def _points(study: StudySettings, path: Path, typed: Collection[str]) -> dict[str, Point]:
    points: dict[str, Point] = {}
    for name, text in study.settings.items():
        with _line_of(path, (), f"settings.{name}"):
            overrides = split(text)
            varied = swept_keys(overrides)
            for words in expand(overrides):
                point = Point.of(name, words, varied)
                points[point.label] = point
    if not points:
        raise UsageError(f"study '{study.name}' has no settings: see conf/study/demo.yaml for some")
    own = chain.from_iterable(point.overrides for point in points.values())
    if twice := set(map(_key, own)).intersection(typed):
        raise UsageError(f"study '{study.name}' sets {', '.join(sorted(twice))} itself: leave it out")
    if study.baseline not in points:
        raise UsageError(
            f"study '{study.name}' has no setting '{study.baseline}', the baseline that its others are "
            f"compared with: add it, or name one of these by study.baseline=: {', '.join(points)}"
        )
    return points


@contextmanager
def _line_of(path: Path, typed: Collection[str], place: str, others: Mapping[str, str] = {}) -> Iterator[None]:
    """Prefix a UsageError with the study's file and a line, unless the user typed the wrong key (`typed`).

    It is the line of the key `others[error.key]` in that file, or of `place` if `others` lacks the key.
    """
    try:
        yield
    except UsageError as error:
        line = read_yaml_lines(path, "study")[1].get(others.get(error.key, place))
        if line is None or error.key in typed:
            raise
        raise UsageError(f"{path}:{line}: {error}", error.key) from error


def resolve_rollout(overrides: Sequence[str], multirun: bool) -> ResolvedStudy:
    """Compose the settings of `kerv rollout`. With `multirun`, one per combination of values in comma lists.

    Every setting runs on all tasks. The baseline is the first autoregressive setting, else the first one. A label is
    the method's name, the parts that replace the method's own, and the values that vary.
    """
    tasks, others = _parted(overrides, {"task"})
    swept = swept_keys(others) if multirun else []
    varied = set(swept) - {"method"}
    if "results" in varied:
        raise UsageError("results= cannot have several values: a rollout has one results folder")
    settings: dict[str, RolloutSettings] = {}
    points: dict[str, Point] = {}
    for words in expand(others) if multirun else [others]:
        try:
            composed = compose("rollout", [*tasks, *words], RolloutSettings)
        except UsageError as error:
            if not swept:
                raise
            point, _ = _parted(words, swept)
            raise UsageError(f"{' '.join(point)}: {error}", error.key) from error
        parts, _ = _parted(words, set(METHOD_KINDS) - varied)
        made = Point.of(" ".join([composed.method, *parts]), words, varied)
        settings[made.label], points[made.label] = composed, made
    baseline = next((label for label, one in settings.items() if _is_ar(one)), next(iter(settings)))
    _settle(settings.values(), settings[baseline])
    study = StudySettings(name="rollout", title="", baseline=baseline, block=MOST_SEEDS)
    return ResolvedStudy(SweepSettings(study=study), settings, points)


def repeating_words(setting: Setting, task: str, seeds: Sequence[int]) -> list[str]:
    """Return the arguments of `kerv` that run stored episodes of successive seeds again, and record them."""
    if list(seeds) != list(range(seeds[0], seeds[0] + len(seeds))):
        raise UsageError("its skip rule adapts from episode to episode, and the seeds before it have gaps")
    place = [f"task={task}", f"seed={seeds[0]}", f"episodes={len(seeds)}", *(["record=-1"] if len(seeds) > 1 else [])]
    unused = (NOT_DETERMINING - {"policy", "method"}) | {f"runtime.{name}" for name in NOT_DETERMINING_RUNTIME}
    words = [word for word in setting.overrides if not any(f"{_key(word)}.".startswith(f"{key}.") for key in unused)]
    composed = asdict(resolve_rollout([*words, *place], multirun=False).first)
    if composed["runtime"]["device"] == "auto":
        composed["runtime"]["device"] = setting.settings["runtime"]["device"]
        words.append(f"runtime.device={composed['runtime']['device']}")
    if work_of(composed, setting.identity) != setting.work:
        raise UsageError("the presets in conf/ have changed since: no command gives these settings any more")
    return ["rollout", *words, *place]


def _settle(settings: Iterable[RolloutSettings], baseline: RolloutSettings, narrows: bool = False) -> None:
    tasks = list(tasks_of(baseline))
    trained = list(trained_tasks(baseline)) if narrows else []
    narrowed = [task for task in tasks if task in trained] or trained
    for setting in settings:
        setting.task = narrowed or setting.task or tasks
        setting.world = settled(setting.world, resolve_tasks(setting.task))
        if pixels := _pixels_of(setting):
            setting.world.camera = replace(setting.world.camera, size=pixels, supersample=1)


def _pixels_of(settings: RolloutSettings) -> int:
    if settings.policy.kind != REMOTE:
        return 0
    from kerv_cli.episodes.interface import read_interface  # takes numpy

    return read_interface(settings.policy.interface).pixels


def _is_ar(settings: RolloutSettings) -> bool:
    drafts = {settings.prefill_draft.kind, settings.proposer.kind, settings.skip.kind}
    return drafts == {"none"} and settings.method == "ar"


def idle_overrides(resolved: ResolvedStudy, sweep: bool = True) -> dict[str, str]:
    """Return the overrides that have no effect, each with the reason.

    If there are several settings, one of a setting's own overrides is returned as `LABEL: KEY=VALUE`. An override from
    the command line is returned only if no setting reads it.
    """
    reasons: dict[str, str] = {}
    in_each = []
    for label, settings in resolved.settings.items():
        idle = idle_keys(settings)
        if not sweep:
            idle |= {f"runtime.{name}": "a rollout runs in one process" for name in NOT_DETERMINING_RUNTIME}
        name = f"{label}: " if len(resolved.settings) > 1 else ""
        for word, why in _without_effect(resolved.points[label].overrides, idle).items():
            reasons[f"{name}{word}"] = why
        in_each.append(_without_effect(resolved.common, idle))
    everywhere = set(in_each[0]).intersection(*in_each)
    return reasons | {word: why for word, why in in_each[0].items() if word in everywhere}


def _without_effect(overrides: Iterable[str], idle: Mapping[str, str]) -> dict[str, str]:
    reasons: dict[str, str] = {}
    for override in overrides:
        key = _key(override).lstrip("+")
        for name, reason in idle.items():
            if f"{key}.".startswith(f"{name}."):
                reasons.setdefault(override, reason)
    return reasons


def idle_keys(settings: RolloutSettings) -> dict[str, str]:
    """Return the keys of settings that have no effect in this combination, each with the reason."""
    if settings.policy.kind != MODEL:
        pixels = _pixels_of(settings)
        drawn = dict.fromkeys(("size", "supersample"), f"{settings.policy.interface} wants pictures of {pixels} pixels")
        unused = {f"world.camera.{name}": reason for name, reason in drawn.items() if pixels}
        return unused | ({"method": "the server decides it"} if settings.policy.kind == REMOTE else {})
    method, timing = Method.of(settings), settings.rollout
    draft, proposer, skip = (method.parts[kind] for kind in ("prefill_draft", "proposer", "skip"))
    needed = set(method.needs)
    acceptance = AcceptancePart.find(settings.acceptance.kind)
    idle: dict[str, str] = {}
    if proposer.absent and draft.absent:
        idle |= dict.fromkeys(("acceptance", "threshold", "rectifier"), f"method {settings.method} drafts nothing")
    elif not skip.verifies and (draft.drafts_whole_chunk or proposer.absent):
        idle["rectifier"] = f"skip={skip.name} verifies nothing, so nothing is rejected"
    elif not acceptance.reads_threshold:
        idle["threshold"] = f"acceptance={acceptance.name} has no threshold"
    for kind, part in method.parts.items():
        idle |= flat({kind: part.idle(method.settings[kind])})
    for kind in ArtifactPart.every().keys() - needed:
        idle[f"policy.artifacts.{kind}"] = f"method {settings.method} reads no {kind}"
    if timing.clock == WAITS:
        names = "latency", "latency_ms", "profile", "delay_compensation"
        idle |= dict.fromkeys(map("rollout.{}".format, names), "rollout.clock=waits: the world waits for every decode")
    elif timing.latency != CONSTANT:
        idle["rollout.latency_ms"] = f"rollout.latency={timing.latency}"
    if timing.clock == REAL and timing.latency != PROFILE:
        idle["rollout.profile"] = f"rollout.latency={timing.latency} reads no profile"
    if not settings.record:
        idle["record_size"] = "record=0 saves no recording"
    return idle


def tasks_of(settings: RolloutSettings) -> tuple[str, ...]:
    """Return the full names of a rollout's tasks. Default: the tasks its target was trained on, else DEFAULT_TASKS."""
    return resolve_tasks(settings.task or list(trained_tasks(settings)) or DEFAULT_TASKS)


def trained_tasks(settings: RolloutSettings) -> tuple[str, ...]:
    """Return the full names of the tasks that a rollout's target was trained on.

    Empty for the expert, for a target that does not name its tasks, and for a missing target (refused elsewhere).
    """
    if settings.policy.kind != MODEL:
        return ()
    try:
        folder = find_target(settings.results, settings.policy.target)
    except UsageError:
        return ()
    from kerv_cli.targets.checkpoint import TargetDescription, described  # imports numpy

    names = described(folder, "target", TargetDescription).tasks
    return resolve_tasks(names) if names else ()


def study_name(study: str) -> str:
    path = Path(study).expanduser()
    if path.suffix not in (".yaml", ".yml"):
        return study
    return str(read_yaml_lines(path, f"study={path}")[0].get("name", path.stem)) if path.is_file() else path.stem


def located(words: Sequence[str]) -> list[str]:
    """Return a command's words with absolute paths of study and method files, to run it from any folder."""
    found = []
    for word in words:
        key, _, name = word.partition("=")
        path = Path(name).expanduser().absolute()
        is_file = key in PRESETS and path.suffix in (".yaml", ".yml") and re.fullmatch(r"[\w./ @-]+", str(path))
        found.append(f"{key}={path}" if is_file else word)
    return found


def _outranked(overrides: Sequence[str], by: Sequence[str]) -> list[str]:
    _, others = _parted(overrides, set(map(_key, by)))
    return [*others, *by]


def _parted(overrides: Sequence[str], keys: Collection[str]) -> tuple[list[str], list[str]]:
    named = [one for one in overrides if _key(one) in keys]
    return named, [one for one in overrides if _key(one) not in keys]


def _key(override: str) -> str:
    return override.lstrip("+").partition("=")[0]
