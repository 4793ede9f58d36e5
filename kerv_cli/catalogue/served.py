"""What a server keeps of an episode whose world ran elsewhere: its decodes and a row like that of an episode here.

results/served/<evaluation>/<episode>.arrow: the decodes; the columns of the episode and what served it are
JSON in the file's metadata. Both names are the harness's. Arrow's files are read several times as fast as parquet's,
and an import reads thousands.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import atomic_path
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.episodes.rows import DECODE_SCHEMA, decodes_table, episode_row

SERVED = "served"
_KEY = b"kerv"
_NAME = re.compile(r"\w[\w.-]{0,199}")


@dataclass(frozen=True)
class Served:
    """An episode as its server saw it. episode: columns of the table `episodes`. by: `Policy.facts` of the server.
    decodes: with the columns of rows.DECODE_SCHEMA."""

    episode: dict[str, Any]
    by: dict[str, Any]
    decodes: pa.Table


def path_of(results: Path, evaluation: str, episode: str) -> Path | None:
    """The file of an episode; None for names that cannot be those of files."""
    if not _NAME.fullmatch(evaluation) or not _NAME.fullmatch(episode):
        return None
    return results / SERVED / evaluation / f"{episode}.arrow"


def write_served(path: Path, record: EpisodeRecord, started: str, by: Mapping[str, Any]) -> None:
    """Writes an episode. A record whose path is not known has none (n, 3) of length 0.

    Raises:
        StorageError: the disk refused.
    """
    row = episode_row(record) | {"task": record.task, "seed": record.seed, "started": started}
    if not len(record.path):
        row |= {"path_length": None, "jerk": None}
    facts = json.dumps({"episode": row, "by": by})
    table = decodes_table(record).replace_schema_metadata({_KEY: facts})
    options = pa.ipc.IpcWriteOptions(compression="zstd")
    with atomic_path(path) as temporary, pa.ipc.new_file(str(temporary), table.schema, options=options) as file:
        file.write_table(table)


def read_served(path: Path) -> Served | None:
    """The episode in a file; None where there is no such file.

    Raises:
        CheckpointError: it is damaged.
    """
    try:
        with pa.ipc.open_file(str(path)) as file:
            table = file.read_all()
        facts = json.loads((table.schema.metadata or {})[_KEY])
        table = table.replace_schema_metadata(None)
        decodes = table.select(DECODE_SCHEMA.names).cast(DECODE_SCHEMA)
        return Served(facts["episode"], facts["by"], decodes)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
        raise CheckpointError(f"{path} is damaged ({' '.join(str(error).split())[:80]}): move it aside") from error
