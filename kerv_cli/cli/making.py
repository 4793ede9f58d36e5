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
    """Make an artifact in a `with` block. At its end the database notes how the work ended.

    Args:
        database: The database of the results folder.
        plan: Print what would be made, and how long it takes, and end the command.
        as_json: Print the plan as JSON.

    Yields:
        Function that the work calls once its settings are checked. It starts the entry in the database, or prints the
        plan.
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
