"""Declare the commands of `kerv`: the decorator `command` makes a function the command `kerv NAME`.

The decorator puts the function into kerv's registry. From that entry (a `Part` of kind `command`) this module makes
typer's command with its options, settings, help and completion. The function can have these parameters:

- `settings`: The command's settings, composed and checked.
- `overrides`: The `key=value` arguments as typed.
- `names`: All other arguments, such as names of runs.
- `cfg`: Whether --cfg was typed. Only for a command that prints its settings itself.

Every other parameter is an option of the command in typer's notation.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import Field, fields
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from typer.core import TyperCommand

from kerv_cli.base.config import compose, groups, plain_text
from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.places import check_writable
from kerv_cli.base.registry import NoSettings, Part, add, find, load, parts
from kerv_cli.base.settings import CommandSettings, choices_of
from kerv_cli.cli.common import settings_yaml

F = TypeVar("F", bound=Callable[..., None])


def command(name: str, settings: type = CommandSettings, keys: str = "", **traits: Any) -> Callable[[F], F]:
    """Decorate a function to make it the command `kerv NAME`. Its docstring becomes the help.

    Args:
        name: Name of the command, such as `train target`.
        settings: Dataclass of its settings. NoSettings if it has none.
        keys: Names of the settings that `--help` lists, separated by spaces.
        **traits: Optional properties:
            examples: Command lines for the help.
            names: Help text for arguments that are not `key=value`. Without it there are none.
            typed: Maps a key as typed on the command line to the name of the setting, if the two differ.
            writes: Whether the command writes to the results folder (default true). If so, kerv first checks that the
                folder is writable.
            each: Name of another command, whose settings can be typed, too, such as `rollout` for `sweep`.
    """

    def declare(run: F) -> F:
        shown = re.sub(r"\bresults\b", "results store", keys)
        add("command", name, f"{run.__module__}:{run.__name__}", settings, help=run.__doc__ or "", keys=shown, **traits)
        return run

    return declare


def schemas_of(part: Part) -> list[type]:
    """Return the dataclass of a command's settings. If its trait `each` names another command, add that one's."""
    others = [find("command", part.traits["each"])] if "each" in part.traits else []
    return [one.settings for one in (part, *others)]


def top_keys(part: Part) -> list[str]:
    """Return the names that an override of this command can begin with: `threshold` for `threshold.r=5`."""
    if part.settings is NoSettings:
        return []
    schemas = schemas_of(part)
    groups = [group for schema in schemas for group in choices_of(schema)]
    names = [at.name for schema in schemas for at in fields(schema)]
    hidden = {key for key in part.traits.get("typed", {}).values() if "." not in key}
    return [key for key in dict.fromkeys([*part.traits.get("typed", {}), *groups, *names]) if key not in hidden]


def typer_command(part: Part) -> TyperCommand:
    """Make a typer command from a registered command. This imports the module of its function."""
    run = load(part.build)
    parameters = inspect.signature(run, eval_str=True).parameters
    more = [one.replace(kind=one.KEYWORD_ONLY) for name, one in parameters.items() if name not in _ARGUMENTS]

    def callback(typed: list[str] | None = None, cfg: bool = False, **options: object) -> None:
        overrides, names = _split(part, typed or [], "names" in parameters)
        from kerv_cli.lab.command import chosen_store, noted

        with chosen_store(overrides) as overrides:
            arguments = {"overrides": overrides, "names": names, "cfg": cfg}
            if "settings" in parameters or (cfg and "cfg" not in parameters):
                arguments["settings"] = _settings(part, overrides, cfg)
            with noted([*part.name.split(), *overrides, *names, *_flags(made, options)]):
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


def _flags(command: TyperCommand, options: Mapping[str, object]) -> list[str]:
    """Return the options that were given, as they are typed: `--plan`, `--to`, `csv`.

    Args:
        command: The command.
        options: The values of the options, by the name of the parameter.
    """
    names = {param.name: param.opts[0] for param in command.params}
    given = [(names[name], value) for name, value in options.items() if value not in (None, False)]
    return [word for name, value in given for word in ([name] if value is True else [name, str(value)])]


CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 120}
_ARGUMENTS = ("settings", "overrides", "names", "cfg")
_CFG = Annotated[bool, typer.Option("--cfg", help="Print the resolved settings and stop.")]


def _option(name: str, default: object, annotation: object) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _typed_argument(part: Part) -> object:
    """Return the type annotation of the one argument that takes all words except options. The help does not list it."""
    metavar = "NAME" if "names" in part.traits else "KEY=VALUE"
    argument = typer.Argument(metavar=metavar, hidden=True, autocompletion=complete)
    return Annotated[list[str] | None, argument]


def complete(ctx: typer.Context, incomplete: str) -> list[str]:
    """Complete an override in the shell: `me` becomes `method=`, and `method=s` every method that begins with s.

    bash passes `method`, `=` and `s` as three words, other shells pass one.
    """
    part = parts("command")[" ".join(ctx.command_path.split()[1:])]
    keys, before = top_keys(part), [word for word in ctx.params.get("typed") or () if word != "="]
    if before and before[-1] in keys:
        return [name for name in _values(part, before[-1]) if name.startswith(incomplete)]
    key, equals, typed = incomplete.partition("=")
    if not equals:
        return [f"{name}=" for name in keys if name.startswith(incomplete)]
    return [f"{key}={name}" for name in _values(part, key) if name.startswith(typed)]


def _values(part: Part, key: str) -> list[str]:
    """Return the names that a setting can have as its value. Empty if its values are not names from a list."""
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
    """Split the arguments into overrides (`key=value`) and names.

    Args:
        part: The command.
        typed: The arguments.
        named: Whether the command takes names. If not, all arguments are overrides.

    Raises:
        UnknownName: An argument looks like an override, but the command has no such setting.
    """
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
    """Return the settings of a command. With --cfg print them and end the command instead.

    Args:
        part: The command.
        overrides: The overrides as typed.
        cfg: Whether --cfg was typed.

    Raises:
        UsageError: An override is wrong, see `config.compose`.
        StorageError: The command writes to the results folder, which cannot be written.
    """
    typed = part.traits.get("typed", {})
    for key in (word.partition("=")[0] for word in overrides):
        own = key.rpartition(".")[2]
        if own in typed and key not in typed and key.partition(".")[0] not in top_keys(part):
            raise UsageError(f"unknown key '{key}': did you mean {own}?", key)
    pairs = [(typed.get(key, key), equals, value) for key, equals, value in (word.partition("=") for word in overrides)]
    settings: Any = compose(part.name.replace(" ", "_"), ["".join(pair) for pair in pairs], part.settings)
    if cfg:
        typer.echo(settings_yaml(settings), nl=False)
        raise typer.Exit(0)
    if part.traits.get("writes", True) and hasattr(settings, "results"):
        check_writable(settings.results)
    return settings


class CommandWithSettings(TyperCommand):
    """A typer command whose help also lists settings, subcommands and examples."""

    part: Part

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Add the most used settings, the subcommands and the examples to the help."""
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
    """Return the first sentence of a command's help, or its part before a semicolon."""
    return re.split(r"[.;]\s", part.traits.get("help", "") + " ")[0]


def _row(part: Part, key: str) -> tuple[str, str]:
    """Return a line of the help about one setting.

    Args:
        part: The command.
        key: The setting as typed on the command line.

    Returns:
        `key=default`, and the type with the description.
    """
    name = part.traits.get("typed", {}).get(key, key)
    schema = next(schema for schema in schemas_of(part) if name.split(".")[0] in {at.name for at in fields(schema)})
    value: Any = _defaults(schema)
    for word in name.split("."):
        at = next(at for at in fields(value) if at.name == word)
        value = getattr(value, word)
    choices = choices_of(schema)
    shown = "" if value is None else "{…}" if isinstance(value, dict) else plain_text(value)
    default = choices.get(name, shown)
    return f"{key}={default}", f"{'name' if name in choices else _type_name(at)}: {at.metadata.get('help', '')}"


@functools.cache
def _defaults(schema: type) -> Any:
    """Return the settings of a command without any override."""
    return compose("", [], schema)


def _type_name(at: Field[Any]) -> str:
    if "names" in at.metadata:
        return " | ".join(at.metadata["names"])
    plain = str(at.type).removesuffix(" | None").split("[")[0]
    return {"str": "text", "bool": "true or false", "dict": "mapping", "float": "number"}.get(plain, plain)


def commands_below(prefix: str) -> Iterator[Part]:
    """Yield the commands whose names begin with `prefix`, such as `train `, in the order of registration."""
    return (part for name, part in parts("command").items() if name.startswith(prefix))
