"""Read Parquet files that other programs wrote, with limits: a small file can stand for a huge table."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kerv_cli.base.files import regular

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

MOST_EXPANDED = 2**30
"""Bytes of a Parquet file's table in memory."""
_BATCH = 2**28


def foreign_table(
    source: Path | bytes, columns: Sequence[str] | None = None, where: tuple[str, Any] | None = None
) -> pa.Table:
    """Return the table of a Parquet file, read part by part.

    Args:
        source: The file, or its bytes.
        columns: Only these, as far as the file has them.
        where: Only the rows in which this column has this value.

    Raises:
        OSError: The file is missing or no Parquet. ValueError: As well, or it takes more than MOST_EXPANDED bytes.
    """
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    name = "a table" if isinstance(source, bytes) else str(source)
    batches, total = [], 0
    opened = io.BytesIO(source) if isinstance(source, bytes) else regular(source)
    with pq.ParquetFile(opened) as file:
        texts = _repeated_texts(file)
        if texts:
            _check_texts(opened, texts, name)
        present = None if columns is None else [one for one in columns if one in file.schema_arrow.names]
        for number in range(file.num_row_groups):
            group = file.metadata.row_group(number)
            if where and not _may_hold(group, *where):
                continue
            stored = _check_group(group, name)
            size = max(1, min(65_536, _BATCH // max(1, stored)))  # every row may be as large as all that is stored
            for batch in file.iter_batches(size, [number], present, use_threads=False):
                part = _decoded(batch)
                part = part.filter(pc.equal(part[where[0]], where[1])) if where else part
                total += part.nbytes
                if total > MOST_EXPANDED:
                    raise ValueError(_too_large(name))
                if part.num_rows:
                    batches.append(part)
        fields = [field for field in file.schema_arrow if present is None or field.name in present]
    schema = _decoded(pa.RecordBatch.from_pylist([], pa.schema(fields))).schema
    return pa.Table.from_batches(batches, schema)


def _decoded(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return the batch with dictionaries as plain values, so that its size is counted as it will be used."""
    import pyarrow as pa

    columns = [one.dictionary_decode() if pa.types.is_dictionary(one.type) else one for one in batch.columns]
    return pa.RecordBatch.from_arrays(columns, names=batch.schema.names)


def _repeated_texts(file: pq.ParquetFile) -> list[str]:
    """Return the columns of texts in lists whose dictionaries let few bytes stand for too many."""
    found = []
    for number in range(file.num_row_groups):
        group = file.metadata.row_group(number)
        for column in range(group.num_columns):
            chunk = group.column(column)
            most = chunk.num_values * chunk.total_uncompressed_size
            nested = file.schema.column(column).max_repetition_level > 0
            if nested and chunk.physical_type == "BYTE_ARRAY" and most > MOST_EXPANDED:
                found.append(chunk.path_in_schema)
    return list(dict.fromkeys(found))


def _check_texts(source: Path | io.BytesIO, columns: list[str], name: str) -> None:
    """Refuse columns whose texts would take too much memory; they are read as dictionaries to find out."""
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    total = 0
    with pq.ParquetFile(source, read_dictionary=columns) as file:
        for number in range(file.num_row_groups):
            _check_group(file.metadata.row_group(number), name)
            for batch in file.iter_batches(4096, [number], columns, use_threads=False):
                for texts in (leaf for column in batch.columns for leaf in _dictionaries(column)):
                    lengths = pc.binary_length(texts.dictionary).take(texts.indices)
                    total += pc.sum(lengths.cast("int64")).as_py() or 0
                    if total > MOST_EXPANDED:
                        raise ValueError(_too_large(name))


def _dictionaries(array: Any) -> Iterator[Any]:
    """Yield the dictionary arrays within an array of lists and structs."""
    import pyarrow as pa

    if pa.types.is_dictionary(array.type):
        yield array
    elif pa.types.is_struct(array.type):
        for part in array.flatten():
            yield from _dictionaries(part)
    elif pa.types.is_list(array.type) or pa.types.is_large_list(array.type):
        yield from _dictionaries(array.flatten())


def _too_large(name: str) -> str:
    return f"{name} expands to more than {MOST_EXPANDED // 2**20} MiB in memory: split it into smaller files"


def _check_group(group: pq.RowGroupMetaData, name: str) -> int:
    """Return the largest column's uncompressed bytes; refuse a row group that would not fit into memory."""
    chunks = [group.column(number) for number in range(group.num_columns)]
    least = sum(max(chunk.total_uncompressed_size, chunk.num_values * _width(chunk)) for chunk in chunks)
    if least > MOST_EXPANDED:
        raise ValueError(_too_large(name))
    return max((chunk.total_uncompressed_size for chunk in chunks), default=0)


def _width(chunk: pq.ColumnChunkMetaData) -> float:
    """Return the bytes that a value takes in memory at least."""
    return {"BOOLEAN": 0.125, "INT64": 8, "DOUBLE": 8}.get(chunk.physical_type, 4)


def _may_hold(group: pq.RowGroupMetaData, column: str, value: Any) -> bool:
    """Return whether a row group's statistics allow that a column has the value."""
    for number in range(group.num_columns):
        chunk = group.column(number)
        if chunk.path_in_schema == column and chunk.statistics is not None and chunk.statistics.has_min_max:
            return bool(chunk.statistics.min <= value <= chunk.statistics.max)
    return True
