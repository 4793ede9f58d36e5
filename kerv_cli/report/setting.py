"""Tables of one setting's episodes: figures by task, and time by phase."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from kerv_cli.engine.record import PHASES
from kerv_cli.episodes.identity import batch_of, stress_text
from kerv_cli.report.measures import Row, is_timed
from kerv_cli.report.tables import StudyData, is_number

_FIGURES = ("forwards_per_step", "AL", "accepted_per_round", "time_per_step_ms")


def setting_tables(data: StudyData, per_task: list[Row], whole: Row) -> Iterator[tuple[Any, Any, str]]:
    """Yield columns, rows and title of the tables of a study with one setting.

    Args:
        data: The study.
        per_task: A row per task.
        whole: The row over all tasks.
    """
    episodes, setting = data.episodes, data.study.settings[0]
    by_task = {row["task"]: row for row in per_task}
    figures = [(task, by_task[task]) for task in dict.fromkeys(episodes["task"])]
    if len(figures) > 1:
        figures.append(("all", whole))
    timed = is_timed(episodes)
    headers = ("task", "success", "steps", "forwards/step", "tokens/verification", "drafts accepted", "ms/step")
    seeds = f"{episodes['seed'].min()}…{episodes['seed'].max()}"
    observation = setting.identity.get("observation", "")
    title = f"{setting.label}, observation {observation}{stress_text(setting.settings)}, seeds {seeds}"
    if not timed:
        title += f"; not timed: {batch_of(setting.settings)} episodes at a time"
    yield headers, ((name, *_figures(row)) for name, row in figures), title
    if timed:
        decodes, total = episodes["decodes"].sum(), episodes["seconds"].sum()
        seconds = {phase: episodes[f"seconds.{phase}"].sum() for phase in PHASES}
        rows = [(name, f"{1000 * s / decodes:.2f}", f"{s / total:.0%}") for name, s in seconds.items() if s]
        yield ("phase", "ms per decode", "share"), rows, "time by phase"


def _figures(row: Row) -> list[str]:
    successes, steps = f"{row['successes']}/{row['episodes']}", f"{row['steps'] / row['episodes']:.0f}"
    return [successes, steps, *(f"{row[name]:.2f}" if is_number(row[name]) else "–" for name in _FIGURES)]
