"""Files of episodes that a kerv policy server decoded: <results>/served/<evaluation>/<episode>.arrow.

Each file holds the decodes of one episode. Its metadata holds, as JSON, the episode's columns and facts about the
server. The evaluation program chooses both names. Arrow is used because it is read several times as fast as Parquet,
and an import reads thousands of files.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
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


def path_of(results: Path, evaluation: str, episode: str) -> Path | None:
    """Return the file of a served episode. None if a name cannot be used as a file name."""
    if not _NAME.fullmatch(evaluation) or not _NAME.fullmatch(episode):
        return None
    return results / SERVED / evaluation / f"{episode}.arrow"


def write_served(path: Path, record: EpisodeRecord, started: str, by: Mapping[str, Any]) -> None:
    """Write one episode.

    Args:
        path: The file.
        record: The episode. If the end effector's path is unknown, `record.path` has the shape (0, 3).
        started: Time at which the episode began (ISO 8601).
        by: Facts about the server (`Policy.facts`).

    Raises:
        StorageError: The disk is full or not writable.
    """
    row = episode_row(record) | {"task": record.task, "seed": record.seed, "started": started}
    if not len(record.path):
        row |= {"path_length": None, "jerk": None}
    facts = json.dumps({"episode": row, "by": by})
    table = decodes_table(record).replace_schema_metadata({_KEY: facts})
    options = pa.ipc.IpcWriteOptions(compression="zstd")
    with atomic_path(path) as temporary, pa.ipc.new_file(str(temporary), table.schema, options=options) as file:
        file.write_table(table)


def read_served(path: Path) -> tuple[dict[str, Any], pa.Table] | None:
    """Read one episode.

    Returns:
        The episode's columns, and the table of its decodes. None if the file does not exist.

    Raises:
        CheckpointError: The file is damaged.
    """
    try:
        with pa.ipc.open_file(str(path)) as file:
            table = file.read_all()
        facts = json.loads((table.schema.metadata or {})[_KEY])
        table = table.replace_schema_metadata(None)
        return facts["episode"], table.select(DECODE_SCHEMA.names).cast(DECODE_SCHEMA)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
        raise CheckpointError(f"{path} is damaged ({' '.join(str(error).split())[:80]}): move it aside") from error
