"""`kerv bench replay` as a whole: recorded decodes, executed and predicted, as tables and files."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.table import Table

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import atomic_path, write_json
from kerv_cli.base.provenance import stamp
from kerv_cli.base.settings import BenchReplaySettings
from kerv_cli.bench.machine import Machine
from kerv_cli.bench.model import Model
from kerv_cli.bench.phases import Phase, measure
from kerv_cli.bench.profile import profile_of, projected
from kerv_cli.bench.replay import Player, play_all
from kerv_cli.bench.run import open_and_card, place_of
from kerv_cli.bench.sequences import Recorded, read_study
from kerv_cli.engine.cost import Profile, predicted, read_profile
from kerv_cli.lab.store import StudyStore

_RESAMPLES = 2000
_PER_LAYER = 15e-6  # seconds per layer and forward below which projections do not go: kernels of a captured graph


@dataclass(frozen=True)
class Row:
    """One setting at one N. seconds: mean per decode, executed; host: the recorded part of them. low, high: 95 %
    bootstrap interval of the speedup. model: the speedup that the cost model predicts. projections: device -> predicted
    speedup there, from its published figures or from its own profile."""

    tokens: int
    label: str
    success: float
    forwards: float
    seconds: float
    host: float
    speedup: float
    low: float
    high: float
    model: float
    projections: dict[str, float]


@dataclass(frozen=True)
class Replay:
    """The result of a replay. study: whose decodes."""

    study: str
    model: Model
    machine: Machine
    rows: list[Row]

    @property
    def dtype(self) -> str:
        """Number format of the trunk."""
        return str(self.model.dtype).removeprefix("torch.")

    @property
    def about(self) -> dict[str, Any]:
        """Study, target, device and versions."""
        device = str(self.model.target.device)
        return {
            "study": self.study,
            "target": self.model.name,
            "random_weights": self.model.is_shape,
            "dtype": self.dtype,
            "device": device,
            "threads": torch.get_num_threads(),
            "bandwidth": self.machine.bandwidth,
            **stamp(device),
        }

    def tables(self) -> list[Table]:
        """One rich table per N."""
        tables = []
        for tokens in dict.fromkeys(row.tokens for row in self.rows):
            rows = [row for row in self.rows if row.tokens == tokens]
            names = list(rows[0].projections)
            title = f"decodes of study={self.study}, executed on {self.model.name} ({self.dtype}): N = {tokens}"
            caption = "success and acceptance: the study's; times: executed here; model, projections: predicted"
            columns = ("setting", "success %", "forwards", "ms / decode", "host ms", "speedup", "model", *names)
            table = Table(*columns, title=title, caption=caption)
            for row in rows:
                speedup = f"{row.speedup:.2f} ({row.low:.2f}–{row.high:.2f})"
                cells = (
                    row.label,
                    f"{100 * row.success:.1f}",
                    f"{row.forwards:.2f}",
                    f"{1e3 * row.seconds:.1f}",
                    f"{1e3 * row.host:.2f}",
                    speedup,
                )
                table.add_row(*cells, f"{row.model:.2f}", *(f"{row.projections[name]:.2f}" for name in names))
            tables.append(table)
        return tables

    def document(self) -> dict[str, Any]:
        """For JSON."""
        return {**self.about, "rows": [vars(row) for row in self.rows]}

    def write(self, results: str) -> list[Path]:
        """Writes the document and its table as CSV -> their paths."""
        base = place_of(results, self.model.name, self.dtype, f"-replay-{self.study}.json")
        write_json(base, self.document())
        table = base.with_suffix(".csv")
        names = list(self.rows[0].projections)
        with atomic_path(table) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            fixed = [name for name in vars(self.rows[0]) if name != "projections"]
            writer.writerow([*fixed, *(f"projection.{name}" for name in names), *self.about])
            for row in self.rows:
                values = [getattr(row, name) for name in fixed] + [row.projections[name] for name in names]
                figures = [f"{value:.6g}" if isinstance(value, float) else value for value in values]
                writer.writerow([*figures, *self.about.values()])
        return [base, table]


def replay(settings: BenchReplaySettings) -> Replay:
    """Executes the study's decodes at every N of the settings.

    Raises:
        UsageError: a number out of range, no such study, chunks shorter than N, too little memory for the shape.
        CheckpointError: a damaged cell or policy.
    """
    for name, figures in settings.projections.items():
        if len(figures) != 2 or min(figures) <= 0:
            raise UsageError(f"projections.{name}={figures}: two numbers above 0, GB/s and TFLOP/s")
    measured = {name: read_profile(Path(path)) for name, path in settings.profiles.items()}
    store = StudyStore(settings.results, settings.recorded)
    by_tokens = {n: read_study(store, n, settings.decodes) for n in settings.tokens}
    model, machine, _, _ = open_and_card(settings)
    machine, phases = measure(model, machine, settings.tokens, settings.drafter_depth, settings.repeats)
    rows = []
    for tokens, recorded in by_tokens.items():
        seconds = play_all(Player(model, recorded), recorded)
        rows += _rows(tokens, recorded, seconds, model, machine, phases, settings, measured)
    return Replay(settings.recorded, model, machine, rows)


def _rows(
    tokens: int,
    recorded: Sequence[Recorded],
    seconds: np.ndarray,
    model: Model,
    machine: Machine,
    phases: Sequence[Phase],
    settings: BenchReplaySettings,
    measured: Mapping[str, Profile],
) -> list[Row]:
    prompt, layers = model.target.max_prompt, model.target.settings.layers
    here = profile_of(prompt, phases)
    there = {
        name: profile_of(prompt, projected(phases, machine, Machine(gb * 1e9, tf * 1e12), layers * _PER_LAYER))
        for name, (gb, tf) in settings.projections.items()
    }
    there |= measured
    rows = []
    for index, setting in enumerate(recorded):
        low, high = _interval(seconds[0], seconds[index])
        rows.append(
            Row(
                tokens=tokens,
                label=setting.label,
                success=setting.successes / setting.episodes,
                forwards=float(np.mean([len(s.forwards) for s in setting.sequences])),
                seconds=float(seconds[index].mean()),
                host=float(np.mean([s.host for s in setting.sequences])),
                speedup=float(seconds[0].sum() / seconds[index].sum()),
                low=low,
                high=high,
                model=_predicted_speedup(recorded[0], setting, here),
                projections={
                    name: _predicted_speedup(recorded[0], setting, profile) for name, profile in there.items()
                },
            )
        )
    return rows


def _predicted_speedup(baseline: Recorded, setting: Recorded, profile: Profile) -> float:
    means = [np.mean([predicted(s, profile) for s in r.sequences]) for r in (baseline, setting)]
    return float(means[0] / means[1])


def _interval(baseline: np.ndarray, method: np.ndarray) -> tuple[float, float]:
    """95 % bootstrap interval of the ratio of mean times, resampling turns."""
    turns = np.random.default_rng(0).integers(0, len(method), (_RESAMPLES, len(method)))
    ratios = baseline[turns].sum(1) / method[turns].sum(1)
    low, high = np.percentile(ratios, [2.5, 97.5])
    return float(low), float(high)
