"""Runs the episodes of a study's cell, and gauges the machine's load, in the process that the executor chose.

Weights, datastores and worlds are shared by all settings of a process. Frames and decoders are not: a setting that got
its frames from another would decode with warm caches, and a skip's level may follow the episodes of its own block.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from kerv_cli.base.settings import RolloutSettings, settings_from
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.lab.plan import Cell
from kerv_cli.lab.policy import artifacts_of
from kerv_cli.lab.run import Runner, is_recorded, run_batch
from kerv_cli.lab.together import Request

_TOKENS, _WIDTH, _LAYERS = 8, 512, 160  # of the reference decode: about 5 ms on one core, weights of one megabyte


OnStep = Callable[[Cell, int, int], None]
"""Told the cell, the seed and the number of control steps executed, after each of them."""

Save = Callable[[EpisodeRecord, Path, str, Mapping[str, float]], None]
"""Writes a recording: the record of the episode, the .rrd file, the label of the setting, and the limits that its
signals are compared with."""


@dataclass(frozen=True)
class CellRunner:
    """Prepares cells for their episodes; picklable without `on_step`.

    rollouts: folder of the .rrd files, one per recorded episode, written by `save`. keep: cells of one setting and task
    share a decoder, so that what it learns and its warm-up carry over from cell to cell. on_step: shows progress within
    an episode.
    """

    rollouts: Path
    save: Save
    keep: bool = False
    on_step: OnStep | None = None

    def __call__(self, cell: Cell) -> Callable[[int], EpisodeRecord]:
        """Builds the cell's decoder -> the function that runs the episode of a seed. Only repeat 0 is recorded."""
        settings = settings_from(cell.settings)
        runner = (
            _runner(json.dumps(cell.settings, sort_keys=True), cell.task) if self.keep else Runner(settings, cell.task)
        )

        def episode(seed: int) -> EpisodeRecord:
            if self.on_step is not None:
                runner.on_step = functools.partial(self.on_step, cell, seed)
            record = runner.episode(seed, cell.repeat == 0 and is_recorded(settings, seed))
            if record.frames:
                name = f"{cell.label.replace(' ', '_').replace('=', '')}-{record.task}-{seed}-{cell.id[:6]}.rrd"
                self.save(record, self.rollouts / name, cell.label, limits_of(settings, cell.task))
            return dataclasses.replace(record, frames={}, places={})

        return episode

    def together(self, cells: Sequence[Cell]) -> Iterator[tuple[Cell, int, EpisodeRecord | Exception]]:
        """Runs the episodes of cells whose settings differ in the task alone, `rollout.batch` at a time; yields each as
        it ends: its cell, its seed, and its record or the error that its world raised."""
        settings = settings_from(cells[0].settings)
        by_id = {cell.id: cell for cell in cells}
        requests = [Request((cell.id, seed), cell.task, seed) for cell in cells for seed in cell.seeds]
        for end in run_batch(settings, requests):
            name, seed = end.request.key
            if self.on_step is not None:
                self.on_step(by_id[name], seed, settings.world.horizon)
            yield by_id[name], seed, end.result


def limits_of(settings: RolloutSettings, task: str) -> dict[str, float]:
    """Signal of a recording -> the limit that a decision compares it with: F* of the boundary, s_min of verify-skip."""
    limits = {}
    if hasattr(settings.boundary, "f_star"):
        limits["metric"] = float(settings.boundary.f_star)
    if hasattr(settings.skip, "s_min"):
        s_min = settings.skip.s_min
        if s_min is None:
            levels = artifacts_of(settings).load("calibration").skip
            s_min = levels.tasks[task].s_min if levels is not None and task in levels.tasks else None
        if s_min is not None:
            limits["similarity"] = float(s_min)
    return limits


@functools.lru_cache(maxsize=64)
def _runner(settings: str, task: str) -> Runner:
    """The process's runner of these settings (JSON) on a task."""
    return Runner(settings_from(json.loads(settings)), task)


def reference_decode(device: str) -> float:
    """Seconds of a fixed workload like a decode, a chain of products of few tokens with one matrix. It never changes,
    so that a change of its time is one of the machine's load or clock."""
    x, weights = _reference(device)
    begin = time.perf_counter()
    _chain(x, weights)
    return time.perf_counter() - begin


def _chain(x: Tensor, weights: Tensor) -> float:
    for _ in range(_LAYERS):
        x = torch.tanh(x @ weights)
    return float(x[0, 0])  # waits for the device


@functools.cache
def _reference(device: str) -> tuple[Tensor, Tensor]:
    """Operands (tokens, width) and (width, width), after a first run that allocates and chooses kernels."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(_TOKENS, _WIDTH, generator=generator).to(device)
    weights = (torch.randn(_WIDTH, _WIDTH, generator=generator) / _WIDTH**0.5).to(device)
    _chain(x, weights)
    return x, weights
