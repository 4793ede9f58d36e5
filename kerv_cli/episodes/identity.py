"""Find what determines an episode's result: settings that have an effect, weights and data, task, seed and `ENGINE`.

Two episodes with the same identity have the same tokens, so studies share them. Code, versions, machine and number of
workers are not part of the identity. They are stored beside the result.
"""

from __future__ import annotations

import ast
import functools
import gc
import hashlib
import importlib.util
import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import kerv_cli
from kerv_cli.base import registry
from kerv_cli.base.errors import KervError
from kerv_cli.base.registry import METHOD_KINDS, PART_GROUPS, AcceptancePart, ArtifactPart
from kerv_cli.base.settings import read_settings
from kerv_cli.episodes.settings import CONSTANT, PROFILE, WAITS, RolloutSettings, TimingSettings
from kerv_cli.methods.compose import Method
from kerv_cli.methods.settings import EXPERT

ENGINE = 2
"""Version of the decoding. Increase it with every change of the code that alters tokens or actions.
tests/test_golden.py checks this.

2: a streak compares the first source's draft on its own path, and the filter of KERV's code waits for four actions."""

Plain = Mapping[str, Any]
"""A rollout's settings as nested dictionaries, lists and plain values, as they are stored."""

Identity = Mapping[str, str]
"""Hashes of the weights and data that a setting uses, e.g. {"target": sha256, "drafter": sha256}."""

OBSERVATION = "observation"
"""Key of the identity's only entry that is not a hash: what the target observes."""

# Fields of RolloutSettings that are left out of a setting's hash: they do not change a result (folders, recording,
# names), or are stored separately (task and seed; the policy by its hashes). All other fields are hashed.
NOT_DETERMINING = frozenset(
    {"task", "episodes", "seed", "policy", "method", "results", "store", "record", "record_size"}
)
NOT_DETERMINING_RUNTIME = frozenset({"workers", "executor", "executor_options", "detach"})


@dataclass(frozen=True, eq=False)
class Setting:
    """One of the settings that a study compares: a method with all its options. It becomes a row of the study's table.

    Attributes:
        label: The setting's name in the study.
        overrides: The overrides from which the setting is composed, as the user wrote them.
        settings: The rollout's settings as nested plain values, without the task.
        identity: Hashes of the weights and data that the setting reads.
        varies: This setting's values for the keys that differ within its grid, by key. An entry of the study expands
            into a grid of settings if an override has several values.
        name: Name of the grid. If empty, it becomes the label.
    """

    label: str
    overrides: str
    settings: Plain
    identity: Identity
    varies: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or self.label)

    @functools.cached_property
    def work(self) -> str:
        """Hash of the settings, weights and data that determine a result. Task and seed are not included."""
        return work_of(self.settings, self.identity)

    @property
    def depends_on_order(self) -> bool:
        """Whether an episode's result depends on earlier episodes of its block (episodes that one process runs).

        This is so if a skip rule adapts its similarity threshold after each episode (docs/methods.md §4.3).
        """
        skip = self.settings["skip"]
        return bool(skip.get("up") or skip.get("down"))

    @property
    def batch(self) -> int:
        """Number of episodes that run at the same time. If it is more than 1, the episodes are not timed."""
        return int(self.settings["rollout"]["batch"])

    def on(self, *tasks: str) -> RolloutSettings:
        """Return the settings of a rollout that runs this setting on the given tasks."""
        return read_settings(RolloutSettings, {**self.settings, "task": list(tasks)})


def differences(new: Setting, old: Setting | None = None, work: str = "") -> str:
    """Describe in a few words how a setting differs from the stored setting with the same label.

    Args:
        new: The setting.
        old: The stored setting. None if no setting with this label is stored.
        work: The hash under which `old` was stored.
    """
    target = new.settings["policy"]["target"]
    if old is None or old.settings["policy"]["target"] != target:
        return "new setting"
    engine = next((one for one in range(ENGINE, 0, -1) if work_of(old.settings, old.identity, one) == work), ENGINE)
    changes = [f"engine {engine} → {ENGINE}"] if engine != ENGINE else []
    for kind in _differing(new.identity, old.identity):
        if kind == "target":
            changes.append(f"weights of {target} changed")
        elif kind != OBSERVATION:
            changes.append(f"{kind} changed")
    before, after = flat(effective(old.settings)), flat(effective(new.settings))
    changes += [f"{key} {before.get(key)} → {after.get(key)}" for key in _differing(after, before)]
    return ", ".join(changes[:3]) or "new setting"


def _differing(new: Mapping[str, Any], old: Mapping[str, Any]) -> list[str]:
    """Return the keys that have different values in two mappings. A missing key has the value None."""
    return [key for key in dict.fromkeys([*new, *old]) if new.get(key) != old.get(key)]


def hash_of(value: object) -> str:
    """Return a short hash of a JSON value: the first 16 hexadecimal digits of the SHA-256 of its canonical JSON text.

    Raises:
        ValueError: The value contains NaN or infinity.
        TypeError: The value contains an object that JSON cannot hold.
    """
    return hashlib.sha256(_canonical(value).encode("ascii")).hexdigest()[:16]


def _canonical(value: object) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)


# Settings that version 1.0.0 did not have. With these values, kerv decodes like version 1.0.0. So these values are not
# hashed, and episodes that were stored before keep their identity.
LATER: Mapping[str, Any] = {"threshold.over": "compared", "threshold.total": False, "rectifier.hold_strict": True}


def work_of(settings: Plain, identity: Identity, engine: int = ENGINE) -> str:
    """Return the hash of the settings, weights and data that determine results. Task and seed are left out.

    Args:
        settings: The rollout's settings as nested plain values.
        identity: Hashes of the setting's weights and data, as `policy.check` returns them.
        engine: Version of the decoding, see `ENGINE`.
    """
    determining = without(settings, NOT_DETERMINING - {"policy", "method"})
    policy = settings["policy"]["kind"]
    return _work(_canonical(determining), _canonical(dict(identity)), policy, engine)


@functools.lru_cache(maxsize=4096)
def _work(settings: str, identity: str, policy: str, engine: int) -> str:
    determining = {"kind": policy}
    for name, value in without(json.loads(identity), {OBSERVATION}).items():
        determining[f"{name}_sha256"] = value
    return hash_of({"settings": effective(json.loads(settings)), "policy": determining, "engine": engine})


def effective(settings: Plain) -> dict[str, Any]:
    """Return the settings that determine a rollout's results, as nested plain values.

    A setting is left out if it never changes a result (such as the number of workers), or if it has no effect beside
    the other settings (such as the threshold of a method that drafts nothing). Task, seed, policy and the method's name
    are left out, too.
    """
    try:
        complete = read_settings(RolloutSettings, settings)
    except KervError:  # the settings name a part of a plugin that is not installed here
        return without(settings, NOT_DETERMINING)
    determining = without(asdict(complete), NOT_DETERMINING)
    for key in idle_keys(complete) if complete.policy.kind != EXPERT else ():
        _drop(determining, key.split("."))
    for key, usual in LATER.items():
        part, name = key.split(".")
        if determining.get(part, {}).get(name) == usual:
            del determining[part][name]
    determining["runtime"] = without(determining["runtime"], NOT_DETERMINING_RUNTIME)
    if not stress_of(determining)["level"]:
        determining["world"] = without(determining["world"], {"stress"})  # level 0 of every kind is the same world
    return determining


def _drop(settings: dict[str, Any], path: Sequence[str]) -> None:
    for key in path[:-1]:
        settings = settings.get(key, {})
    settings.pop(path[-1], None)


def stress_of(settings: Plain) -> dict[str, Any]:
    """Return the kind and level of a setting's stress, a disturbance of the world (docs/stress.md).

    At level 0 the kind is `none`.
    """
    stress = settings["world"]["stress"]
    level = int(stress["level"])
    return {"kind": stress["kind"] if level else "none", "level": level}


def stress_text(settings: Plain) -> str:
    """Return text to put after a setting's label: `, stress push 2`. Empty without stress."""
    stress = stress_of(settings)
    return f", stress {stress['kind']} {stress['level']}" if stress["level"] else ""


def flat(settings: Plain, prefix: str = "") -> dict[str, Any]:
    """Return nested settings with dotted keys: {"threshold": {"r": 5}} becomes {"threshold.r": 5}."""
    pairs: dict[str, Any] = {}
    for key, value in settings.items():
        pairs |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return pairs


def without(settings: Plain, names: Collection[str]) -> dict[str, Any]:
    """Return the settings without the keys in `names`. Only the top level is searched."""
    return {key: value for key, value in settings.items() if key not in names}


def without_effect(settings: RolloutSettings, overrides: Iterable[str], sweep: bool = False) -> dict[str, str]:
    """Return those overrides that have no effect on the rollout, each with the reason.

    For the scripted expert the result is always empty, because unused settings are refused elsewhere with an error.

    Args:
        settings: The rollout's settings.
        overrides: `key=value`, as typed.
        sweep: Whether the rollout is part of a sweep. If not, settings of worker processes also have no effect.
    """
    if settings.policy.kind == EXPERT:
        return {}
    idle = idle_keys(settings)
    if not sweep:
        for name in NOT_DETERMINING_RUNTIME:
            idle[f"runtime.{name}"] = "a rollout runs in one process"
    reasons: dict[str, str] = {}
    for override in overrides:
        key = override.partition("=")[0].lstrip("+")
        for name, reason in idle.items():
            if f"{key}.".startswith(f"{name}."):
                reasons.setdefault(override, reason)
    return reasons


def _idle_timing(timing: TimingSettings) -> dict[str, str]:
    if timing.clock == WAITS:
        names = "latency", "latency_ms", "profile", "ar_ms", "delay_compensation"
        return dict.fromkeys(map("rollout.{}".format, names), "rollout.clock=waits: the world waits for every decode")
    idle = {}
    if timing.latency != CONSTANT:
        idle["rollout.latency_ms"] = f"rollout.latency={timing.latency}"
    if timing.latency != PROFILE:
        idle["rollout.profile"] = f"rollout.latency={timing.latency} reads no profile"
    if timing.latency == CONSTANT:
        idle["rollout.ar_ms"] = "rollout.latency=constant scales nothing"
    return idle


def idle_keys(settings: RolloutSettings) -> dict[str, str]:
    """Return the keys of settings that have no effect in this combination, each with the reason."""
    method = Method.of(settings)
    draft, proposer, skip = method.prefill_draft, method.proposer, method.skip
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
    needed, artifacts = set(method.needs), ArtifactPart.every()
    for kind in artifacts.keys() - needed:
        idle[f"policy.artifacts.{kind}"] = f"method {settings.method} reads no {kind}"
    for group in PART_GROUPS[len(METHOD_KINDS) :]:
        if group not in needed:
            idle[group] = f"method {settings.method} reads no {group}"
    idle |= _idle_timing(settings.rollout)
    batch = settings.rollout.batch
    if batch > 1:
        idle |= dict.fromkeys(("record", "record_size"), f"rollout.batch={batch}: episodes of a batch are not recorded")
    if not settings.record:
        idle["record_size"] = "record=0 saves no recording"
    return idle


_COMPUTING = ("base", "engine", "methods", "targets", "worlds", "episodes")
"""Packages of kerv_cli whose code runs during an episode."""


@functools.cache
def code_hash() -> str:
    """Return a hash of the code that computes episodes, as hexadecimal SHA-256.

    Episodes are stored with this hash, so that episodes computed by other code can be found. The hash covers the syntax
    trees of kerv's own files and of registered plugins. Comments, docstrings and formatting do not change it.
    """
    digest = hashlib.sha256()
    gc.disable()  # syntax trees hold no cycles, and a search among all objects of the libraries takes as long as they
    try:
        for name, path in sorted(_computing_files()):
            content = _meaning(path.read_bytes()) if path.suffix == ".py" else path.read_bytes()
            digest.update(f"{name}\0".encode() + hashlib.sha256(content).digest())
    finally:
        gc.enable()
    return digest.hexdigest()


def _meaning(source: bytes) -> bytes:
    """Return the syntax tree of Python source without its docstrings, as the bytes of a text.

    The text is the same in every version of Python. The text from `ast.dump` is not.
    """
    return json.dumps(_plain(ast.parse(source))).encode()


def _plain(node: object) -> object:
    """Return a syntax tree without docstrings as lists and strings.

    Parts that only some versions of Python have are left out: empty fields, and empty strings in f-strings.
    """
    if isinstance(node, list):
        return [_plain(one) for one in node if not _is_docstring(one)]
    if not isinstance(node, ast.AST):
        return ascii(node)
    plain: list[object] = [type(node).__name__]
    for name, value in ast.iter_fields(node):
        if isinstance(node, ast.JoinedStr):
            value = list(filter(_is_not_empty, value))
        if value is not None and (found := _plain(value)) != []:
            plain.append((name, found))
    return plain


def _is_docstring(node: object) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _is_not_empty(node: ast.expr) -> bool:
    return not (isinstance(node, ast.Constant) and node.value == "")


def _computing_files() -> Iterator[tuple[str, Path]]:
    """Yield the name and path of kerv's own files that run during an episode, and of registered plugins."""
    root = Path(kerv_cli.__file__).parent
    for room in _COMPUTING:
        for path in (root / room).rglob("*.py"):
            yield path.relative_to(root).as_posix(), path
    modules: set[str] = set()
    for kind in set(registry.kinds()) - {"command"}:
        for part in registry.parts(kind).values():
            if not part.absent and not part.module.startswith("kerv_cli."):
                modules |= {part.module, part.code().__module__} if isinstance(part, ArtifactPart) else {part.module}
    for name in modules:
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.origin is not None:
            yield name, Path(spec.origin)
