"""The only module that uses Hydra: it composes a command's settings, checks overrides, expands a grid.

Typer owns the process and the messages. Overrides are checked before torch or MuJoCo load; a wrong one is answered by
one line with the nearest known keys.
"""

from __future__ import annotations

import copy
import functools
import itertools
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from kerv_cli.base import registry
from kerv_cli.base.errors import GONE, UnknownName, UsageError
from kerv_cli.base.files import read_yaml_file
from kerv_cli.base.files import to_yaml as plain_yaml
from kerv_cli.base.limits import check_settings, description, field_of
from kerv_cli.base.near import KEYS, nearest, question
from kerv_cli.base.registry import PREFILL, SETTINGS_GROUPS, part_of
from kerv_cli.base.settings import DERIVED_FROM, PolicySettings, TrainSettings, choices_of

T = TypeVar("T")

_STRANGE = (ValueError, TypeError, AttributeError, RecursionError)
"""What Hydra raises at strange words, besides its own."""
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
    """The command's settings: the dataclass `schema`, its groups of `conf/` and the overrides. A `<command>.yaml` in
    `KERV_CONF_DIR` chooses the groups instead, and what it sets outranks them.

    Raises:
        UsageError: an override that cannot be parsed, an unknown key or name, a value of another type or out of range.
    """
    check_once(overrides, groups())
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
        for word, override in zip(overrides, parsed, strict=True):
            self._check_one_value(word, override)
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
            if override.value() == "" and (default := OmegaConf.select(nodes, override.key_or_group)):
                raise _empty(override.key_or_group, default)
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
        """Refuses what Hydra would answer at length or not at all: words that are no overrides, unknown group choices,
        several choices where the command takes one."""
        for word in overrides:
            key, equals, value = word.partition("=")
            if not equals or not key or key[0] == "~":  # nothing is taken away from settings
                hint = GONE.get((self.command, word)) or f"write key=value, {self._hint(word)}"
                raise UsageError(f"'{word}' is not an override: {hint}")
            if key != key.strip() or value != value.strip():
                raise UsageError(f"'{word}' has spaces around its '=': write {key.strip()}={value.strip()}")
            if key not in self.groups or value in self.groups[key]:
                continue
            if not value:
                raise _empty(key, choices_of(self.schema).get(key, "NAME"))
            if key in ("study", "method") and "/" in value:
                raise UsageError(f"{word} is no YAML file: name one that ends in .yaml, or a {key} that kerv has")
            several = [name.strip() for name in value.split(",")]
            if len(several) > 1 and set(several) <= set(self.groups[key]):
                grid = self.command == "rollout"
                hint = "-m runs each in turn, or" if grid else "this command takes one:"
                raise UsageError(f"{word} names {len(several)} choices: {hint} choose one of them")
            raise UnknownName(key, value, self.groups[key], self._of_policy(key, value))

    def _of_policy(self, key: str, value: str) -> str:
        """What the writer of a choice that no group has may have meant: weights by their name."""
        mine = {at.name for at in fields(self.schema)}  # type: ignore[arg-type]
        name = "target" if key == "policy" else key
        weights = "policy" in mine and name in {at.name for at in fields(PolicySettings)}
        return f"policy.{name}={value} names weights" if weights and (key == "policy" or key not in mine) else ""

    def _hint(self, word: str) -> str:
        """What the writer of a word without `=` may have meant, e.g. `episodes:`."""
        keys = [*choices_of(self.schema), *(at.name for at in fields(self.schema))]  # type: ignore[arg-type]
        key, _, value = word.partition(":")
        near = nearest(key, keys, KEYS)[:1]
        return question(near, f"={value}") or f"see 'kerv {spoken(self.command)} --cfg' for the keys"

    def _check_one_value(self, word: str, override: Any) -> None:
        """Refuses several values where one is taken."""
        if not override.is_sweep_override():
            return
        key, _, value = word.partition("=")
        kind = next((str(at.type) for at in fields(self.schema) if at.name == key), "")  # type: ignore[arg-type]
        hint = "this command takes one: choose one of them"
        if kind.startswith("list"):
            hint = f"write {key}=[{value}]"
        elif self.command == "rollout":
            hint = "-m runs each in turn, or choose one of them"
        raise UsageError(f"{word} holds several values: {hint}")

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
        raise UsageError(f"cannot read '{word[:200]}': {_readable(word)}") from error


def _readable(word: str) -> str:
    """What the writer of a word that Hydra cannot parse may have meant."""
    key, _, value = word.partition("=")
    if re.search(r"\s[\w.]+=", value):
        return f"these are several settings, leave out the quotes: {word.replace(', ', ' ')}"
    names = re.findall(r"[^\s\[\],;]+", value)
    if re.match(r"\[|[^/~]*[,;]", value) and names:
        return f"write {key}={names[0]}" if len(names) == 1 else f"write {key}=[{','.join(names)}]"
    if any(value.count(a) != value.count(b) for a, b in ("[]", "{}", "()")) or value.count("'") % 2:
        return "its brackets or quotes do not match"
    quoted = f"{key}='{value}'"
    return f'quote it: "{quoted}"'


def _empty(key: str, default: Any) -> UsageError:
    return UsageError(f"{key}= is empty: write {key}={default}, or leave it out")


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
    own = not (conf_dir() / f"{command}.yaml").is_file()
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return hydra_compose(f"own_{command}" if own else command, overrides=list(overrides))


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

    A string is split at white space outside quotes. The grid is counted before it is expanded.

    Raises:
        UsageError: an override that cannot be parsed, or more than MOST_POINTS points.
    """
    from hydra.errors import HydraException

    words = split_words(overrides) if isinstance(overrides, str) else list(overrides)
    parsed = [_parsed(word) for word in words]
    try:
        points = math.prod(map(_count, parsed))
        if points > MOST_POINTS:
            raise UsageError(f"'{' '.join(words)}' is a grid of {points:.6g} points: at most {MOST_POINTS}")
        if not points:
            raise UsageError(f"'{' '.join(words)}' is a grid without a point: a range ends before it begins")
        axes = [list(_points(o)) for o in parsed]
    except HydraException as error:
        raise UsageError(f"cannot read '{' '.join(words)}': {_one_line(error)}") from error
    except _STRANGE as error:
        raise UsageError(f"cannot read '{' '.join(words)[:200]}': {_one_line(error)}") from error
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


def _count(override: Any) -> float:
    """Number of points that an override stands for.

    Raises:
        UsageError: a range without an end or with steps of 0, an interval, a glob.
    """
    from hydra.core.override_parser.types import ChoiceSweep, RangeSweep

    value = override.value()
    if not override.is_sweep_override():
        return 1
    if isinstance(value, ChoiceSweep):
        return len(value.list)
    if not isinstance(value, RangeSweep):
        raise UsageError(f"'{override.input_line}' is no list of values: write key=a,b,c or key=range(first,end,step)")
    numbers = value.start, value.stop, value.step
    if any(number is None or not math.isfinite(number) for number in numbers) or not value.step:
        raise UsageError(f"'{override.input_line}': a range needs a first number, an end and a step that is not 0")
    return max(0, math.ceil((value.stop - value.start) / value.step))  # type: ignore[operator]


def _points(override: Any) -> Iterator[str]:
    if not override.is_sweep_override():
        yield override.input_line
        return
    key = override.get_key_element()
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


def check_once(overrides: Iterable[str], names: Iterable[str]) -> None:
    """Refuses two choices from one group; of a key that is given twice, the last value counts."""
    first: dict[str, str] = {}
    for key, value in (word.lstrip("+").split("=", 1) for word in overrides if "=" in word):
        if key in names and key in first:
            raise UsageError(f"{key}= is given twice, {first[key]} and {value}: leave one out")
        first[key] = value


def spoken(command: str) -> str:
    """A command's name as it is typed: `train_drafter` -> `train drafter`."""
    return command.replace("_", " ")


def _task_list(word: str) -> str:
    """Adds the brackets that `task=reach` and `task=reach,push` leave out. Raises UsageError: no task at all."""
    key, value = word.split("=", 1)
    if key == "task" and value.strip("[] ") == "":
        raise UsageError("name at least one task or suite: task=NAME, or leave it out")
    return f"task=[{value}]" if key == "task" and not value.startswith("[") else word


def _explained(command: str, error: Exception, overrides: Sequence[str], schema: type) -> UsageError:
    """Names the first unknown key and the nearest known ones; without one, Hydra's own message on one line."""
    from hydra.errors import HydraException

    choices = [word for word in overrides if word.split("=", 1)[0] in groups()]
    try:
        keys = _keys(command, choices, schema)
    except HydraException:  # the choices alone do not compose
        return UsageError(_one_line(error.__cause__ or error))
    for word in overrides:
        key, _, value = word.partition("=")
        if key in keys:
            continue
        if key not in groups():
            near = nearest(key, [one for one in keys if not any(other.startswith(f"{one}.") for other in keys)], KEYS)
            hint = question(near, f"={value}") or _elsewhere(command, key)
            return UsageError(f"unknown key '{key}': {hint}")
    return _wrong_value(error, overrides, keys, schema)


def _elsewhere(command: str, key: str) -> str:
    """Which commands have a setting that this one has not."""
    head, leaf = key.split(".")[0], key.rsplit(".", 1)[-1]
    owners = []
    for name, part in registry.parts("command").items():
        own = {at.name for at in fields(part.settings)}
        train = {at.name for at in fields(TrainSettings)} if "train" in own else set()
        if head in own or leaf in train:
            owners.append(f"'kerv {name}'")
    others = f"a setting of {', '.join(sorted(owners)[:3])}; " if 0 < len(owners) < 9 else ""
    return f"{others}see 'kerv {spoken(command)} --cfg' for the keys"


_KINDS = {"Integer": "a whole number", "Float": "a number", "bool": "true or false"}
_NUMBER = re.compile(r"-?\d+\.?\d*(e[+-]?\d+)?", re.IGNORECASE)


def _wrong_value(error: Any, overrides: Sequence[str], keys: Sequence[str], schema: type) -> UsageError:
    """Says what kind of value a key takes, with one that it would take."""
    key = str(getattr(error, "full_key", None) or "")
    value = next((word.split("=", 1)[1] for word in reversed(overrides) if word.startswith(f"{key}=")), None)
    plain = _one_line(error.__cause__ or error)
    if not key or value is None:
        return UsageError(plain)
    below = [one for one in keys if one.startswith(f"{key}.")]
    if below:
        named = [one for one in below if one.rsplit(".", 1)[-1] in ("kind", "name")]
        return UsageError(f"{key}={value}: {question(named, f'={value}') or 'it has settings: ' + ', '.join(below)}")
    if "ListConfig" in plain:
        return UsageError(f"{key}={value}: a list, write {key}=[{value}]")
    kind = re.search("|".join(_KINDS), plain)
    if kind is None:
        return UsageError(plain)
    number = _NUMBER.match(value)
    at, example = field_of(schema, key)
    if number and math.isfinite(float(number[0])) and kind[0] != "bool" and "%" not in value:
        example = int(float(number[0])) if kind[0] == "Integer" else number[0]
    such = "" if example is None else f", e.g. {key}={str(example).lower()}"
    about = f" ({description(at)})" if at is not None and description(at) else ""
    return UsageError(f"{key}={value}: {_KINDS[kind[0]]}{such}{about}")


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
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    useful = [line for line in lines if not line.startswith(("object_type", "reference_type", "See https"))]
    keys = [line for line in useful if line.startswith("full_key:")]
    text = " ".join(line for line in useful if not line.startswith("full_key:"))
    return f"{keys[0].removeprefix('full_key:').strip()}: {text}" if keys else text
