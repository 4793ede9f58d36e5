"""What a command is: a registered part of the kind `command`.

Typer's command, the composition of its settings, `--cfg`, `--help` and completion derive from that declaration. The
command's function takes what it names: `settings` (composed and checked), `overrides` (as typed), `names` (what
is typed besides), `cfg` (if it prints settings itself), and options of its own in typer's notation.
"""

from __future__ import annotations

import contextlib
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import Field, fields
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from typer.core import TyperCommand

from kerv_cli.base.config import compose, conf_dir, groups
from kerv_cli.base.errors import UnknownName
from kerv_cli.base.files import read_yaml
from kerv_cli.base.limits import field_of
from kerv_cli.base.places import check_writable
from kerv_cli.base.registry import NoSettings, Part, add, find, load, parts
from kerv_cli.base.settings import CommandSettings, choices_of
from kerv_cli.cli.common import settings_yaml

F = TypeVar("F", bound=Callable[..., None])


def command(name: str, settings: type = CommandSettings, keys: str = "", **traits: Any) -> Callable[[F], F]:
    """Declare the function below as `kerv NAME`. Its docstring is the help.

    Args:
        name: Its name.
        settings: Dataclass of its settings; NoSettings if it takes none.
        keys: Settings that people use, for the help.
        **traits: examples: command lines that work, for the help. names: help for what is typed besides overrides.
            lists: settings whose lists need no brackets. typed: key on the command line -> the setting, if they differ.
            writes: whether it stores results, so that a folder that cannot be written is refused first (default: true).
            each: the command whose settings all other overrides go to.
    """

    def declare(run: F) -> F:
        shown = re.sub(r"\bresults\b", "results store", keys)
        add("command", name, f"{run.__module__}:{run.__name__}", settings, help=run.__doc__ or "", keys=shown, **traits)
        return run

    return declare


def schemas_of(part: Part) -> list[type]:
    """Return the class of the command's settings, then that of `each`."""
    others = [find("command", part.traits["each"])] if "each" in part.traits else []
    return [one.settings for one in (part, *others)]


def top_keys(part: Part) -> list[str]:
    """Return the names that the command takes before `=` or a dot."""
    if part.settings is NoSettings:
        return []
    schemas = schemas_of(part)
    groups = [group for schema in schemas for group in choices_of(schema)]
    names = [at.name for schema in schemas for at in fields(schema)]
    hidden = {key for key in part.traits.get("typed", {}).values() if "." not in key}
    return [key for key in dict.fromkeys([*part.traits.get("typed", {}), *groups, *names]) if key not in hidden]


def typer_command(part: Part) -> TyperCommand:
    """Make typer's command from a registered one. Its module is imported now."""
    run = load(part.build)
    parameters = inspect.signature(run, eval_str=True).parameters
    more = [one.replace(kind=one.KEYWORD_ONLY) for name, one in parameters.items() if name not in _ARGUMENTS]

    def callback(typed: list[str] | None = None, cfg: bool = False, **options: object) -> None:
        overrides, names = _split(part, typed or [], "names" in parameters)
        from kerv_cli.lab.command import chosen_store

        with chosen_store(overrides) as overrides:
            arguments = {"overrides": overrides, "names": names, "cfg": cfg}
            if "settings" in parameters or (cfg and "cfg" not in parameters):
                arguments["settings"] = _settings(part, overrides, cfg)
            with _noted([*part.name.split(), *overrides, *names, *_flags(made, options)]):
                run(**{name: value for name, value in arguments.items() if name in parameters}, **options)

    cfg_option = [] if part.settings is NoSettings else [_option("cfg", False, _CFG)]
    options = [_option("typed", None, _typed_argument(part)), *cfg_option, *more]
    callback.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    single = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    help = "\n\n".join(filter(None, (inspect.cleandoc(part.traits.get("help", "")), part.traits.get("names"))))
    single.command(part.name, cls=CommandWithSettings, help=help, context_settings=CONTEXT)(callback)
    made: Any = typer.main.get_command(single)
    made.part = part
    return made


@contextlib.contextmanager
def _noted(overrides: list[str]) -> Iterator[None]:
    """Note the command for the rows of the runs that it begins. `kerv prepare` runs commands within its own."""
    from kerv_cli.lab.command import set_command

    before = set_command(overrides)
    try:
        yield
    finally:
        set_command(before)


def _flags(command: TyperCommand, options: Mapping[str, object]) -> list[str]:
    """Return options as they are typed, without those that are left out."""
    names = {param.name: param.opts[0] for param in command.params}
    given = [(names[name], value) for name, value in options.items() if value not in (None, False)]
    return [word for name, value in given for word in ([name] if value is True else [name, str(value)])]


CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 120}
_ARGUMENTS = ("settings", "overrides", "names", "cfg")
_CFG = Annotated[bool, typer.Option("--cfg", help="Print the resolved settings and stop.")]


def _option(name: str, default: object, annotation: object) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _typed_argument(part: Part) -> object:
    """Return the argument for everything that is not an option. The help has sections of its own for it."""
    metavar = "NAME" if "names" in part.traits else "KEY=VALUE"
    argument = typer.Argument(metavar=metavar, hidden=True, autocompletion=complete)
    return Annotated[list[str] | None, argument]


def complete(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return completions: `me` -> `method=`; `method=s` -> every method that begins so. bash splits at `=`."""
    part = parts("command")[" ".join(ctx.command_path.split()[1:])]
    keys, before = top_keys(part), [word for word in ctx.params.get("typed") or () if word != "="]
    if before and before[-1] in keys:
        return [name for name in _values(part, before[-1]) if name.startswith(incomplete)]
    key, equals, typed = incomplete.partition("=")
    if not equals:
        return [f"{name}=" for name in keys if name.startswith(incomplete)]
    return [f"{key}={name}" for name in _values(part, key) if name.startswith(typed)]


def _values(part: Part, key: str) -> list[str]:
    """Return the names that a key can be set to; none if any value is possible."""
    if key == "task":
        from kerv_cli.worlds import task_names

        return list(task_names())
    for schema in schemas_of(part):
        if key in choices_of(schema):
            return groups()[key]
        for at in fields(schema):
            if at.name == key:
                return list(at.metadata.get("names", ()))
    return []


def _split(part: Part, typed: list[str], named: bool) -> tuple[list[str], list[str]]:
    """Split what was typed into overrides and names."""
    if not named:
        return typed, []
    keys = set(top_keys(part))
    overrides = [one for one in typed if "=" in one and one.lstrip("+").partition("=")[0].split(".")[0] in keys]
    names = [one for one in typed if one not in overrides]
    filters = set(re.findall(r"(\w+)=", part.traits["names"]))
    for name in names:
        key, equals, _ = name.partition("=")
        if equals and re.fullmatch(r"[\w.]+", key) and key not in filters and not Path(name).exists():
            raise UnknownName("key", key, sorted(keys | filters))
    return overrides, names


def _settings(part: Part, overrides: list[str], cfg: bool) -> Any:
    """Return the command's settings. With --cfg they are printed and the command ends.

    Raises:
        UsageError: As `config.compose`.
        StorageError: As `places.check_writable`.
    """
    typed = part.traits.get("typed", {})
    pairs = [(typed.get(key, key), equals, value) for key, equals, value in (word.partition("=") for word in overrides)]
    lists = part.traits.get("lists", ())
    plain = [f"{key}=[{value.strip('[]')}]" if key in lists else key + equals + value for key, equals, value in pairs]
    settings: Any = compose(part.name.replace(" ", "_"), plain, part.settings)
    if cfg:
        typer.echo(settings_yaml(settings), nl=False)
        raise typer.Exit(0)
    if part.traits.get("writes", True) and hasattr(settings, "results"):
        check_writable(settings.results)
    return settings


class CommandWithSettings(TyperCommand):
    """A command whose help lists its settings."""

    part: Part

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the settings that people use, the commands below this one, and examples."""
        keys = [_row(self.part, key) for key in self.part.traits.get("keys", "").split()]
        below = [part for name, part in parts("command").items() if name.startswith(f"{self.part.name} ")]
        if keys:
            with formatter.section(f"Settings, with their defaults (all of them: kerv {self.part.name} --cfg)"):
                formatter.write_dl(keys)
        if below:
            with formatter.section("Commands"):
                formatter.write_dl([(part.name, summary_of(part)) for part in below])
        if self.part.traits.get("examples"):
            with formatter.section("Examples"):
                for line in self.part.traits["examples"]:
                    formatter.write(f"{'':{formatter.current_indent}}{line}\n")


def summary_of(part: Part) -> str:
    """Return a command's help up to the first full stop or semicolon."""
    return re.split(r"[.;]\s", part.traits.get("help", "") + " ")[0]


def _row(part: Part, key: str) -> tuple[str, str]:
    """Return (key=default, type and description) of a setting, for the help."""
    name = part.traits.get("typed", {}).get(key, key)
    schema = next(schema for schema in schemas_of(part) if name.split(".")[0] in {at.name for at in fields(schema)})
    at, value = field_of(schema, name)
    assert at is not None
    default = choices_of(schema).get(name, _of_file(schema, name, value))
    kind = "name" if name in choices_of(schema) else _type_name(at)
    shown = "{…}" if isinstance(default, dict) else _plain(default)
    return f"{key}={shown}", f"{kind}: {at.metadata.get('help', '')}"


def _of_file(schema: type, key: str, default: object) -> object:
    """Return the value of a dotted key in the file of conf/ that its group chooses, else `default`."""
    group, *path = key.split(".")
    file = conf_dir() / group / f"{choices_of(schema).get(group)}.yaml"
    value = read_yaml(file) if path and file.is_file() else {}
    for name in path:
        value = value.get(name, {}) if isinstance(value, dict) else {}
    return default if value == {} else value


def _type_name(at: Field[Any]) -> str:
    if "names" in at.metadata:
        return " | ".join(at.metadata["names"])
    plain = str(at.type).removesuffix(" | None").split("[")[0]
    return {"str": "text", "bool": "true or false", "dict": "mapping", "float": "number"}.get(plain, plain)


def _plain(value: object) -> str:
    if isinstance(value, list):
        return f"[{','.join(map(str, value))}]"
    return "" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def commands_below(prefix: str) -> Iterator[Part]:
    """Yield the commands whose names begin with `prefix`, in the order of registration."""
    return (part for name, part in parts("command").items() if name.startswith(prefix))
