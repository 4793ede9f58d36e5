"""Compose the settings of a command from `conf/`, method or study files, and overrides. Only this module uses Hydra.

A file of conf/ is a mapping from keys to values. Overrides are `key=value` arguments in Hydra's grammar. They are
checked before torch or MuJoCo load. An error message is one line. If the mistake is in a file, the message names the
file and the line.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
import pickle
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, cast

from kerv_cli.base.errors import UnknownName, UsageError, did_you_mean
from kerv_cli.base.files import read_yaml_lines
from kerv_cli.base.limits import check_settings
from kerv_cli.base.registry import PLUGINS, PREFILL, SETTINGS_GROUPS, Part, ProposerPart, part_of, parts
from kerv_cli.base.settings import choices_of

T = TypeVar("T")

# Groups (folders) of conf/ whose files set several settings at once. A file is chosen by its name or its path.
PRESETS = ("method", "study")
# Groups whose files can set every key of a command, such as `train.lr`. Other files set only keys of their group.
WHOLE = ("drafter",)
MOST_POINTS = 10_000  # maximum number of combinations in a grid of settings


def conf_dir() -> Path:
    package = Path(__file__).resolve().parents[1]
    checkout = package.parent / "conf"
    return checkout if (checkout / "method").is_dir() else package / "conf"


def groups() -> dict[str, list[str]]:
    """Return the names that can be chosen in each group of settings: {"method": ["ar", "spec_vla", …], …}."""
    names: dict[str, set[str]] = {}
    for path in conf_dir().glob("*/*.yaml"):
        names.setdefault(path.parent.name, set()).add(path.stem)
    for group in SETTINGS_GROUPS:
        names.setdefault(group, set()).update(_parts_of(group))
    return {group: sorted(names[group]) for group in sorted(names)}


def _parts_of(group: str) -> dict[str, Part]:
    # for prefill_draft: the proposers that can draft before the target's prefill
    if group != "prefill_draft":
        return dict(parts(group))
    return {name: part for name, part in ProposerPart.every().items() if part.when == PREFILL}


def compose(command: str, overrides: Sequence[str], schema: type[T]) -> T:
    """Return the checked settings of a command. `command` is its name with `_` for spaces, such as `train_target`.

    `quick=true` adds the settings that `conf/quick.yaml` has for this command. Settings that the user typed take
    precedence.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

    typed = _typed(overrides, schema)
    if typed.get("quick"):
        typed = read_yaml_lines(conf_dir() / "quick.yaml", "quick=true")[0].get(command, {}) | typed
    choices, known = choices_of(schema), choices_of(schema)
    preset = next(filter(choices.__contains__, PRESETS), "")
    parts_of_file, values, lines = _read_preset(preset, str(typed.get(preset, choices.pop(preset, ""))))
    choices |= parts_of_file
    for key, value in typed.items():
        lines.pop(key, None)
        if key in known:
            choices[key] = str(value)
        else:
            values.append((key, value))
    choices.pop(preset, None)
    key = ""
    try:
        nodes = pickle.loads(_composed((*choices.items(),), schema, conf_dir(), (*parts("artifact"),)))  # type: ignore[arg-type]
        for key, value in values:
            if value == "" and key in typed and OmegaConf.select(nodes, key):
                raise UsageError(f"{key}= is empty: write a value, or leave it out")
            OmegaConf.update(nodes, key, value, merge=True)
        key, settings = "", cast(T, OmegaConf.to_object(nodes))
        _check(settings)
    except (UsageError, OmegaConfBaseException, ValueError, TypeError, RecursionError) as error:
        if isinstance(error, UsageError) and error.key not in lines:
            raise
        message = str(error).partition("\n")[0]
        if isinstance(error, UsageError):
            key = error.key
        elif isinstance(error, ConfigAttributeError | ConfigKeyError):
            key = key if key in typed else str(error.full_key)
            every = f"see 'kerv {command.replace('_', ' ')} --cfg' for the keys"
            message = f"unknown key '{key}': {_owner(key) or did_you_mean(key, _keys(nodes)) or every}"
        else:
            key = getattr(error, "full_key", None) or key
            message = f"{key}: {message}" if key else message
        raise UsageError(f"{lines.get(key, '')}{message}", key) from error
    return settings


def _owner(key: str) -> str:
    group, _, name = key.partition(".")
    choices = _parts_of(group).items() if group in SETTINGS_GROUPS else ()
    owners = [choice for choice, part in choices if name in {at.name for at in fields(part.settings)}]
    return f"it belongs to {' or '.join(f'{group}={one}' for one in owners)}" if owners else ""


def _typed(overrides: Sequence[str], schema: type) -> dict[str, Any]:
    lists = {at.name for at in fields(schema) if str(at.type).startswith("list[")}
    typed: dict[str, Any] = {}
    for override in overrides:
        key, _, value = override.partition("=")
        parsed = _parsed(f"{key}=[{value}]" if key in lists and not value.startswith(("[", "$")) else override)
        key = parsed.key_or_group
        if key in typed:
            raise UsageError(f"{key} is given twice: leave one out", key)
        if parsed.is_sweep_override():
            as_list = f"; a list is written {key}=[{value}]" if "." in key else ""
            raise UsageError(f"{override}: several values need -m, as in 'kerv rollout -m {override}'{as_list}", key)
        typed[key] = parsed.value()
    if "task" in lists and typed.get("task") == []:
        raise UsageError("task= is empty: name a task or a suite, or leave it out")
    return typed


def preset_file(group: str, name: str) -> Path:
    """Return the path of a preset. `name` is a file's name in `conf/<group>`, or a path that ends in .yaml or .yml."""
    if name.endswith((".yaml", ".yml")):
        return Path(name).expanduser()
    path = conf_dir() / group / f"{name}.yaml"
    if not path.is_file():
        raise UnknownName(group, name, groups()[group])
    return path


def _read_preset(group: str, name: str) -> tuple[dict[str, str], list[tuple[str, Any]], dict[str, str]]:
    """Read a method or study file. In a method file, a line such as `proposer: drafter` chooses a part.

    Return the chosen parts by group, all other keys as (key, value) pairs, and for each key the prefix `FILE:LINE: ` of
    error messages.
    """
    if not group:
        return {}, [], {}
    path, prefix = preset_file(group, name), "study." if group == "study" else ""
    content, numbers = read_yaml_lines(path, f"{group}={path}")
    lines = {f"{prefix}{key}": f"{path}:{number}: " for key, number in numbers.items()}
    if "defaults" in content and not prefix:
        raise UsageError(f"{lines['defaults']}a method's file has no defaults: write PART: NAME, as proposer: drafter")
    choices, values = dict[str, str](), list[tuple[str, Any]]()
    for key, value in content.items():
        if not prefix and key in SETTINGS_GROUPS and isinstance(value, str):
            choices[key] = value
        else:
            values.append((f"{prefix}{key}", value))
    return choices, values if prefix else [*values, ("method", path.stem)], lines


def _check(settings: Any) -> None:
    check_settings(settings)
    for group in SETTINGS_GROUPS:
        chosen = getattr(settings, group, None)
        if chosen is not None and type(chosen) is not part_of(group, chosen.kind).settings:
            message = f"{group}.kind={chosen.kind}: choose {group}={chosen.kind}, each has settings of its own"
            raise UsageError(message, f"{group}.kind")


@functools.lru_cache(maxsize=4096)
def _parsed(override: str) -> Any:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    key, equals, value = override.lstrip("+").partition("=")  # Hydra's `+key=` for new keys is accepted, not needed
    if not equals or not key or key[0] == "~":  # Hydra's `~key`, which would delete a setting
        raise UsageError(f"'{override}' is not an override: write key=value, a list without spaces: task=[reach,push]")
    parse = OverridesParser.create().parse_overrides
    try:
        if not re.search(r"""[][{}(),='"\\]""", value) and not value.isascii():  # Hydra reads such text in quotes alone
            return parse([f"{key}='{value}'"])[0]
        return parse([f"{key}={value}"])[0]
    except (HydraException, ValueError, TypeError, AttributeError, RecursionError) as error:
        hint = f"""write a list without spaces, task=[reach,push], or quote the value: "{key}='{value}'\""""
        raise UsageError(f"cannot read '{override[:200]}': {hint}", key) from error


@functools.lru_cache(maxsize=256)
def _composed(choices: tuple[tuple[str, str], ...], schema: type, conf: Path, artifacts: tuple[str, ...]) -> bytes:
    """Return the settings with these choices, pickled. Unpickling them is five times as fast as a deep copy."""
    from omegaconf import OmegaConf

    known, nodes = groups(), OmegaConf.structured(schema)
    _open_mappings(nodes)
    for group, name in choices:
        if name not in known[group]:
            may_be_plugin = group in SETTINGS_GROUPS and not os.environ.get(PLUGINS)
            remedy = f" (a plugin's name needs {PLUGINS}=MODULE)" if may_be_plugin else ""
            raise UnknownName(group, name, known[group], remedy)
        part, values = _choice(group, name)
        if part is not None:
            nodes[group] = OmegaConf.structured(part.default)
        for key, value in values:
            OmegaConf.update(nodes, key, value, merge=True)
    return pickle.dumps(nodes)


def _choice(group: str, name: str) -> tuple[Part | None, list[tuple[str, Any]]]:
    """Return the part that `name` chooses in `group` (or None), and the (key, value) pairs that the name's file sets.

    A file `conf/<group>/<name>.yaml` may extend another choice of its group. The file's key `base` names that choice.
    """
    parts_of_group = _parts_of(group) if group in SETTINGS_GROUPS else {}
    path = conf_dir() / group / f"{name}.yaml"
    if not path.is_file():
        return parts_of_group[name], []
    content, _ = read_yaml_lines(path, f"{group}={name}")
    base = content.pop("base", None)
    part, values = (parts_of_group.get(name), []) if base is None else _choice(group, base)
    prefix = "" if group in WHOLE else f"{group}."
    for key, value in content.items():
        values.append((f"{prefix}{key}", value))
    return part, values


def _open_mappings(node: Any) -> None:
    from omegaconf import DictConfig, OmegaConf

    for name in node:
        child = None if OmegaConf.is_missing(node, name) else node[name]
        if isinstance(child, DictConfig) and OmegaConf.get_type(child) is dict:
            OmegaConf.set_struct(child, False)
        elif isinstance(child, DictConfig):
            _open_mappings(child)


def _keys(node: Any, prefix: str = "") -> Iterator[str]:
    from omegaconf import DictConfig

    for name, child in node.items():
        yield f"{prefix}{name}"
        if isinstance(child, DictConfig):
            yield from _keys(child, f"{prefix}{name}.")


def as_overrides(*overrides: str, **settings: object) -> list[str]:
    """Append keyword arguments to overrides: `threshold={"r": 5}` gives `threshold.r=5`."""
    typed = list(overrides)
    for key, value in settings.items():
        if isinstance(value, Mapping):
            typed += as_overrides(**{f"{key}.{name}": inner for name, inner in value.items()})
        else:
            typed.append(f"{key}={plain_text(value)}")
    return typed


def plain_text(value: object) -> str:
    if isinstance(value, list | tuple):
        return f"[{','.join(map(plain_text, value))}]"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def split(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise UsageError(f"cannot read '{text}': {error}") from error


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """Return one list of overrides per combination of values: `threshold.r=0,3` gives two lists.

    Hydra's other syntax for several values works, too, such as `range(0,4)`.
    """
    from hydra.errors import HydraException

    axes = []
    try:
        for one in map(_parsed, overrides):
            values = one.sweep_string_iterator() if one.is_sweep_override() else [one.input_line.partition("=")[2]]
            axes.append([f"{one.key_or_group}={value}" for value in itertools.islice(values, MOST_POINTS + 1)])
    except (HydraException, ValueError, TypeError) as error:
        raise UsageError(f"cannot read '{' '.join(overrides)[:200]}': {error}") from error
    number = math.prod(map(len, axes))
    if not 0 < number <= MOST_POINTS:
        raise UsageError(
            f"'{' '.join(overrides)}' is a grid of {number:.6g} points: from 1 to {MOST_POINTS} are possible"
        )
    return [list(point) for point in itertools.product(*axes)]


def swept_keys(overrides: Sequence[str]) -> list[str]:
    return [one.key_or_group for one in map(_parsed, overrides) if one.is_sweep_override()]
