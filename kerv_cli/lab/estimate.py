"""How long a plan will take, from the study's stored episodes."""

from __future__ import annotations

from dataclasses import dataclass

from kerv_cli.lab.plan import Cell, blocks_of
from kerv_cli.lab.reuse import Covered
from kerv_cli.lab.store import StudyStore


@dataclass(frozen=True)
class TimeEstimate:
    """Time for the cells of a plan that are not complete."""

    seconds: float  # wall time
    to_run: int  # cells
    reused: int
    source: str  # of the figure, in words


def estimate(covered: Covered, store: StudyStore, workers: int, prior_seconds: float) -> TimeEstimate:
    """Time for the cells that are to run, from the mean wall seconds per episode of the plan's other cells.

    A label with complete cells uses its own mean, others the mean over all; `prior_seconds` per episode is the guess
    where nothing is complete. Workers are taken to scale perfectly, up to one per block.

    Raises:
        CheckpointError: a complete cell cannot be read.
    """
    every_cell = [cell for block in blocks_of(covered.cells) for cell in block.cells]
    seconds: dict[str, float] = {}
    episodes: dict[str, int] = {}
    todo: list[Cell] = []
    for cell in every_cell:
        if cell.id not in covered.reasons:
            _, status = covered.sources.get(cell.id, store).described(cell.id)
            seconds[cell.label] = seconds.get(cell.label, 0.0) + status["wall_seconds"]
            episodes[cell.label] = episodes.get(cell.label, 0) + status["episodes"]
        else:
            todo.append(cell)
    stored = sum(episodes.values())
    prior = sum(seconds.values()) / stored if stored else prior_seconds
    means = {label: seconds[label] / count for label, count in episodes.items()}
    total = sum(len(cell.seeds) * means.get(cell.label, prior) for cell in todo)
    source = f"measured on {stored} stored episodes" if stored else f"a guess of {prior_seconds:g} s per episode"
    at_once = max(1, min(workers, len(blocks_of(todo, workers))))
    return TimeEstimate(total / at_once, len(todo), len(every_cell) - len(todo), source)
