"""A cell's parquet tables: records of episodes and decodes as rows, and the rows as data frames."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from kerv_cli.base.errors import CheckpointError
from kerv_cli.engine.record import PHASES, DecodeRecord, EpisodeRecord, Round

_PHASE_FIELDS = [(f"seconds.{phase}", pa.float64()) for phase in PHASES]

EPISODE_SCHEMA = pa.schema(
    [
        ("task", pa.string()),
        ("seed", pa.int64()),
        ("success", pa.bool_()),
        ("steps", pa.int64()),  # control steps executed
        ("decodes", pa.int64()),
        ("seconds", pa.float64()),  # inference time
        *_PHASE_FIELDS,
        ("forwards", pa.int64()),
        ("verifications", pa.int64()),
        ("tokens", pa.int64()),  # committed, by whatever round
        ("committed", pa.int64()),  # committed by verifications, bonus included
        ("accepted", pa.int64()),  # draft tokens accepted by verifications
        ("bonus", pa.int64()),
        ("first_rejected_sum", pa.int64()),  # over chunks that had a verification
        ("first_rejected_count", pa.int64()),
        ("compensated_tokens", pa.int64()),
        ("compensated_decodes", pa.int64()),
        ("skipped_decodes", pa.int64()),
        ("unverified_tokens", pa.int64()),  # executed without a target token on their accepted path
        ("executed_tokens", pa.int64()),  # numbers handed over for execution: steps times DoFs
        ("retrieval_decodes", pa.int64()),
        ("deviation_sum", pa.float64()),  # normalised action units, over sampled decodes
        ("deviation_count", pa.int64()),
        ("delay_decodes", pa.int64()),  # decodes during which the world went on
        ("delay_seconds", pa.float64()),  # of those: latency that the world felt
        ("delay_steps", pa.int64()),  # the same in control steps
        ("carried_steps", pa.int64()),  # control steps during decodes that executed the chunk before
        ("held_steps", pa.int64()),  # … that held the last action
        ("dropped_steps", pa.int64()),  # actions of new chunks that were left out as stale
        ("path_length", pa.float64()),  # of the end effector, metres
        ("jerk", pa.float64()),  # of the end effector, root mean square, m/s³
        ("gripper_switches", pa.int64()),
        ("wall_seconds", pa.float64()),
        ("initial_state", pa.list_(pa.float64())),
        ("repeat", pa.int64()),
        ("block", pa.string()),  # which run of which block; empty where it is not known
        ("order", pa.int64()),  # episodes that the block ran before it
        ("started", pa.string()),  # ISO 8601
        ("gauge_seconds", pa.float64()),  # of the reference decode just before the episode: the machine's load
        ("worker_pid", pa.int64()),
    ]
)

_TOKENS = pa.list_(pa.int32())
_ROUND = pa.struct(
    [
        ("mode", pa.string()),
        ("proposer", pa.string()),
        ("start", pa.int32()),
        ("drafted", _TOKENS),
        ("target_tokens", _TOKENS),
        ("accepted", pa.int32()),
        ("committed", pa.int32()),
        ("tree_size", pa.int32()),
        ("threshold", _TOKENS),
    ]
)
_OF_DELAY = ("observed", "carried", "held", "dropped", "predicted")  # fields of Delay
_MEASURES = ("variability", "similarity", "metric", "deviation")
_MOTION = ("path_length", "jerk", "gripper_switches")
_OF_EPISODE = ("task", "seed", "success", "steps", "seconds", "forwards", "wall_seconds", *_MOTION)  # of EpisodeRecord
_COUNTS = ("compensated", "looks", "abandoned")
_OF_DECODE = ("mode", "forwards", "seconds", "skipped", "reason", *_COUNTS, *_MEASURES)  # fields of DecodeRecord

DECODE_SCHEMA = pa.schema(
    [
        ("task", pa.string()),
        ("seed", pa.int64()),
        ("index", pa.int64()),  # decode of the episode
        ("step", pa.int64()),  # control step at which its actions begin
        ("mode", pa.string()),
        ("forwards", pa.int64()),
        ("seconds", pa.float64()),
        *_PHASE_FIELDS,
        ("tokens", _TOKENS),
        ("actions", pa.list_(pa.list_(pa.float32()))),  # (steps, D)
        ("rounds", pa.list_(_ROUND)),
        ("compensated", pa.int64()),
        ("skipped", pa.bool_()),
        ("looks", pa.int64()),  # at the world while it was executed
        ("abandoned", pa.int64()),  # control steps that were given up after the last look
        *[(name, pa.float64()) for name in _MEASURES],
        ("reason", pa.string()),  # of a skip rule: trusted, streak; null without one that says so
        ("delay_seconds", pa.float64()),  # these: null where the world waited
        ("delay_steps", pa.int64()),
        *[(name, pa.int64()) for name in _OF_DELAY],
    ]
)
_DECODE_TIMES = pa.schema([DECODE_SCHEMA.field(name) for name in ("seed", "seconds")])


@dataclass(frozen=True)
class Circumstances:
    """When and in which block an episode ran, and how loaded the machine was: columns of episodes.parquet."""

    block: str = ""
    order: int = 0
    started: str = ""
    gauge_seconds: float = math.nan


def episode_row(record: EpisodeRecord, at: Circumstances, repeat: int = 0) -> dict[str, Any]:
    """One row of episodes.parquet.

    Raises:
        ValueError: a decode names a phase that is not in PHASES.
    """
    decodes = record.decodes
    judged = [r for d in decodes for r in d.rounds if r.is_verification]
    first = [d.first_rejected for d in decodes if d.first_rejected is not None]
    deviations = [d.deviation for d in decodes if d.deviation is not None]
    accepted, committed = sum(r.accepted for r in judged), sum(r.committed for r in judged)
    phases = [_phase_seconds(d) for d in decodes]
    return {
        **{name: getattr(record, name) for name in _OF_EPISODE},
        "decodes": len(decodes),
        **{name: sum(p[name] or 0.0 for p in phases) for name, _ in _PHASE_FIELDS},
        "verifications": len(judged),
        "tokens": sum(len(d.tokens) for d in decodes),
        "committed": committed,
        "accepted": accepted,
        "bonus": committed - accepted,
        "first_rejected_sum": sum(first),
        "first_rejected_count": len(first),
        "compensated_tokens": sum(d.compensated for d in decodes),
        "compensated_decodes": sum(d.compensated > 0 for d in decodes),
        "skipped_decodes": sum(d.skipped for d in decodes),
        "unverified_tokens": sum(d.unverified for d in decodes),
        "executed_tokens": sum(int(d.actions.size) for d in decodes),
        "retrieval_decodes": sum(any(r.proposer == "retrieval" for r in d.rounds) for d in decodes),
        "deviation_sum": float(sum(deviations)),
        "deviation_count": len(deviations),
        **_delay_sums(record),
        "initial_state": np.asarray(record.initial_state, dtype=np.float64).ravel().tolist(),
        "repeat": repeat,
        **asdict(at),
        "worker_pid": os.getpid(),
    }


def _delay_sums(record: EpisodeRecord) -> dict[str, float]:
    delays = [d.delay for d in record.decodes if d.delay is not None]
    return {
        "delay_decodes": len(delays),
        "delay_seconds": float(sum(d.seconds for d in delays)),
        "delay_steps": sum(d.steps for d in delays),
        "carried_steps": sum(d.carried for d in delays),
        "held_steps": sum(d.held for d in delays),
        "dropped_steps": sum(d.dropped for d in delays),
    }


def _phase_seconds(decode: DecodeRecord) -> dict[str, float | None]:
    unknown = set(decode.phases) - set(PHASES)
    if unknown:
        raise ValueError(f"phases {sorted(unknown)} are not in PHASES")
    return {f"seconds.{phase}": decode.phases.get(phase) for phase in PHASES}


def decode_rows(record: EpisodeRecord) -> list[dict[str, Any]]:
    """The rows of decodes.parquet of one episode, in order."""
    return [
        {
            "task": record.task,
            "seed": record.seed,
            "index": index,
            "step": step,
            **{name: getattr(decode, name) for name in _OF_DECODE},
            **_phase_seconds(decode),
            "tokens": list(decode.tokens),
            "actions": np.asarray(decode.actions, dtype=np.float32).tolist(),
            "rounds": [_round_row(r) for r in decode.rounds],
            "delay_seconds": None if decode.delay is None else decode.delay.seconds,
            "delay_steps": decode.delay_steps,
            **{name: getattr(decode.delay, name, None) for name in _OF_DELAY},
        }
        for index, (decode, step) in enumerate(zip(record.decodes, record.decode_steps, strict=True))
    ]


def _round_row(r: Round) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(r).items()}


def parquet_bytes(rows: Sequence[Mapping[str, Any]], schema: pa.Schema) -> bytes:
    """Rows as the bytes of a parquet file; the store writes them.

    Raises:
        ValueError: a row has a column that the schema does not know.
    """
    for row in rows:
        if unknown := set(row) - set(schema.names):
            raise ValueError(f"columns {sorted(unknown)} are not in the schema")
    return table_bytes(pa.Table.from_pylist(list(rows), schema=schema))


def table_bytes(table: pa.Table) -> bytes:
    """A table as the bytes of a parquet file."""
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def tables_of(records: Sequence[EpisodeRecord], at: Sequence[Circumstances], repeat: int) -> dict[str, bytes]:
    """A cell's tables: name of the file -> its bytes. at: circumstances of each record."""
    episodes = [episode_row(record, one, repeat) for record, one in zip(records, at, strict=True)]
    decodes = [row for record in records for row in decode_rows(record)]
    return {
        "episodes.parquet": parquet_bytes(episodes, EPISODE_SCHEMA),
        "decodes.parquet": parquet_bytes(decodes, DECODE_SCHEMA),
    }


class CellTables(NamedTuple):
    """What a report needs of a cell's tables. seconds: seed -> (decodes,) seconds."""

    folder: Path
    episodes: pa.Table
    seconds: dict[int, np.ndarray]


def read_tables(folder: Path) -> CellTables:
    """The tables in a cell's folder.

    Raises:
        OSError, ValueError, ArrowException: they are not what a kerv wrote.
    """
    episodes = _with_columns(_parquet(folder / "episodes.parquet"), EPISODE_SCHEMA)
    decodes = _with_columns(_parquet(folder / "decodes.parquet", _DECODE_TIMES.names), _DECODE_TIMES)
    return CellTables(folder, episodes, _split_by_seed(decodes))


def frames_of(cells: Sequence[CellTables]) -> list[pd.DataFrame]:
    """The episodes of each cell, one row each, with the column decode_seconds; converted all at once.

    Raises:
        CheckpointError: an episode has no decodes.
    """
    whole = pa.concat_tables([cell.episodes for cell in cells], promote_options="default").to_pandas()
    try:
        whole["decode_seconds"] = [cell.seconds[s] for cell in cells for s in cell.episodes["seed"].to_pylist()]
    except KeyError as error:
        raise CheckpointError(f"a cell in {cells[0].folder.parent} has no decodes of seed {error}") from error
    stops = np.cumsum([cell.episodes.num_rows for cell in cells]).tolist()
    return [whole.iloc[stop - cell.episodes.num_rows : stop] for cell, stop in zip(cells, stops, strict=True)]


def _parquet(path: Path, columns: list[str] | None = None) -> pa.Table:
    """Those columns of a parquet file, or all of them."""
    # without pyarrow's dataset machinery, which costs several times the reading of so small a file
    return pq.ParquetFile(path).read(columns=columns, use_threads=False)


def _with_columns(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """The columns of `schema` first, then those that only the table has. A column that an older table lacks is empty.

    Raises:
        ValueError: a column of another type.
    """
    if table.schema.equals(schema):
        return table
    present, names = set(table.column_names), list(schema.names)
    for field in (field for field in schema if field.name not in present):
        table = table.append_column(field, pa.nulls(table.num_rows, field.type))
    further = [name for name in table.column_names if name not in set(names)]
    table = table.select([*names, *further])
    return table.cast(pa.schema([*schema, *(table.schema.field(name) for name in further)]))


def _split_by_seed(decodes: pa.Table) -> dict[int, np.ndarray]:
    """Seed -> seconds of its decodes, in order; the decodes of an episode stand together."""
    seeds, seconds = (decodes[name].to_numpy() for name in ("seed", "seconds"))
    starts = np.flatnonzero(np.diff(seeds, prepend=-1))
    return dict(zip(seeds[starts].tolist(), np.split(seconds, starts[1:]), strict=True))
