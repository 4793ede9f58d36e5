"""A sweep's cell -> its episodes. Runs in whatever process the executor chose."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from kerv_cli.decoding.record import EpisodeRecord
from kerv_cli.rollouts.run import run_task
from kerv_cli.settings import RolloutSettings


class CellLike(Protocol):
    """What of a study's cell an episode needs; studies lie above rollouts."""

    @property
    def id(self) -> str: ...
    @property
    def label(self) -> str: ...
    @property
    def task(self) -> str: ...
    @property
    def seeds(self) -> tuple[int, ...]: ...
    @property
    def settings(self) -> dict[str, Any]: ...


@dataclass(frozen=True)
class CellRunner:
    """Picklable. rollouts: folder of the .rrd files, one per recorded episode."""

    rollouts: Path

    def __call__(self, cell: CellLike) -> list[EpisodeRecord]:
        from kerv_cli.viewing.rerun_log import save_episode  # rerun is needed only where an episode is drawn

        settings = settings_from(cell.settings)
        records = []
        for record in run_task(settings, cell.task, cell.seeds):
            if record.frames:
                name = f"{cell.label.replace(' ', '_').replace('=', '')}-{record.task}-{record.seed}-{cell.id[:6]}.rrd"
                save_episode(record, self.rollouts / name, method=cell.label)
            records.append(dataclasses.replace(record, frames={}))
        return records


def settings_from(plain: Mapping[str, Any]) -> RolloutSettings:
    """The inverse of `as_plain`."""
    return _fill(RolloutSettings, plain)


def _fill(kind: type, plain: Mapping[str, Any]) -> Any:
    defaults = kind()
    values = {}
    for field in dataclasses.fields(kind):
        value = plain[field.name]
        default = getattr(defaults, field.name)
        values[field.name] = _fill(type(default), value) if dataclasses.is_dataclass(default) else value
    return kind(**values)
