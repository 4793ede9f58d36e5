"""Runs cells for a command, with progress, recordings and an answer to Ctrl-C."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from kerv_cli.base.errors import Interrupted, KervError
from kerv_cli.base.settings import RuntimeSettings
from kerv_cli.cli.common import console
from kerv_cli.cli.progress import ProgressDisplay
from kerv_cli.lab.events import CellEnd, Event, Outcome
from kerv_cli.lab.execute import execute
from kerv_cli.lab.plan import Cell
from kerv_cli.lab.run import CellRunner, close_worlds
from kerv_cli.lab.store import STUDIES, StudyStore
from kerv_cli.report.viewing import save_recording


@contextmanager
def running(
    store: StudyStore, cells: Sequence[Cell], runtime: RuntimeSettings
) -> Iterator[Callable[[Sequence[Cell]], Outcome]]:
    """Yields the function that runs those of its cells that are not complete. The cells of a rollout share a decoder,
    and the first failure ends it.

    Raises:
        Interrupted: Ctrl-C. KervError: a rollout's episode failed. StorageError: the disk refused.
    """
    is_study = store.family == STUDIES
    with ProgressDisplay(console(stderr=True)) as display:

        def on_event(event: Event) -> None:
            if isinstance(event, CellEnd) and event.reason and not is_study:
                raise event.error or KervError(event.reason)
            display(event)

        on_step = display.on_step if runtime.executor == "local" and runtime.workers == 1 else None
        runner = CellRunner(store.rollouts, save_recording, keep=not is_study, on_step=on_step)
        try:
            yield lambda part: execute(part, runner, store, runtime, on_event)
        except KeyboardInterrupt:
            count, what = sum(store.has_cell(cell.id) for cell in cells), "cells" if is_study else "episodes"
            raise Interrupted(
                f"interrupted: {count} of {len(cells)} {what} are kept in {store.root}, the same command goes on there"
            ) from None
        finally:
            close_worlds()
