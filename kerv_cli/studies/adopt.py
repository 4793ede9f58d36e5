"""Takes over blocks that another study of the same results folder has measured: a study whose settings are among those
of a larger one needs no run of its own."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

from kerv_cli.errors import CheckpointError
from kerv_cli.files import write_folder
from kerv_cli.studies.plan import Block
from kerv_cli.studies.store import STUDIES, StudyStore


def adopt(store: StudyStore, block: Block) -> bool:
    """Copies a block's cells from a study that measured all of them in one run -> whether there is one. A block is
    taken over whole or not at all: with single cells of it the sides of a ratio would come from different runs. A
    rollout takes over nothing: it was asked for in order to be run.

    Raises:
        StorageError: the disk refused.
    """
    if store.family != STUDIES or all((store.cells / cell.id).exists() for cell in block.cells):
        return False
    here = _runs(store, block)
    for other in _others(store):
        runs = _runs(other, block)
        if len(runs) == len(block.cells) and len({*runs.values(), *here.values()}) == 1:
            for name in runs.keys() - here.keys():
                _copy(other.cells / name, store.cells / name)
            return True
    return False


def _others(store: StudyStore) -> Iterator[StudyStore]:
    for folder in sorted(store.root.parent.glob("*/cells")):
        if folder.parent.name != store.name:
            yield StudyStore(store.root.parent.parent, folder.parent.name)


def _runs(store: StudyStore, block: Block) -> dict[str, str]:
    """Id -> run of the block's cells that are complete in a study; damaged ones are left out."""
    found = {}
    for cell in block.cells:
        try:
            if (store.cells / cell.id).exists():
                found[cell.id] = str(store.status_of(cell.id)["run"])
        except (CheckpointError, KeyError):
            continue
    return found


def _copy(source: Path, folder: Path) -> None:
    write_folder(folder, lambda temporary: shutil.copytree(source, temporary, dirs_exist_ok=True))
