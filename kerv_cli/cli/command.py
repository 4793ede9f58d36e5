"""Declare the commands of `kerv`: the decorator `command` turns a function into a command.

The decorator puts the function into kerv's registry. From that entry (a `Part` of kind `command`) this module makes
typer's command with its options, settings and help. The function is written as for typer. kerv fills in
three of its parameters. All other parameters are typer's options:

- `settings`: The command's settings, composed and checked. The command then has the option --cfg.
- `overrides`: The `key=value` arguments as typed.
- `names`: All other arguments, such as names of runs. The help describes them in a paragraph that begins with `NAME:`.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, cast

import typer
from typer.core import TyperCommand

from kerv_cli.base.config import compose, plain_text
from kerv_cli.base.errors import UnknownName
from kerv_cli.base.paths import check_writable
from kerv_cli.base.registry import MODULES, Part, parts
from kerv_cli.base.settings import CommandSettings, RunSettings, choices_of
from kerv_cli.cli.common import settings_yaml

ARGUMENTS = ("settings", "overrides", "names")
CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 120}
Cfg = Annotated[bool, typer.Option("--cfg", help="Print the resolved settings and stop.")]


@dataclass(frozen=True, kw_only=True)
class Command(Part):
    """A command `kerv NAME`. Its function's docstring becomes the help, with the section `Examples:` at its end.

    Args:
        settings: Dataclass of its settings.
        keys: Names of the settings that `--help` lists, separated by spaces.
        typed: Maps a key as typed on the command line to the name of the setting, if the two differ.
        writes: Whether the command writes to the results folder. If so, kerv first checks that the folder is writable.
        each: Name of another command whose settings can also be typed after this command. For `sweep` it is `rollout`.
    """

    kind = "command"
    settings: type = field(default=CommandSettings, kw_only=False)
    keys: str = "results"
    typed: Mapping[str, str] = field(default_factory=dict)
    writes: bool = True
    each: str = ""

    @property
    def help(self) -> str:
        return inspect.cleandoc(self.code.__doc__ or "").partition("\n\nExamples:\n")[0]

    @property
    def examples(self) -> list[str]:
        lines = inspect.cleandoc(self.code.__doc__ or "").partition("\n\nExamples:\n")[2].splitlines()
        return list(map(str.strip, lines))

    @property
    def summary(self) -> str:
        return re.split(r"[.;]\s", self.help + " ")[0]

    @property
    def shown(self) -> list[str]:
        return re.sub(r"\bresults\b", "results store", self.keys).split()


command = Command  # the decorator that declares a command


def schemas_of(part: Command) -> list[type]:
    return [part.settings, commands(part.each)[part.each].settings] if part.each else [part.settings]


def fields_of(settings: Any) -> dict[str, Field[Any]]:
    return {one.name: one for one in fields(settings)}


def commands(words: str = "") -> dict[str, Command]:
    """Return the commands whose names begin with `words`, by name, in the order of the help.

    Only the file that declares these commands is imported, so that help and error messages appear quickly.
    """
    files, file = MODULES["command"], f"kerv_cli.cli.{words.partition(' ')[0]}"
    found = parts("command", file if file in files else "")
    names = sorted(found, key=lambda name: [*files, found[name].module].index(found[name].module))  # plugins last
    return {name: cast(Command, found[name]) for name in names if f"{name} ".startswith(f"{words} ".lstrip())}


def typer_command(part: Command) -> TyperCommand:
    words = {**CONTEXT, "allow_extra_args": True}  # typer would import pydantic to parse arguments
    made = _made(part.code, name=part.name, cls=CommandWithSettings, help=part.help, context_settings=words)
    made.part, made.short_help = part, part.summary
    made.arguments = [one.name for one in made.params if one.name in ARGUMENTS]
    made.params = [one for one in made.params if one.name not in ARGUMENTS]
    made.options_metavar = f"[OPTIONS] [{'NAME' if 'names' in made.arguments else 'KEY=VALUE'}]..."
    if "settings" in made.arguments:
        made.params[:0] = _made(_with_settings).params
    return cast(TyperCommand, made)


def _made(code: Callable[..., None], **more: Any) -> Any:
    single = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    single.command(**more)(code)
    return typer.main.get_command(single)


def _with_settings(cfg: Cfg = False) -> None:
    pass


def _split(part: Command, typed: list[str]) -> tuple[list[str], list[str]]:
    keys = {*choices_of(part.settings), *fields_of(part.settings)}
    filters = set(re.findall(r"(\w+)=", part.help.partition("\n\nNAME: ")[2]))
    overrides, names = [], []
    for word in typed:
        key, equals, _ = word.partition("=")
        if equals and key.lstrip("+").split(".")[0] in keys:
            overrides.append(word)
        elif equals and re.fullmatch(r"[\w.]+", key) and key not in filters and not Path(word).exists():
            raise UnknownName("key", key, sorted(keys | filters))
        else:
            names.append(word)
    return overrides, names


def _settings(part: Command, overrides: list[str], cfg: bool) -> Any:
    named: list[str] = []
    for word in overrides:
        key, equals, value = word.partition("=")
        named.append(f"{part.typed.get(key, key)}{equals}{value}")
    settings: Any = compose(part.name.replace(" ", "_"), named, part.settings)
    if cfg:
        typer.echo(settings_yaml(settings), nl=False)
        raise typer.Exit(0)
    if part.writes and hasattr(settings, "results"):
        check_writable(settings.results)
    return settings


class FastFlags:
    """Sets each flag that is not typed to False instead of None. Typer would import pydantic to convert None."""

    def get_params(self, ctx: Any) -> list[Any]:
        params: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for one in params:
            if getattr(one, "is_flag", False) and one.default is None:
                one.default = False
        return params


class CommandWithSettings(FastFlags, TyperCommand):
    """A typer command whose help also lists settings, subcommands and examples."""

    part: Command
    arguments: list[str]

    def invoke(self, ctx: Any) -> Callable[[], None]:
        """Compose the settings. Return a function without arguments that runs the command."""
        from kerv_cli.lab.command import chosen_store, noted

        part, options, whole = self.part, ctx.params, ctx.find_root()
        words = whole.with_resource(chosen_store(ctx.args))
        overrides, names = _split(part, words) if "names" in self.arguments else (words, [])
        given: dict[str, Any] = {"overrides": overrides, "names": names}
        if "settings" in self.arguments:
            given["settings"] = _settings(part, overrides, options.pop("cfg"))
        if options.get("plan") and isinstance(given.get("settings"), RunSettings):
            from kerv_cli.base.runtime import device_of

            device_of(given["settings"].runtime)
        whole.with_resource(noted([*part.name.split(), *overrides, *names]))
        return functools.partial(part.code, **{name: given[name] for name in self.arguments}, **options)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        below = commands(self.part.name)
        below.pop(self.part.name, None)
        has_cfg = "cfg" in map(attrgetter("name"), self.params)
        every = f" (all of them: kerv {self.part.name} --cfg)" if has_cfg else ""
        sections: dict[str, list[tuple[str, str]]] = {
            f"Settings, with their defaults{every}": [_row(self.part, key) for key in self.part.shown],
            "Commands": [(name, part.summary) for name, part in below.items()],
        }
        for title, rows in sections.items():
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)
        if self.part.examples:
            with formatter.section("Examples"):
                for line in self.part.examples:
                    formatter.write(f"{'':{formatter.current_indent}}{line}\n")


def _row(part: Command, key: str) -> tuple[str, str]:
    name = part.typed.get(key, key)
    schema = next(one for one in schemas_of(part) if name.split(".")[0] in fields_of(one))
    value: Any = _defaults(schema)
    for word in name.split("."):
        at = fields_of(value)[word]
        value = getattr(value, word)
    choices = choices_of(schema)
    shown = "" if value is None else "{…}" if isinstance(value, dict) else plain_text(value)
    default = choices.get(name, shown)
    return f"{key}={default}", f"{'name' if name in choices else _type_name(at)}: {at.metadata.get('help', '')}"


@functools.cache
def _defaults(schema: type) -> Any:
    return compose("", [], schema)


def _type_name(at: Field[Any]) -> str:
    if "names" in at.metadata:
        return " | ".join(at.metadata["names"])
    plain = str(at.type).removesuffix(" | None").split("[")[0]
    return {"str": "text", "bool": "true or false", "dict": "mapping", "float": "number"}.get(plain, plain)
