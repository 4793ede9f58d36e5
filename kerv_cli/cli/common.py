"""Helpers of all commands: common options, one-line errors, progress bars, tables."""

from __future__ import annotations

import json
import math
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar

import typer

from kerv_cli.base.durations import duration
from kerv_cli.base.errors import Interrupted, KervError, UsageError, is_of_an_interrupt
from kerv_cli.base.limits import description
from kerv_cli.base.settings import CommandSettings

if TYPE_CHECKING:
    from rich.console import Console

    from kerv_cli.lab.database import Database
    from kerv_cli.lab.runs import Run
    from kerv_cli.training.settings import Plan

T = TypeVar("T")

ShowPlan = Annotated[bool, typer.Option("--plan", help="Print what would be done and how long it takes, and stop.")]


AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output, nothing else.")]


def end_with_json(value: object, code: int = 0) -> NoReturn:
    """Print a value as indented JSON and end the command. NaN and infinity become null."""
    typer.echo(json.dumps(_plain(value), indent=2, ensure_ascii=False))
    raise typer.Exit(code)


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "item"):  # a number of numpy
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def settings_yaml(settings: Any, indent: str = "") -> str:
    """Return settings as YAML for `--cfg`, each with its description as a comment."""
    import yaml

    lines = []
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the one in C, if PyYAML has it, is ten times faster
    for setting in fields(settings):
        value = getattr(settings, setting.name)
        if is_dataclass(value):
            lines += [f"{setting.name}:", *settings_yaml(value, "  ").splitlines()]
            continue
        # without a maximum width, so that a string without line breaks is one line
        text = yaml.dump({setting.name: value}, Dumper=dumper, width=2**30, sort_keys=False, allow_unicode=True)
        first, *rest = text.splitlines()
        comment = description(setting) if not rest or not isinstance(value, str) else ""
        lines += [f"{first}  # {comment}" if comment else first, *rest]
    return "".join(f"{indent}{line}\n" for line in lines)


def end_with_plan(text: str, as_json: bool = False) -> NoReturn:
    if as_json:
        end_with_json({"plan": text})
    typer.echo(text)
    raise typer.Exit(0)


def end_at_once() -> NoReturn:
    """End this process although threads still compute. Python's own exit would free memory that C++ code still uses."""
    sys.stdout.flush()
    os._exit(0)


@contextmanager
def one_line_errors(words: Sequence[str]) -> Iterator[None]:
    """Print an exception of the block as one line, and exit with its code. `words`: the arguments after `kerv`.

    The code is 2 if the command line cannot be parsed, 130 after Ctrl-C, and 1 for an error that is no KervError. With
    KERV_TRACEBACK=1 the exception is raised again.
    """
    try:
        yield
    except (typer.Exit, typer.Abort):
        raise
    except KervError as error:
        if isinstance(error, UsageError) and is_of_an_interrupt(error):
            _refuse("interrupted", Interrupted.exit_code, None)
        _refuse(str(error), error.exit_code, error, words)
    except typer.TyperException as error:
        if "\n" in error.format_message():  # not an error: the help, because no command was typed
            raise
        _refuse(_parse_error(error, words), error.exit_code, error)
    except KeyboardInterrupt:
        _refuse("interrupted", Interrupted.exit_code, None)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(1) from None
    except OSError as error:
        _refuse(f"{error.strerror or error}: {error.filename or ''}".rstrip(": "), 1, error)
    except Exception as error:  # noqa: BLE001 - a user never sees a traceback
        _refuse(f"internal error, {type(error).__name__}: {error}; set KERV_TRACEBACK=1 to see where", 1, error)


def _parse_error(error: Any, words: Sequence[str]) -> str:
    name, message = getattr(error, "option_name", None), " ".join(error.format_message().split())
    if name is None or not message.startswith("No such option") or getattr(error, "possibilities", None):
        return message
    setting = next((word for word in words if word.startswith(name)), name).lstrip("-")
    return f"{message.rstrip('.')}; settings have no dashes: {setting if '=' in setting else f'{setting}=VALUE'}"


def results_word(overrides: Iterable[str]) -> str:
    return "".join(f" {quoted(word)}" for word in overrides if word.startswith(("results=", "store=")))


def quoted(word: str) -> str:
    if shlex.quote(word) == word:
        return word
    # double quotes, because messages put commands in single ones
    return '"' + re.sub(r'(["$`\\])', r"\\\1", word) + '"'


def _refuse(message: str, code: int, error: BaseException | None, words: Sequence[str] = ()) -> None:
    if error is not None and os.environ.get("KERV_TRACEBACK"):
        raise error
    if code == Interrupted.exit_code:
        # half-built objects, such as a GL context, may fail to clean up: the user need not see that
        sys.unraisablehook = lambda unraisable: None
    typer.echo(f"kerv: {with_results(' '.join(message.split()), words)}", err=True)
    raise typer.Exit(code)


def with_results(message: str, words: Iterable[str]) -> str:
    """Add `results=` and `store=`, as the user typed them, to each kerv command that a message quotes without them."""
    from kerv_cli.base.registry import parts

    where = results_word(words)
    if not where:
        return message

    def complete(found: re.Match[str]) -> str:
        quote, command = found.groups()
        known = parts("command")  # only now: if a plugin cannot be imported, nothing is known
        typed = command.split()[1:]
        part = known.get(" ".join(typed[:2])) or known.get(typed[0])
        is_elsewhere = part is not None and hasattr(part.settings, "results")
        is_elsewhere = is_elsewhere and not re.search(r"\b(results|store)=", command)
        return f"{quote}{command}{where if is_elsewhere else ''}{quote}"

    return re.sub(r"(['`])(kerv [a-z].*?)\1(?!\w)", complete, message)


def database_of(settings: CommandSettings) -> Database:
    from kerv_cli.lab.database import opened  # imports SQLAlchemy, which --help and mistyped settings must not wait for

    return opened(settings.results)


@contextmanager
def made(plan: Plan[T], database: Database, show: bool = False, as_json: bool = False) -> Iterator[T]:
    """Carry out a plan, and yield its result. With `show`, only print the plan and its duration, and end."""
    from kerv_cli.lab import runs

    if show:
        time = f"about {duration(plan.seconds())}" if plan.seconds else "time unknown"
        end_with_plan(f"{plan.text}, {time} ({plan.source})", as_json)
    with runs.making(database, plan.kind, plan.folder) as run:
        yield plan.make(lambda title: progress_bar(title, run))


@contextmanager
def progress_bar(title: str, record: Run | None = None, has_estimate: bool = False) -> Iterator[Callable[..., None]]:
    """Show a progress bar while the block runs. Without a terminal, print a line after each tenth of the work.

    Yield `advance(done, total, text="")`. The progress is also written to `record`, the command's row in the database.
    With `has_estimate`, `text` says how much time is left. Otherwise the bar estimates the time.
    """
    on_terminal = sys.stderr.isatty()
    latest = -1

    def advance(done: int, total: int, text: str = "") -> None:
        nonlocal latest
        tenths = 10 * done // max(1, total)
        if record is not None:
            record.beat(done, total)
        if on_terminal:
            bar.update(task, completed=done, total=total, text=text)
        elif tenths != latest:
            latest = tenths
            typer.echo(", ".join(filter(None, (f"{title} {done}/{total}", text))), err=True)

    if not on_terminal:
        yield advance
        return
    from rich import progress as bars

    timed = [bars.BarColumn(), bars.MofNCompleteColumn(), bars.TimeElapsedColumn()]
    timed += [] if has_estimate else [bars.TimeRemainingColumn()]
    name, extra = map(partial(bars.TextColumn, markup=False), ("{task.description}", "{task.fields[text]}"))
    with bars.Progress(name, *timed, extra, console=console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None, text="")
        yield advance


def console(stderr: bool = False) -> Console:
    from rich.console import Console

    wide = None if (sys.stderr if stderr else sys.stdout).isatty() else 200
    return Console(stderr=stderr, width=wide, highlight=False)


def print_table(columns: Iterable[str], rows: Iterable[Iterable[object]], title: str | None = None) -> None:
    from rich.table import Table

    table = Table(*columns)
    for row in rows:
        table.add_row(*("–" if value is None else str(value) for value in row))
    if title:
        typer.echo(title)
    console().print(table, markup=False)  # cells may name an extra in brackets


def print_rows(rows: Sequence[Mapping[str, object]], title: str | None = None) -> None:
    print_table(rows[0], (row.values() for row in rows), title)


def print_figures(what: str, figures: Mapping[str, float], folder: object, as_json: bool = False) -> None:
    if as_json:
        end_with_json({"folder": folder, **figures})
    rows = []
    for name, value in figures.items():
        rows.append((name, f"{value:.4g}" if isinstance(value, float) else value))
    print_table((what, ""), rows)
    typer.echo(str(folder))
