"""A cell's parquet tables: records of episodes and decodes as rows, and the rows as data frames."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_table
from kerv_cli.engine.record import PHASES, DecodeRecord, Delay, EpisodeRecord, Round

INT, FLOAT, TEXT, FLAG = pa.int64(), pa.float64(), pa.string(), pa.bool_()
Fields = dict[str, tuple[pa.DataType, Callable[..., Any]]]
"""Column -> its type, and its value: of an episode's record, or of a decode's."""


def _summed(value: Callable[[DecodeRecord], Any]) -> Callable[[EpisodeRecord], Any]:
    """The sum over an episode's decodes; None counts as 0."""
    return lambda episode: sum(value(decode) or 0 for decode in episode.decodes)


def _judged(value: Callable[[Round], int]) -> Callable[[EpisodeRecord], int]:
    """The sum over an episode's verifications."""
    return _summed(lambda decode: sum(value(one) for one in decode.rounds if one.is_verification))


def _delays(value: Callable[[Delay], Any]) -> Callable[[EpisodeRecord], Any]:
    """The sum over the decodes during which the world went on."""
    return _summed(lambda decode: 0 if decode.delay is None else value(decode.delay))


def _phase(phase: str) -> Callable[[DecodeRecord], float | None]:
    return lambda decode: decode.phases.get(phase)


def _attributes(*names: str, kind: pa.DataType = INT) -> Fields:
    """Columns that are attributes of the record."""
    return {name: (kind, attrgetter(name)) for name in names}


_EPISODE: Fields = {
    **_attributes("task", kind=TEXT),
    **_attributes("seed"),
    **_attributes("success", kind=FLAG),
    **_attributes("steps"),  # control steps executed
    "decodes": (INT, lambda episode: len(episode.decodes)),
    **_attributes("seconds", kind=FLOAT),  # inference time
    **{f"seconds.{phase}": (FLOAT, _summed(_phase(phase))) for phase in PHASES},
    **_attributes("forwards"),
    "verifications": (INT, _judged(lambda one: 1)),
    "tokens": (INT, _summed(lambda decode: len(decode.tokens))),  # committed, by whatever round
    "committed": (INT, _judged(lambda one: one.committed)),  # by verifications, bonus included
    "accepted": (INT, _judged(lambda one: one.accepted)),  # draft tokens, by verifications
    "first_rejected_sum": (INT, _summed(lambda decode: decode.first_rejected)),  # over chunks that had a verification
    "first_rejected_count": (INT, _summed(lambda decode: decode.first_rejected is not None)),
    "compensated_tokens": (INT, _summed(lambda decode: decode.compensated)),
    "compensated_decodes": (INT, _summed(lambda decode: decode.compensated > 0)),
    "skipped_decodes": (INT, _summed(lambda decode: decode.skipped)),
    "unverified_tokens": (INT, _summed(lambda decode: decode.unverified)),  # executed without a target token
    "executed_tokens": (INT, _summed(lambda decode: int(decode.actions.size))),  # steps times DoFs handed over
    "retrieval_decodes": (INT, _summed(lambda decode: any(r.proposer == "retrieval" for r in decode.rounds))),
    "deviation_sum": (FLOAT, _summed(lambda decode: decode.deviation)),  # normalised action units, over sampled decodes
    "deviation_count": (INT, _summed(lambda decode: decode.deviation is not None)),
    "delay_decodes": (INT, _delays(lambda delay: 1)),  # decodes during which the world went on
    "delay_seconds": (FLOAT, _delays(lambda delay: delay.seconds)),  # of those: latency that the world felt
    "delay_steps": (INT, _delays(lambda delay: delay.steps)),  # the same in control steps
    "carried_steps": (INT, _delays(lambda delay: delay.carried)),  # of those: on the chunk before
    "held_steps": (INT, _delays(lambda delay: delay.held)),  # … on the last action
    "dropped_steps": (INT, _delays(lambda delay: delay.dropped)),  # actions of new chunks left out as stale
    **_attributes("path_length", kind=FLOAT),  # of the end effector, metres
    **_attributes("wall_seconds", kind=FLOAT),
    "initial_state": (pa.list_(FLOAT), lambda episode: np.asarray(episode.initial_state, np.float64).ravel().tolist()),
}
_CIRCUMSTANCES = {
    "repeat": INT,
    "block": TEXT,  # which run of which block; empty where it is not known
    "order": INT,  # episodes that the block ran before it
    "started": TEXT,  # ISO 8601
    "worker_pid": INT,
}
EPISODE_SCHEMA = pa.schema({**{name: kind for name, (kind, _) in _EPISODE.items()}, **_CIRCUMSTANCES}.items())

_TOKENS = pa.list_(pa.int32())
_COUNTS = ("start", "accepted", "committed", "tree_size")
_ROUND = pa.struct(
    [
        (field.name, TEXT if field.name in ("mode", "proposer") else pa.int32() if field.name in _COUNTS else _TOKENS)
        for field in fields(Round)
    ]
)


def _delay(name: str) -> Callable[[DecodeRecord], Any]:
    return lambda decode: getattr(decode.delay, name, None)


_DECODE: Fields = {
    **_attributes("mode", kind=TEXT),
    **_attributes("forwards"),
    **_attributes("seconds", kind=FLOAT),
    **{f"seconds.{phase}": (FLOAT, _phase(phase)) for phase in PHASES},
    "tokens": (_TOKENS, lambda decode: list(decode.tokens)),
    "actions": (pa.list_(pa.list_(pa.float32())), lambda decode: np.asarray(decode.actions, np.float32).tolist()),
    "rounds": (pa.list_(_ROUND), lambda decode: [asdict(one) for one in decode.rounds]),
    **_attributes("compensated"),
    **_attributes("skipped", kind=FLAG),
    **_attributes("variability", "similarity", "metric", "deviation", kind=FLOAT),
    **_attributes("reason", kind=TEXT),  # of a skip rule: trusted, streak; null without one that says so
    "delay_seconds": (FLOAT, _delay("seconds")),  # these: null where the world waited
    "delay_steps": (INT, _delay("steps")),
    **{name: (INT, _delay(name)) for name in ("observed", "carried", "held", "dropped")},
}
# index: of the decode in its episode; step: control step at which its actions begin
_POSITION = {"task": TEXT, "seed": INT, "index": INT, "step": INT}
DECODE_SCHEMA = pa.schema({**_POSITION, **{name: kind for name, (kind, _) in _DECODE.items()}}.items())


@dataclass(frozen=True)
class Circumstances:
    """When and in which block an episode ran: columns of episodes.parquet."""

    block: str = ""
    order: int = 0
    started: str = ""


def episode_row(record: EpisodeRecord, at: Circumstances, repeat: int = 0) -> dict[str, Any]:
    """One row of episodes.parquet.

    Raises:
        ValueError: a decode names a phase that is not in PHASES.
    """
    unknown = {phase for decode in record.decodes for phase in decode.phases} - set(PHASES)
    if unknown:
        raise ValueError(f"phases {sorted(unknown)} are not in PHASES")
    values = {name: value(record) for name, (_, value) in _EPISODE.items()}
    return {**values, "repeat": repeat, **asdict(at), "worker_pid": os.getpid()}


def decode_rows(record: EpisodeRecord) -> list[dict[str, Any]]:
    """The rows of decodes.parquet of one episode, in order."""
    return [
        {"task": record.task, "seed": record.seed, "index": index, "step": step}
        | {name: value(decode) for name, (_, value) in _DECODE.items()}
        for index, (decode, step) in enumerate(zip(record.decodes, record.decode_steps, strict=True))
    ]


def table_bytes(table: pa.Table) -> bytes:
    """A table as the bytes of a parquet file."""
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def tables_of(records: Sequence[EpisodeRecord], at: Sequence[Circumstances], repeat: int) -> dict[str, pa.Table]:
    """A cell's tables by the names of their files. at: circumstances of each record."""
    episodes = [episode_row(record, one, repeat) for record, one in zip(records, at, strict=True)]
    decodes = [row for record in records for row in decode_rows(record)]
    return {
        "episodes.parquet": pa.Table.from_pylist(episodes, schema=EPISODE_SCHEMA),
        "decodes.parquet": pa.Table.from_pylist(decodes, schema=DECODE_SCHEMA),
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
    episodes = _with_columns(read_table(folder / "episodes.parquet"))
    return CellTables(folder, episodes, _split_by_seed(read_table(folder / "decodes.parquet", ["seed", "seconds"])))


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


def _with_columns(table: pa.Table) -> pa.Table:
    """The columns of EPISODE_SCHEMA. One that the table lacks is empty: cells of version 0.1.0 lack some.

    Raises:
        ValueError: a column of another type.
    """
    for field in EPISODE_SCHEMA:
        if field.name not in table.column_names:
            table = table.append_column(field, pa.nulls(table.num_rows, field.type))
    return table.select(EPISODE_SCHEMA.names).cast(EPISODE_SCHEMA)


def _split_by_seed(decodes: pa.Table) -> dict[int, np.ndarray]:
    """Seed -> seconds of its decodes, in order; the decodes of an episode stand together."""
    seeds, seconds = (decodes[name].to_numpy() for name in ("seed", "seconds"))
    starts = np.flatnonzero(np.diff(seeds, prepend=-1))
    return dict(zip(seeds[starts].tolist(), np.split(seconds, starts[1:]), strict=True))
