"""The only module that uses Hydra: it composes a command's settings, checks overrides, expands a grid.

Overrides are checked before torch or MuJoCo load. A wrong one is answered by one line.
"""

from __future__ import annotations

import copy
import functools
import itertools
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from kerv_cli.base import registry
from kerv_cli.base.errors import UnknownName, UsageError, did_you_mean
from kerv_cli.base.files import read_yaml_file
from kerv_cli.base.files import to_yaml as plain_yaml
from kerv_cli.base.limits import check_settings, description
from kerv_cli.base.registry import PREFILL, SETTINGS_GROUPS, part_of
from kerv_cli.base.settings import DERIVED_FROM, choices_of

T = TypeVar("T")

_STRANGE = (ValueError, TypeError, AttributeError, RecursionError)
"""What Hydra raises at strange words, besides its own."""
_LIST = "task=[reach,push]"
MOST_POINTS = 10_000
"""Points of a grid; more are refused before they are expanded."""


def conf_dir() -> Path:
    """`$KERV_CONF_DIR`, else the checkout's `conf/`, else the one inside the installed package.

    Raises:
        UsageError: no configuration there.
    """
    folder = os.environ.get("KERV_CONF_DIR")
    package = Path(__file__).resolve().parents[1]
    folders = [Path(folder).resolve()] if folder else [package.parent / "conf", package / "conf"]
    for path in folders:
        if (path / "method").is_dir():
            return path
    raise UsageError(f"no configuration in {' or '.join(map(str, folders))}: set KERV_CONF_DIR to a folder like conf/")


def groups() -> dict[str, list[str]]:
    """Config groups and the names in them: {"method": ["ar", "spec_vla", …], …}."""
    root = conf_dir()
    names = {d.name: {p.stem for p in d.glob("*.yaml")} for d in sorted(root.iterdir()) if d.is_dir()}
    for group in SETTINGS_GROUPS:
        names.setdefault(group, set()).update(_parts_of(group))
    return {group: sorted(names[group]) for group in sorted(names)}


def _parts_of(group: str) -> dict[str, registry.Part]:
    """The parts that a group may choose, by name; in-prefill drafts are proposers that need no states of the target."""
    if group != "prefill_draft":
        return dict(registry.parts(group))
    return {name: part for name, part in registry.parts("proposer").items() if part.traits.get("when") == PREFILL}


def compose(command: str, overrides: Sequence[str], schema: type[T]) -> T:
    """The command's settings: the dataclass `schema`, its groups of `conf/` and the overrides.

    Raises:
        UsageError: an override that cannot be parsed, an unknown key or name, a value of another type or out of range.
    """
    return Composer(command, schema).compose(overrides)


class Composer(Generic[T]):
    """Composes many settings of one command: settings of the same choices of groups are composed once."""

    def __init__(self, command: str, schema: type[T]) -> None:
        self.command, self.schema, self.groups = command, schema, groups()
        self._composed: dict[tuple[str, ...], tuple[Any, T]] = {}

    def compose(self, overrides: Sequence[str]) -> T:
        """The settings of these overrides; raises the errors of the function `compose`."""
        from hydra.errors import HydraException
        from omegaconf.errors import OmegaConfBaseException

        overrides, method = method_of_file(overrides)
        overrides = [word.lstrip("+") for word in overrides]  # open mappings take new keys without it
        self._check(overrides)
        many = any(at.name == "task" and str(at.type).startswith("list") for at in fields(self.schema))  # type: ignore[arg-type]
        parsed = [_parsed(_task_list(word) if many else word) for word in overrides]
        try:
            settings = self._settings(parsed)
        except (HydraException, OmegaConfBaseException) as error:
            raise _explained(self.command, error, overrides, self.schema) from error
        except _STRANGE as error:
            raise UsageError(f"cannot read '{' '.join(overrides)[:200]}': {_one_line(error)}") from error
        _check_ranges(settings)
        if method is not None:
            settings.method = method  # type: ignore[attr-defined]
        return settings

    def _settings(self, overrides: Sequence[Any]) -> T:
        """Hydra composes all but plain values, which are set afterwards as it sets them."""
        from omegaconf import OmegaConf

        values = [override for override in overrides if self._is_value(override)]
        rest = tuple(override.input_line for override in overrides if not self._is_value(override))
        if rest not in self._composed:
            nodes = _composed(self.command, rest, self.schema)
            self._composed[rest] = nodes, cast(T, OmegaConf.to_object(nodes))
        nodes, settings = self._composed[rest]
        for override in values:
            if override.value() == "" and OmegaConf.select(nodes, override.key_or_group):
                raise UsageError(f"{override.key_or_group}= is empty: write a value, or leave it out")
        if all(_is_scalar(nodes, override) for override in values):
            settings = copy.deepcopy(settings)
            for override in values:
                _set_scalar(nodes, settings, override)
            return settings
        nodes = copy.deepcopy(nodes)
        for override in values:
            OmegaConf.update(nodes, override.key_or_group, override.value(), merge=True)
        return cast(T, OmegaConf.to_object(nodes))

    def _check(self, overrides: Sequence[str]) -> None:
        """Refuses words that are no overrides, and unknown choices of a group."""
        for word in overrides:
            key, equals, value = word.partition("=")
            if not equals or not key or key[0] == "~":  # nothing is taken away from settings
                raise UsageError(f"'{word}' is not an override: write key=value, a list without spaces: {_LIST}")
            if key in self.groups and value not in self.groups[key]:
                raise UnknownName(key, value, self.groups[key])

    def _is_value(self, override: Any) -> bool:
        """Whether an override sets one key to one value."""
        from hydra.core.override_parser.types import OverrideType

        plain = override.type == OverrideType.CHANGE and override.package is None and not override.is_sweep_override()
        return plain and override.key_or_group not in self.groups


def _is_scalar(nodes: Any, override: Any) -> bool:
    """Whether an override replaces one plain value that no other setting depends on by another."""
    from omegaconf import OmegaConf

    key, value = override.key_or_group, override.value()
    if key in DERIVED_FROM or not isinstance(value, int | float | str) or "${" in str(value):
        return False
    return isinstance(OmegaConf.select(nodes, key), int | float | str)


def _set_scalar(nodes: Any, settings: Any, override: Any) -> None:
    """Sets a value in the dataclass `settings`, converted as its typed node in `nodes` converts it; converting all of
    them takes a hundred times as long, and a study composes hundreds of settings."""
    from omegaconf import OmegaConf

    key = override.key_or_group
    before = OmegaConf.select(nodes, key)
    OmegaConf.update(nodes, key, override.value())
    converted = OmegaConf.select(nodes, key)
    OmegaConf.update(nodes, key, before)
    *path, name = key.split(".")
    for part in path:
        settings = settings[part] if isinstance(settings, dict) else getattr(settings, part)
    if isinstance(settings, dict):
        settings[name] = converted
    else:
        setattr(settings, name, converted)


def _check_ranges(settings: Any) -> None:
    """Checks every setting against its range, and what only a part knows about its settings."""
    check_settings(settings)
    for group in SETTINGS_GROUPS:
        part_settings = getattr(settings, group, None)
        part = None if part_settings is None else part_of(group, part_settings.kind)
        # another part's settings are refused by the method's check
        if part is not None and part.check is not None and isinstance(part_settings, part.settings):
            part.check(part_settings)


def as_words(*words: str, **settings: object) -> list[str]:
    """Words and keywords as they are typed behind a command: `episodes=3`, `task=[reach,push]`, `threshold.r=5`."""
    return [*words, *(word for key, value in settings.items() for word in _typed(key, value))]


def _typed(key: str, value: object) -> Iterator[str]:
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _typed(f"{key}.{name}", inner)
    else:
        yield f"{key}={_text(value)}"


def _text(value: object) -> str:
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_text, value))}]"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


@functools.lru_cache(maxsize=4096)
def _parsed(word: str) -> Any:
    """The override as Hydra parses it. Raises UsageError: it cannot."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return OverridesParser.create().parse_overrides([word])[0]
    except (HydraException, *_STRANGE) as error:
        key, _, value = word.partition("=")
        hint = f"""write a list without spaces, {_LIST}, or quote the value: "{key}='{value}'\""""
        raise UsageError(f"cannot read '{word[:200]}': {hint}") from error


def _composed(command: str, overrides: Sequence[str], schema: type) -> Any:
    """Hydra's composition, as typed nodes."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.config_store import ConfigStore
    from omegaconf import MISSING, OmegaConf

    store = ConfigStore.instance()
    base = OmegaConf.structured(schema)
    _open_mappings(base)
    for group in set(SETTINGS_GROUPS) & set(base):
        base[group] = MISSING  # the defaults list chooses the part, and with it the class of its settings
    store.store(name=f"base_{command}", node=base)
    choices = [{group: name} for group, name in choices_of(schema).items()]
    store.store(name=f"own_{command}", node={"defaults": [f"base_{command}", *choices, "_self_"]})
    for group in SETTINGS_GROUPS:
        for name, part in _parts_of(group).items():
            own_file = (conf_dir() / group / f"{name}.yaml").is_file()  # it begins with the part's settings
            _store_part(f"base_{group}" if own_file else group, name, part.settings)
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return hydra_compose(f"own_{command}", overrides=list(overrides))


def _open_mappings(node: Any) -> None:
    """Lets the command line add keys to the untyped mappings of a schema (`runtime.executor_options`, …)."""
    from omegaconf import DictConfig, OmegaConf

    for child in (node[name] for name in node if not OmegaConf.is_missing(node, name)):
        if isinstance(child, DictConfig) and OmegaConf.get_type(child) is dict:
            OmegaConf.set_struct(child, False)
        elif isinstance(child, DictConfig):
            _open_mappings(child)


@functools.cache
def _store_part(group: str, name: str, settings: type) -> None:
    """Once per process: a study composes many settings, and storing all parts takes a sixth of a composition."""
    from hydra.core.config_store import ConfigStore

    ConfigStore.instance().store(group=group, name=name, node=settings(kind=name))


def method_of_file(overrides: Sequence[str]) -> tuple[list[str], str | None]:
    """Overrides with a `method=FILE.yaml` replaced by what the file chooses, and the method's name: the file's. The
    command line's own choices outrank it. Such a file looks like those of conf/method.

    Raises:
        UsageError: the file cannot be read, or is no method.
    """
    files = [word for word in overrides if word.startswith("method=") and word.endswith((".yaml", ".yml"))]
    if not files:
        return list(overrides), None
    path = Path(files[-1].split("=", 1)[1]).expanduser()
    try:
        value = read_yaml_file(path)
        choices = [choice for choice in value.pop("defaults", []) if isinstance(choice, dict)]
        parts = {key.removeprefix("override /"): name for choice in choices for key, name in choice.items()}
        value.pop("method", None)
        words = [*as_words(**parts), *(word for word in as_words(**value) if not word.endswith("=null"))]
    except OSError as error:
        raise UsageError(f"method={path} cannot be read: {error.strerror}") from error
    except (ValueError, AttributeError, TypeError) as error:
        raise UsageError(f"method={path} is no method: see conf/method/kerv.yaml for one") from error
    rest = [word for word in overrides if word not in files]
    keys = {word.split("=", 1)[0] for word in rest}
    return [*(word for word in words if word.split("=", 1)[0] not in keys), *rest], path.stem


def expand(overrides: str | Sequence[str]) -> list[list[str]]:
    """Hydra's grid grammar -> one override list per point: `threshold.r=0,3` or `threshold.r=range(0,4)`.

    A string is split at white space outside quotes.

    Raises:
        UsageError: an override that cannot be parsed, no point, or more than MOST_POINTS of them.
    """
    from hydra.errors import HydraException

    words = split_words(overrides) if isinstance(overrides, str) else list(overrides)
    try:
        axes = [list(itertools.islice(_points(_parsed(word)), MOST_POINTS + 1)) for word in words]
    except (HydraException, *_STRANGE) as error:
        raise UsageError(f"cannot read '{' '.join(words)[:200]}': {_one_line(error)}") from error
    points = math.prod(map(len, axes))
    if not 0 < points <= MOST_POINTS:
        raise UsageError(f"'{' '.join(words)}' is a grid of {points:.6g} points: from 1 to {MOST_POINTS} are possible")
    return [list(point) for point in itertools.product(*axes)]


def split_words(text: str) -> list[str]:
    """The words of a line of overrides, split at white space outside quotes.

    Raises:
        UsageError: a quote or a backslash without its end.
    """
    import shlex

    try:
        return shlex.split(text)
    except ValueError as error:
        raise UsageError(f"cannot read '{text}': {error}") from error


def _points(override: Any) -> Iterator[str]:
    if not override.is_sweep_override():
        yield override.input_line
        return
    key, value = override.get_key_element(), override.value()
    if hasattr(value, "step") and abs(value.stop - value.start) > MOST_POINTS * abs(value.step):
        raise UsageError(f"'{override.input_line}' is too long: a grid has at most {MOST_POINTS} points")
    for value in override.sweep_string_iterator():
        yield f"{key}={value}"


def swept_keys(overrides: str | Sequence[str]) -> list[str]:
    """Keys of the overrides that hold several values."""
    points = expand(overrides)
    first = points[0] if points else []
    return [word.split("=", 1)[0] for i, word in enumerate(first) if len({p[i] for p in points}) > 1]


def to_yaml(settings: Any, indent: str = "") -> str:
    """A settings dataclass as YAML, for `--cfg`: behind a key what it is."""
    lines = []
    for at in fields(settings):
        value = getattr(settings, at.name)
        text = f"{at.name}:" if is_dataclass(value) else _one_yaml(at.name, value)
        first, *rest = text.splitlines()
        comment = description(at) if not rest or not isinstance(value, str) else ""
        lines += [f"{first}  # {comment}" if comment else first, *rest]
        if is_dataclass(value):
            lines += to_yaml(value, "  ").splitlines()
    return "".join(f"{indent}{line}\n" for line in lines)


def _one_yaml(key: str, value: Any) -> str:
    """A key and its value; a string without line breaks is one line."""
    return plain_yaml({key: value}, width=2**30, default_flow_style=False, allow_unicode=True)


def _task_list(word: str) -> str:
    """Adds the brackets that `task=reach` and `task=reach,push` leave out. Raises UsageError: no task at all."""
    key, value = word.split("=", 1)
    if key == "task" and not value:
        raise UsageError("task= is empty: name a task or a suite, or leave it out")
    return f"task=[{value}]" if key == "task" and not value.startswith("[") else word


def _explained(command: str, error: Exception, overrides: Sequence[str], schema: type) -> UsageError:
    """Names the first unknown key and the nearest known ones; without one, Hydra's own message on one line."""
    keys = keys_of(command, [word for word in overrides if word.split("=", 1)[0] in groups()], schema)
    for key in (word.split("=", 1)[0] for word in overrides):
        if key not in keys and key not in choices_of(schema):
            hint = did_you_mean(key, keys) or f"see 'kerv {command.replace('_', ' ')} --cfg' for the keys"
            return UsageError(f"unknown key '{key}': {hint}")
    return UsageError(_one_line(error.__cause__ or error))


def keys_of(command: str, choices: Sequence[str], schema: type) -> list[str]:
    """Every key of the command's configuration with these group choices, dotted; those of the groups alone where the
    choices do not compose."""
    from hydra.errors import HydraException

    try:
        return _keys(command, choices, schema)
    except HydraException:
        return _keys(command, [], schema)


def _keys(command: str, choices: Sequence[str], schema: type) -> list[str]:
    """Every key of the command's configuration with these group choices, dotted."""
    from omegaconf import DictConfig, OmegaConf

    def walk(node: DictConfig, prefix: str) -> Iterator[str]:
        for name in map(str, node):
            yield f"{prefix}{name}"
            if isinstance(OmegaConf.select(node, name), DictConfig):
                yield from walk(node[name], f"{prefix}{name}.")

    return list(walk(_composed(command, choices, schema), ""))


def _one_line(error: BaseException) -> str:
    """An error's message without the lines that OmegaConf adds, behind the key that it is about."""
    key = getattr(error, "full_key", None)
    text = " ".join(str(error).partition("\n    full_key:")[0].split())
    return f"{key}: {text}" if key else text
