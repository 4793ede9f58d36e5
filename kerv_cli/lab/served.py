"""What a server keeps of an episode whose world ran elsewhere: its decodes and a row like that of an episode here.

results/served/<evaluation>/<episode>.parquet: rows of decodes.parquet; the row of episodes.parquet and what served it
are JSON in the file's metadata. Both names are the harness's.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import atomic_path
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.lab.rows import DECODE_SCHEMA, Circumstances, decode_rows, episode_row

SERVED = "served"
_KEY = b"kerv"
_NAME = re.compile(r"\w[\w.-]{0,199}")


@dataclass(frozen=True)
class Served:
    """An episode as its server saw it. episode: a row of episodes.parquet. by: `Policy.facts` of the server. decodes:
    rows of decodes.parquet."""

    episode: dict[str, Any]
    by: dict[str, Any]
    decodes: pa.Table


def path_of(results: Path, evaluation: str, episode: str) -> Path | None:
    """The file of an episode; None for names that cannot be those of files."""
    if not _NAME.fullmatch(evaluation) or not _NAME.fullmatch(episode):
        return None
    return results / SERVED / evaluation / f"{episode}.parquet"


def write_served(path: Path, record: EpisodeRecord, at: Circumstances, by: Mapping[str, Any]) -> None:
    """Writes an episode. A record whose path is not known has none (n, 3) of length 0.

    Raises:
        StorageError: the disk refused.
    """
    row = episode_row(record, at)
    if not len(record.path):
        row |= {"path_length": math.nan, "jerk": math.nan}
    facts = json.dumps({"episode": row, "by": by})
    table = pa.Table.from_pylist(decode_rows(record), schema=DECODE_SCHEMA).replace_schema_metadata({_KEY: facts})
    with atomic_path(path) as temporary:
        pq.write_table(table, temporary, compression="zstd")


def read_served(path: Path) -> Served | None:
    """The episode in a file; None where there is no such file.

    Raises:
        CheckpointError: it is damaged.
    """
    try:
        table = pq.ParquetFile(path).read(use_threads=False)
        facts = json.loads((table.schema.metadata or {})[_KEY])
        return Served(facts["episode"], facts["by"], table.replace_schema_metadata(None).cast(DECODE_SCHEMA))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
        raise CheckpointError(f"{path} is damaged ({' '.join(str(error).split())[:80]}): move it aside") from error
