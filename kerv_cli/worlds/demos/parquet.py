"""Read Parquet files that other programs wrote.

The size in memory is limited, because a small file can contain a huge table.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kerv_cli.base.files import regular

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

MOST_EXPANDED = 2**30
"""Largest size of a table in memory, in bytes."""
_BATCH = 1024  # rows


def foreign_table(
    source: Path | bytes, columns: Sequence[str] | None = None, where: tuple[str, Any] | None = None
) -> pa.Table:
    """Read a table from a Parquet file, part by part.

    Args:
        source: The file's path or its bytes.
        columns: Columns to read. Names that the file does not have are ignored. None: all columns.
        where: (column, value). Read only the rows that have this value in this column. None: all rows.

    Raises:
        OSError: The file is missing or is no Parquet file.
        ValueError: The file is damaged, or takes more than MOST_EXPANDED bytes in memory.
    """
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    batches, total = [], 0
    with pq.ParquetFile(io.BytesIO(source) if isinstance(source, bytes) else regular(source)) as file:
        present = [one for one in file.schema_arrow.names if columns is None or one in columns]
        groups = [n for n in range(file.num_row_groups) if not where or _may_hold(file.metadata.row_group(n), *where)]
        for batch in file.iter_batches(_BATCH, groups, present, use_threads=False):
            batches.append(batch.filter(pc.equal(batch[where[0]], where[1])) if where else batch)
            total += batches[-1].nbytes
            if total > MOST_EXPANDED:
                name = "a table" if isinstance(source, bytes) else str(source)
                raise ValueError(f"{name} expands to more than {MOST_EXPANDED // 2**20} MiB in memory: split it")
        return pa.Table.from_batches(batches, pa.schema([file.schema_arrow.field(name) for name in present]))


def _may_hold(group: pq.RowGroupMetaData, column: str, value: Any) -> bool:
    """Return whether a part of a file (row group) can contain the value in a column, according to its statistics."""
    for number in range(group.num_columns):
        chunk = group.column(number)
        if chunk.path_in_schema == column and chunk.statistics is not None and chunk.statistics.has_min_max:
            return bool(chunk.statistics.min <= value <= chunk.statistics.max)
    return True
