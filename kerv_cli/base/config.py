"""Compose the settings of a command from `conf/`, files and overrides. The only module that uses Hydra.

Overrides are checked before torch or MuJoCo load. A mistake is one line; in a file it names the file and the line.
"""

from __future__ import annotations

import copy
import functools
import itertools
import math
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, cast

from kerv_cli.base.errors import UnknownName, UsageError, did_you_mean
from kerv_cli.base.files import read_yaml_lines
from kerv_cli.base.limits import check_settings
from kerv_cli.base.registry import PREFILL, SETTINGS_GROUPS, Part, part_of, parts
from kerv_cli.base.settings import choices_of

T = TypeVar("T")

PRESETS = ("method", "study")
"""Groups whose files hold overrides of a command. A path to such a file can take the place of its name."""
MOST_POINTS = 10_000
"""Maximum number of points of a grid."""


def conf_dir() -> Path:
    """Return `$KERV_CONF_DIR`, else the checkout's `conf/`, else the one inside the installed package.

    Raises:
        UsageError: No configuration there.
    """
    folder = os.environ.get("KERV_CONF_DIR")
    package = Path(__file__).resolve().parents[1]
    folders = [Path(folder).resolve()] if folder else [package.parent / "conf", package / "conf"]
    for path in folders:
        if (path / "method").is_dir():
            return path
    raise UsageError(f"no configuration in {' or '.join(map(str, folders))}: set KERV_CONF_DIR to a folder like conf/")


def groups() -> dict[str, list[str]]:
    """Return the groups of settings and the names in them: {"method": ["ar", "spec_vla", …], …}."""
    names = {d.name: {p.stem for p in d.glob("*.yaml")} for d in conf_dir().iterdir() if d.is_dir()}
    for group in SETTINGS_GROUPS:
        names.setdefault(group, set()).update(_parts_of(group))
    return {group: sorted(names[group]) for group in sorted(names)}


def _parts_of(group: str) -> dict[str, Part]:
    """Return the parts that a group can choose. A prefill draft is a proposer that needs no states of the target."""
    if group != "prefill_draft":
        return dict(parts(group))
    return {name: part for name, part in parts("proposer").items() if part.traits.get("when") == PREFILL}


def compose(command: str, overrides: Sequence[str], schema: type[T]) -> T:
    """Return the settings of a command.

    Args:
        command: Its name, with `_` for a space.
        overrides: As typed: `method=kerv`, `threshold.r=5`, `task=[reach,push]`. Each key at most once.
        schema: Dataclass of the settings.

    Raises:
        UsageError: An override that cannot be parsed, an unknown key or name, a wrong type, a value out of range.
    """
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

    typed = _typed(overrides, schema)
    defaults = choices_of(schema)
    chosen = {key: str(value) for key, value in typed.items() if key in defaults}
    preset = next((group for group in PRESETS if group in defaults), "")
    choices, values, places = _read_preset(preset, chosen.pop(preset, defaults.pop(preset, "")))
    choices = defaults | choices | chosen
    values += [(key, value) for key, value in typed.items() if key not in choices_of(schema)]
    places = {key: place for key, place in places.items() if key not in typed}
    key = ""
    try:
        nodes = copy.deepcopy(_composed(tuple(choices.items()), schema, conf_dir()))  # type: ignore[arg-type]
        for key, value in values:
            if value == "" and key in typed and OmegaConf.select(nodes, key):
                raise UsageError(f"{key}= is empty: write a value, or leave it out")
            OmegaConf.update(nodes, key, value, merge=True)
        key, settings = "", cast(T, OmegaConf.to_object(nodes))
        _check(settings)
    except UsageError as error:
        if error.key not in places:
            raise
        raise UsageError(f"{places[error.key]}{error}", error.key) from error
    except (ConfigAttributeError, ConfigKeyError) as error:
        key = key if key in typed else str(error.full_key)
        hint = did_you_mean(key, _keys(nodes)) or f"see 'kerv {command.replace('_', ' ')} --cfg' for the keys"
        raise UsageError(f"{places.get(key, '')}unknown key '{key}': {hint}", key) from error
    except (HydraException, OmegaConfBaseException, ValueError, TypeError, RecursionError) as error:
        key = getattr(error, "full_key", None) or key
        message = str(error).partition("\n")[0]
        raise UsageError(f"{places.get(key, '')}{f'{key}: ' if key else ''}{message}", key) from error
    return settings


def _typed(overrides: Sequence[str], schema: type) -> dict[str, Any]:
    """Parse overrides: key -> value. `task=a,b` needs no brackets."""
    lists_tasks = any(field.name == "task" and str(field.type) == "list[str]" for field in fields(schema))
    typed: dict[str, Any] = {}
    for override in overrides:
        value = override.partition("=")[2]
        brackets = lists_tasks and override.startswith("task=") and not value.startswith("[")
        parsed = _parsed(f"task=[{value}]" if brackets else override)
        key = parsed.key_or_group
        if key in typed:
            raise UsageError(f"{key} is given twice: leave one out", key)
        if parsed.is_sweep_override():
            raise UsageError(f"{override}: several values need 'kerv rollout -m'; as a list write {key}=[{value}]", key)
        typed[key] = parsed.value()
    if typed.get("task") == [] and lists_tasks:
        raise UsageError("task= is empty: name a task or a suite, or leave it out")
    return typed


def preset_file(group: str, name: str) -> Path:
    """Return the file of a preset: `name` is its path, or a name in `conf/`.

    Raises:
        UnknownName: No such name.
    """
    if name.endswith((".yaml", ".yml")):
        return Path(name).expanduser()
    path = conf_dir() / group / f"{name}.yaml"
    if not path.is_file():
        raise UnknownName(group, name, groups()[group])
    return path


def _read_preset(group: str, name: str) -> tuple[dict[str, str], list[tuple[str, Any]], dict[str, str]]:
    """Return what a method or study file sets: choices of parts, values, and the file and line of each key."""
    if not group:
        return {}, [], {}
    path = preset_file(group, name)
    content, lines = read_yaml_lines(path, f"{group}={path}")
    prefix = "" if group == "method" else f"{group}."
    choices, places = {}, {f"{prefix}{key}": f"{path}:{line}: " for key, line in lines.items()}
    for index, choice in enumerate(content.pop("defaults", [])):
        (key, part), *_ = choice.items() if isinstance(choice, dict) else [(str(choice), None)]
        kind, place = key.removeprefix("override /"), f"{path}:{lines.get(f'defaults.{index}.{key}', 1)}: "
        if kind not in SETTINGS_GROUPS or not isinstance(part, str):
            raise UsageError(f"{place}write 'override /PART: NAME', PART is one of {', '.join(SETTINGS_GROUPS)}")
        choices[kind], places[kind] = part, place
    named = {group: path.stem} if group == "method" else {}
    return choices, [(f"{prefix}{key}", value) for key, value in (content | named).items()], places


def _check(settings: Any) -> None:
    """Check every setting against its range, and that every chosen part exists."""
    check_settings(settings)
    for group in (name for name in SETTINGS_GROUPS if hasattr(settings, name)):
        part_of(group, getattr(settings, group).kind)


@functools.lru_cache(maxsize=4096)
def _parsed(override: str) -> Any:
    """Return Hydra's parse of an override."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    key, equals, value = override.lstrip("+").partition("=")  # open mappings take new keys without a plus
    if not equals or not key or key[0] == "~":  # nothing is taken away from settings
        raise UsageError(f"'{override}' is not an override: write key=value, a list without spaces: task=[reach,push]")
    try:
        return OverridesParser.create().parse_overrides([override.lstrip("+")])[0]
    except (HydraException, ValueError, TypeError, AttributeError, RecursionError) as error:
        hint = f"""write a list without spaces, task=[reach,push], or quote the value: "{key}='{value}'\""""
        raise UsageError(f"cannot read '{override[:200]}': {hint}", key) from error


@functools.lru_cache(maxsize=256)
def _composed(choices: tuple[tuple[str, str], ...], schema: type, conf: Path) -> Any:
    """Return Hydra's composition of these choices, as typed nodes. It takes 0.1 s, so a study shares it."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.config_store import ConfigStore
    from omegaconf import MISSING, OmegaConf

    known = groups()
    for group, name in choices:
        if name not in known[group]:
            raise UnknownName(group, name, known[group])
    store = ConfigStore.instance()
    base = OmegaConf.structured(schema)
    _open_mappings(base)
    for group in set(SETTINGS_GROUPS) & set(base):
        base[group] = MISSING  # the defaults list chooses the part, and with it the class of its settings
    store.store(name="base", node=base)
    store.store(name="own", node={"defaults": ["base", *({group: name} for group, name in choices), "_self_"]})
    for group in SETTINGS_GROUPS:
        for name, part in _parts_of(group).items():
            own_file = (conf / group / f"{name}.yaml").is_file()  # it begins with the part's settings
            _store_part(f"base_{group}" if own_file else group, name, part.settings)
    with initialize_config_dir(str(conf), version_base="1.3"):
        return hydra_compose("own")


@functools.cache
def _store_part(group: str, name: str, settings: type) -> None:
    """Make a part's settings known to Hydra, once per process: all of them take a third of a composition."""
    from hydra.core.config_store import ConfigStore

    ConfigStore.instance().store(group=group, name=name, node=settings(kind=name))


def _open_mappings(node: Any) -> None:
    """Let overrides add keys to the untyped mappings of a schema, such as `runtime.executor_options`."""
    from omegaconf import DictConfig, OmegaConf

    for child in (node[name] for name in node if not OmegaConf.is_missing(node, name)):
        if isinstance(child, DictConfig) and OmegaConf.get_type(child) is dict:
            OmegaConf.set_struct(child, False)
        elif isinstance(child, DictConfig):
            _open_mappings(child)


def _keys(node: Any, prefix: str = "") -> Iterator[str]:
    """Yield every dotted key of composed settings."""
    from omegaconf import DictConfig

    for name, child in node.items():
        yield f"{prefix}{name}"
        if isinstance(child, DictConfig):
            yield from _keys(child, f"{prefix}{name}.")


def as_overrides(*overrides: str, **settings: object) -> list[str]:
    """Return overrides and keywords as they are typed: `episodes=3`, `task=[reach,push]`, `threshold.r=5`."""

    def typed(key: str, value: object) -> list[str]:
        if isinstance(value, Mapping):
            return [text for name, inner in value.items() for text in typed(f"{key}.{name}", inner)]
        return [f"{key}={_text(value)}"]

    return [*overrides, *(text for key, value in settings.items() for text in typed(key, value))]


def _text(value: object) -> str:
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_text, value))}]"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def split(text: str) -> list[str]:
    """Return the overrides in a line of text, which is split at white space outside quotes.

    Raises:
        UsageError: A quote or a backslash without its end.
    """
    try:
        return shlex.split(text)
    except ValueError as error:
        raise UsageError(f"cannot read '{text}': {error}") from error


def expand(overrides: Sequence[str]) -> list[list[str]]:
    """Return the points of a grid in Hydra's grammar, `threshold.r=0,3` or `threshold.r=range(0,4)`: overrides of each.

    Raises:
        UsageError: An override that cannot be parsed, no point, or more than MOST_POINTS.
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
    """Return the keys of overrides that hold several values."""
    return [one.key_or_group for one in map(_parsed, overrides) if one.is_sweep_override()]
