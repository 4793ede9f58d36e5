"""What every command shares: turning errors into one line, override arguments and their completion, progress bars,
tables."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any, ParamSpec, TypeVar

import typer

from kerv_cli.errors import KervError

P = ParamSpec("P")
T = TypeVar("T")


def complete_overrides(incomplete: str) -> list[str]:
    """Completions of an override: `method=` -> every method; without `=`, the groups. Imports nothing heavy."""
    from kerv_cli.config import groups

    known, (group, equals, _) = groups(), incomplete.partition("=")
    if not equals:
        words = [f"{name}=" for name in [*known, "task", "results"]]
    elif group == "task":
        from kerv_cli.environments import task_names

        words = [f"task={name}" for name in task_names()]
    else:
        words = [f"{group}={name}" for name in known.get(group, [])]
    return [word for word in words if word.startswith(incomplete)]


Overrides = Annotated[
    list[str] | None,
    typer.Argument(help="Settings as key=value; see --cfg for all of them.", autocompletion=complete_overrides),
]
ShowConfig = Annotated[bool, typer.Option("--cfg", help="Print the resolved settings and stop.")]
ShowPlan = Annotated[bool, typer.Option("--plan", help="Print what would be done and how long it takes, and stop.")]


def composed(command: str, overrides: list[str] | None, schema: type[T], cfg: bool) -> T:
    """The command's settings. With --cfg they are printed and the command ends.

    Raises:
        UsageError: as `config.compose`.
    """
    from kerv_cli.config import compose, to_yaml

    settings = compose(command, overrides or [], schema)
    if cfg:
        typer.echo(to_yaml(settings), nl=False)
        raise typer.Exit(0)
    return settings


def print_notes(idle: Mapping[str, str]) -> None:
    """Prints a line on stderr for each override that has no effect. idle: override -> why."""
    for override, reason in idle.items():
        typer.echo(f"note: {override} has no effect: {reason}", err=True)


def print_plan(text: str) -> None:
    """Prints what would be done, for --plan; the command ends."""
    typer.echo(text)
    raise typer.Exit(0)


def edge(command: Callable[P, None]) -> Callable[P, None]:
    """Decorates a command: every exception is printed as one line and becomes an exit code (a KervError's own; 1 for
    others; 130 for Ctrl-C). KERV_TRACEBACK=1 raises it instead."""

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except typer.Exit:
            raise
        except KervError as error:
            _refuse(str(error), error.exit_code, error)
        except KeyboardInterrupt:
            _refuse("interrupted; what was finished is kept, the same command goes on from there", 130, None)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except OSError as error:
            _refuse(f"{error.strerror or error}: {error.filename or ''}".rstrip(": "), 1, error)
        except Exception as error:  # noqa: BLE001 - the edge: whatever it is, the user gets one line
            _refuse(f"internal error, {type(error).__name__}: {error}; set KERV_TRACEBACK=1 to see where", 1, error)

    return wrapped


def _refuse(message: str, code: int, error: BaseException | None) -> None:
    if error is not None and os.environ.get("KERV_TRACEBACK"):
        raise error
    typer.echo(f"kerv: {' '.join(message.split())}", err=True)
    raise typer.Exit(code)


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[..., None]]:
    """Yields `advance(done, total, text="")`: a progress bar on a terminal, elsewhere at most 10 lines (50 for totals
    from 2000 on)."""
    if not sys.stderr.isatty():
        yield _plain_lines(title)
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    timed = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    texts = (TextColumn(f"{{task.{name}}}") for name in ("description", "fields[text]"))
    with Progress(next(texts), *timed, next(texts), console=console(stderr=True)) as bar:
        task = bar.add_task(title, total=None, text="")
        yield lambda done, total, text="": bar.update(task, completed=done, total=total, text=text)


def _plain_lines(title: str) -> Callable[..., None]:
    shown = -1

    def advance(done: int, total: int, text: str = "") -> None:
        nonlocal shown
        part = (50 if total >= 2000 else 10) * done // max(1, total)
        if part > shown:
            shown = part
            typer.echo(f"{title} {done}/{total} {text}".rstrip(), err=True)

    return advance


def called() -> str:
    """The command to show in hints: `kerv` where the shell finds it, else the path of this script."""
    import shutil

    return "kerv" if shutil.which("kerv") or not sys.argv[0].endswith("kerv") else os.path.relpath(sys.argv[0])


def console(stderr: bool = False) -> Any:
    """A rich console; 200 columns wide where the output is no terminal."""
    from rich.console import Console

    wide = None if (sys.stderr if stderr else sys.stdout).isatty() else 200
    return Console(stderr=stderr, width=wide, highlight=False)


def print_table(columns: Iterable[str], rows: Iterable[Iterable[object]], title: str | None = None) -> None:
    """Prints a table; columns: its header."""
    from rich.table import Table

    table = Table(*columns, title=title)
    for row in rows:
        table.add_row(*map(str, row))
    console().print(table)


def print_figures(what: str, figures: dict[str, float], folder: object) -> None:
    """Prints named numbers, four digits of each, and the folder of what they belong to."""
    rows = ((name, f"{value:.4g}" if isinstance(value, float) else value) for name, value in figures.items())
    print_table((what, str(folder)), rows)
