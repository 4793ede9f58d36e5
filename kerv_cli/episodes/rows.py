"""Converts records of episodes and decodes to rows of the database."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter, itemgetter
from typing import Any, get_type_hints

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from kerv_cli.base.registry import ProposerPart
from kerv_cli.engine.record import PHASES, DecodeRecord, Delay, EpisodeRecord, Round

INT, FLOAT, TEXT, FLAG = pa.int64(), pa.float64(), pa.string(), pa.bool_()
# Columns by name. Each has a type, and a function that reads the column's value from a record.
Fields = dict[str, tuple[pa.DataType, Callable[..., Any]]]


def _summed(value: Callable[[DecodeRecord], Any]) -> Callable[[EpisodeRecord], Any]:
    return lambda episode: sum(value(decode) or 0 for decode in episode.decodes)


def _judged(value: Callable[[Round], int], *served: str) -> Callable[[EpisodeRecord], int]:
    """Return a function that sums `value` over verified rounds, plus the counts named `served` that a server sent."""
    return _summed(
        lambda decode: (
            sum(value(one) for one in decode.rounds if one.is_verification)
            + sum(getattr(decode.served, name, 0) for name in served)
        )
    )


def _delay(name: str) -> Callable[[DecodeRecord], Any]:
    return lambda decode: getattr(decode.delay, name, None)


def _phase(phase: str) -> Callable[[DecodeRecord], float | None]:
    return lambda decode: decode.phases.get(phase)


def _columns(*names: str, kind: pa.DataType = INT, read: Callable[[str], Any] = attrgetter, as_: str = "{}") -> Fields:
    """Return a column for each name. `read(name)` reads the value from a record; `as_` is the pattern of the name."""
    return {as_.format(name): (kind, read(name)) for name in names}


def _retrieved(decode: DecodeRecord) -> bool:
    # a merged draft without the early drafter has its sources' names
    names = {name for one in decode.rounds for name in one.proposer.split("+")}
    return any(part.looks_up for name, part in ProposerPart.every().items() if name in names)


def _executed(episode: EpisodeRecord, count: Callable[[DecodeRecord, int, int], int]) -> int:
    return sum(count(one, *steps) for one, steps in zip(episode.decodes, episode.executed, strict=True))


def _values(decode: DecodeRecord, first: int, end: int) -> int:
    # what a server verified is unknown
    return 0 if decode.served else (end - first) * decode.actions.shape[1]


_EPISODE: Fields = {
    **_columns("success", kind=FLAG),
    **_columns("steps"),  # control steps executed
    "decodes": (INT, lambda episode: len(episode.decodes)),
    **_columns("seconds", kind=FLOAT),  # inference time
    **_columns(*PHASES, kind=FLOAT, read=lambda phase: _summed(_phase(phase)), as_="seconds.{}"),
    # a server's own time, and the number of its answers
    "server_seconds": (FLOAT, _summed(lambda decode: decode.served.seconds if decode.served else 0.0)),
    "server_decodes": (INT, _summed(lambda decode: decode.served is not None)),
    **_columns("forwards"),
    "verifications": (INT, _judged(lambda one: 1, "drafts")),
    "tokens": (INT, _summed(lambda decode: len(decode.tokens))),  # committed in all rounds
    "committed": (INT, _judged(lambda one: one.committed, "drafts", "accepted")),  # in verifications, bonus included
    "accepted": (INT, _judged(lambda one: one.accepted, "accepted")),  # draft tokens accepted in verifications
    "first_rejected_sum": (INT, _summed(lambda decode: decode.first_rejected)),  # over chunks that had a verification
    "first_rejected_count": (INT, _summed(lambda decode: decode.first_rejected is not None)),
    "compensated_tokens": (INT, _summed(lambda decode: decode.compensated)),
    "compensated_decodes": (INT, _summed(lambda decode: decode.compensated > 0)),
    "skipped_decodes": (INT, _summed(lambda decode: decode.skipped)),
    "unverified_tokens": (INT, lambda episode: _executed(episode, DecodeRecord.unverified_among)),
    "executed_tokens": (INT, lambda episode: _executed(episode, _values)),  # control steps × DoFs
    "retrieval_decodes": (INT, _summed(_retrieved)),
    "deviation_sum": (FLOAT, _summed(lambda decode: decode.deviation)),  # normalised action units, over sampled decodes
    "deviation_count": (INT, _summed(lambda decode: decode.deviation is not None)),
    "delay_decodes": (INT, _summed(lambda decode: decode.delay is not None)),  # during which the world went on
    "delay_seconds": (FLOAT, _summed(_delay("seconds"))),  # sum over these decodes of the latency
    "delay_steps": (INT, _summed(_delay("steps"))),  # the sum in control steps
    # of these: steps on the previous chunk, steps on the last action, and actions that were too old to execute
    **_columns("carried", "held", "dropped", read=lambda name: _summed(_delay(name)), as_="{}_steps"),
    **_columns("path_length", "jerk", kind=FLOAT),  # of the end effector: metres; m/s³
    **_columns("closest_approach", kind=FLOAT),  # least distance of fingertips to object, metres
    **_columns("object_moved", kind=FLOAT),  # how far the object moved after they came within 5 cm, metres
    **_columns("wall_seconds", kind=FLOAT),
    "initial_state": (pa.list_(FLOAT), lambda episode: np.asarray(episode.initial_state, np.float64).ravel().tolist()),
}


def _schema(columns: Fields) -> pa.Schema:
    return pa.schema((name, kind) for name, (kind, _) in columns.items())


def _row(columns: Fields, record: object) -> dict[str, Any]:
    return {name: read(record) for name, (_, read) in columns.items()}


# Columns that are computed from an episode's record. The database adds more columns, such as task and time.
EPISODE_SCHEMA = _schema(_EPISODE)

_TOKENS = pa.list_(pa.int32())
_OF_ROUND = {str: TEXT, int: pa.int32(), tuple[int, ...]: _TOKENS}
_ROUND = pa.struct([(name, _OF_ROUND[kind]) for name, kind in get_type_hints(Round).items()])
_DECODE: Fields = {
    **_columns("mode", kind=TEXT),
    **_columns("forwards"),
    **_columns("seconds", kind=FLOAT),
    **_columns(*PHASES, kind=FLOAT, read=_phase, as_="seconds.{}"),
    "tokens": (_TOKENS, lambda decode: list(decode.tokens)),
    "actions": (pa.list_(pa.list_(pa.float32())), lambda decode: np.asarray(decode.actions, np.float32).tolist()),
    "rounds": (pa.list_(_ROUND), lambda decode: [one._asdict() for one in decode.rounds]),
    **_columns("compensated"),
    **_columns("skipped", kind=FLAG),
    **_columns("variability", "similarity", "metric", "deviation", kind=FLOAT),
    **_columns("reason", kind=TEXT),  # given by a skip rule: trusted, streak; null if none
    "delay_seconds": (FLOAT, _delay("seconds")),  # this and the next: null if the world waited
    "delay_steps": (INT, _delay("steps")),
    **_columns("observed", "carried", "held", "dropped", read=_delay),
}
# index: position of the decode in its episode; step: control step at which its actions begin
DECODE_SCHEMA = pa.schema([("index", INT), ("step", INT), *_schema(_DECODE)])


def episode_row(record: EpisodeRecord) -> dict[str, Any]:
    return {name: _plain(value) for name, value in _row(_EPISODE, record).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [one if math.isfinite(one) else None for one in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and math.isnan(value) else value


def decodes_table(record: EpisodeRecord) -> pa.Table:
    """Return the decodes of one episode as a table with the columns of DECODE_SCHEMA, one row per decode."""
    rows = []
    for index, (decode, step) in enumerate(zip(record.decodes, record.decode_steps, strict=True)):
        rows.append({"index": index, "step": step, **_row(_DECODE, decode)})
    return pa.Table.from_pylist(rows, schema=DECODE_SCHEMA)


def table_blob(table: pa.Table) -> bytes:
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def read_decodes(blob: bytes, columns: Sequence[str] | None = None) -> pa.Table:
    """Read a table of decodes from bytes that `table_blob` returned. `columns`: names, or None for all."""
    # pq.read_table takes three times as long for one episode
    return pq.ParquetFile(pa.BufferReader(blob)).read(columns, use_threads=False)


_SAME = (
    "forwards", "seconds", "mode", "compensated", "skipped",
    "variability", "similarity", "metric", "reason", "deviation",
)  # fmt: skip


def decode_records(table: pa.Table) -> list[DecodeRecord]:
    return list(map(_decode_record, table.to_pylist()))


def _round(values: dict[str, Any]) -> Round:
    # episodes from before a field existed have None there
    given: dict[str, Any] = {name: value for name, value in values.items() if value is not None}
    return Round(**given | {name: tuple(value) for name, value in given.items() if isinstance(value, list)})


def _decode_record(row: dict[str, Any]) -> DecodeRecord:
    rounds, tokens = tuple(map(_round, row["rounds"])), tuple(row["tokens"])
    filled = set(range(len(tokens) if row["compensated"] else 0))  # a rectifier filled what no round committed
    for one in rounds:
        filled.difference_update(range(one.start, one.start + one.committed))
    phases = {phase: row[f"seconds.{phase}"] for phase in PHASES if row[f"seconds.{phase}"] is not None}
    late = itemgetter("delay_seconds", "delay_steps", "observed", "carried", "held", "dropped")
    return DecodeRecord(
        tokens=tokens,
        actions=np.asarray(row["actions"], np.float32),
        rounds=rounds,
        phases=phases,
        filled=tuple(sorted(filled)),
        delay=None if row["delay_steps"] is None else Delay(*late(row)),
        **dict(zip(_SAME, itemgetter(*_SAME)(row), strict=True)),
    )


def seconds_blob(seconds: Iterable[float]) -> bytes:
    """Return the seconds of each decode as bytes, little-endian float64."""
    return np.asarray(list(seconds), dtype="<f8").tobytes()
