"""The only module that uses Hydra: it composes a command's YAML files, checks overrides, expands a grid.

Typer owns the process and the messages. Overrides are checked before torch or MuJoCo load; a wrong one is answered by
one line with the nearest known keys.
"""

from __future__ import annotations

import difflib
import functools
import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from kerv_cli import registry
from kerv_cli.errors import UnknownName, UsageError
from kerv_cli.parts import PART_GROUPS, PREFILL

T = TypeVar("T")


def conf_dir() -> Path:
    """`$KERV_CONF_DIR`, else the checkout's `conf/`, else the one inside the installed package.

    Raises:
        UsageError: no configuration there.
    """
    chosen = os.environ.get("KERV_CONF_DIR")
    package = Path(__file__).resolve().parent
    places = [Path(chosen).resolve()] if chosen else [package.parent / "conf", package / "conf"]
    for place in places:
        if (place / "rollout.yaml").is_file():
            return place
    raise UsageError(f"no configuration in {' or '.join(map(str, places))}: set KERV_CONF_DIR to a folder like conf/")


def groups() -> dict[str, list[str]]:
    """Config groups and the names in them: {"method": ["ar", "spec_vla", …], …}."""
    root = conf_dir()
    known = {d.name: {p.stem for p in d.glob("*.yaml")} for d in sorted(root.iterdir()) if d.is_dir()}
    for group in PART_GROUPS:
        known.setdefault(group, set()).update(_parts_of(group))
    return {group: sorted(names) for group, names in sorted(known.items())}


def _parts_of(group: str) -> dict[str, registry.Part]:
    """The parts that a group may choose, by name; in-prefill drafts are proposers that need no states of the target."""
    if group != "prefill_draft":
        return dict(registry.parts(group))
    return {name: part for name, part in registry.parts("proposer").items() if part.traits.get("when") == PREFILL}


def compose(command: str, overrides: Sequence[str], schema: type[T]) -> T:
    """The command's settings: the dataclass `schema`, `conf/<command>.yaml`, its groups and the overrides.

    Raises:
        UsageError: an override that cannot be parsed, an unknown key or name, a value of the wrong type.
    """
    overrides, name = method_of_file(overrides)
    _check(command, overrides)
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    overrides = [_task_list(word) for word in overrides]
    try:
        settings = OmegaConf.to_object(_composed(command, overrides, schema))
    except HydraException as error:
        raise _explained(command, error, overrides, schema) from error
    except OmegaConfBaseException as error:
        raise UsageError(_one_line(error)) from error
    assert isinstance(settings, schema)
    if name is not None:
        settings.method = name  # type: ignore[attr-defined]
    return settings


def _composed(command: str, overrides: Sequence[str], schema: type) -> Any:
    """Hydra's composition, as typed nodes."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.config_store import ConfigStore
    from omegaconf import MISSING, OmegaConf

    store = ConfigStore.instance()
    base = OmegaConf.structured(schema)
    _open_mappings(base)
    for group in set(PART_GROUPS) & set(base):
        base[group] = MISSING  # the defaults list chooses the part, and with it the class of its settings
    store.store(name=f"base_{command}", node=base)
    for group in PART_GROUPS:
        for name, part in _parts_of(group).items():
            _store_part(group, name, part.settings)
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return hydra_compose(command, overrides=list(overrides))


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
    import yaml

    files = [word for word in overrides if word.startswith("method=") and word.endswith((".yaml", ".yml"))]
    if not files:
        return list(overrides), None
    path = Path(files[-1].split("=", 1)[1]).expanduser()
    try:
        value = yaml.safe_load(path.read_text(encoding="utf-8"))
        chosen = [choice for choice in value.pop("defaults", []) if isinstance(choice, dict)]
        parts = {key.removeprefix("override /"): name for choice in chosen for key, name in choice.items()}
        words = [*(f"{key}={name}" for key, name in parts.items()), *_flat({**value, "method": None})]
    except OSError as error:
        raise UsageError(f"method={path} cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, AttributeError, TypeError) as error:
        raise UsageError(f"method={path} is no method: see conf/method/kerv.yaml for one") from error
    rest = [word for word in overrides if word not in files]
    given = {word.split("=", 1)[0] for word in rest}
    return [*(word for word in words if word.split("=", 1)[0] not in given), *rest], path.stem


def _flat(values: dict[str, Any], prefix: str = "") -> Iterator[str]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        elif value is not None:
            yield f"{prefix}{key}={str(value).lower() if isinstance(value, bool) else value}"


def expand(overrides: str | Sequence[str]) -> list[list[str]]:
    """Hydra's grid grammar -> one override list per point: `threshold.r=0,3` or `threshold.r=range(0,4)`.

    A string is split at white space outside quotes.

    Raises:
        UsageError: an override that cannot be parsed.
    """
    import shlex

    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    words = shlex.split(overrides) if isinstance(overrides, str) else list(overrides)
    try:
        parsed = OverridesParser.create().parse_overrides(words)
        axes = [list(_points(o)) for o in parsed]
    except HydraException as error:
        raise UsageError(f"cannot read '{' '.join(words)}': {_one_line(error)}") from error
    return [list(point) for point in itertools.product(*axes)]


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


def to_yaml(settings: Any) -> str:
    """A settings dataclass as YAML, for `--cfg`."""
    from omegaconf import OmegaConf

    return OmegaConf.to_yaml(OmegaConf.structured(settings))


def _check(command: str, overrides: Sequence[str]) -> None:
    """Refuses unknown group choices before Hydra sees them: its own message about a missing file is long."""
    known = groups()
    for word in overrides:
        if "=" not in word:
            raise UsageError(
                f"'{word}' is not an override: write key=value, see 'kerv {spoken(command)} --cfg' for the keys"
            )
        key, value = word.split("=", 1)
        if key.lstrip("+~") in known and value not in known[key.lstrip("+~")]:
            raise UnknownName(key.lstrip("+~"), value, known[key.lstrip("+~")])


def spoken(command: str) -> str:
    """A command's name as it is typed: `train_drafter` -> `train drafter`."""
    return command.replace("_", " ")


def _task_list(word: str) -> str:
    """Adds the brackets that `task=reach` and `task=reach,push` leave out."""
    key, value = word.split("=", 1)
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
        key = word.split("=", 1)[0].lstrip("+~")
        if key not in keys and key not in groups():
            near = difflib.get_close_matches(key, keys, n=3, cutoff=0.5)
            near += [k for k in keys if k.endswith("." + key.rsplit(".", 1)[-1]) and k not in near][:3]
            hint = (
                f"did you mean {' or '.join(near[:3])}?" if near else f"see 'kerv {spoken(command)} --cfg' for the keys"
            )
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
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    useful = [line for line in lines if not line.startswith(("object_type", "reference_type", "See https"))]
    keys = [line for line in useful if line.startswith("full_key:")]
    text = " ".join(line for line in useful if not line.startswith("full_key:"))
    return f"{keys[0].removeprefix('full_key:').strip()}: {text}" if keys else text
