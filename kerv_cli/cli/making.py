"""How a command makes an artifact: `--plan`, its row in the database, progress bars."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from kerv_cli.cli.common import end_with_plan, progress_bar

if TYPE_CHECKING:
    from kerv_cli.lab.database import Database
    from kerv_cli.training.making import Begin, Stage


@contextmanager
def as_planned(database: Database, plan: bool = False, as_json: bool = False) -> Iterator[Begin]:
    """Open a `with` block in which an artifact is made. At the end of the block, store in the database how it ended.

    Args:
        database: The database of the results folder.
        plan: Print what would be made, and how long it takes, and end the command.
        as_json: Print the plan as JSON.

    Yields:
        A function that the code in the block calls once the settings are checked. It writes the command's row in the
        database. With `plan` it prints the plan instead.
    """
    from kerv_cli.lab import runs
    from kerv_cli.lab.command import current_command

    with ExitStack() as stack:

        def begin(kind: str, folder: Path, what: str, units: int) -> Stage:
            if plan:
                end_with_plan(f"{what}, {runs.time_of(database, kind, current_command(), units)}", as_json)
            run = stack.enter_context(runs.making(database, kind, folder))
            return lambda title: progress_bar(title, run)

        yield begin
