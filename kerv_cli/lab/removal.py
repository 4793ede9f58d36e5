"""Removes runs from a results folder: a run is there whole or it is gone."""

from __future__ import annotations

import os
import shutil

from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import storage_errors, sync
from kerv_cli.base.leftovers import temporary_beside
from kerv_cli.lab.catalogue import RunEntry, store_of
from kerv_cli.lab.claims import is_claimed


def check_removable(run: RunEntry) -> None:
    """Raises UsageError: the folder is a link, or a process computes cells of the run at the moment."""
    if run.folder.is_symlink():
        raise UsageError(f"{run.folder} is a link to {os.readlink(run.folder)}: remove the link, or what it points to")
    if not run.has_episodes or run.state == "damaged":
        return
    store = store_of(run)
    if any(is_claimed(store.claims, cell) for cell in store.read_plan().cells):
        raise UsageError(f"{run.id} is running: stop it first")


def remove(run: RunEntry) -> None:
    """Removes the run's folder: first it gets a temporary's name, which no command reads and which the next one that
    looks there cleans away if this process is killed before it is done.

    Raises:
        StorageError: the disk refused; the run is as it was.
    """
    gone = temporary_beside(run.folder)
    with storage_errors(run.folder):
        run.folder.rename(gone)
        sync(run.folder.parent)
    shutil.rmtree(gone, ignore_errors=True)
