"""Removes runs from a results folder."""

from __future__ import annotations

import secrets
import shutil

from kerv_cli.errors import UsageError
from kerv_cli.files import storage_errors
from kerv_cli.runs.catalogue import TRAINED, RunEntry, store_of
from kerv_cli.studies.claims import is_claimed


def check_removable(run: RunEntry) -> None:
    """Raises UsageError: a process computes cells of the run at the moment."""
    if run.kind in TRAINED or run.state == "damaged":
        return
    store = store_of(run)
    if any(is_claimed(store.claims, cell) for cell in store.read_plan().cells):
        raise UsageError(f"{run.id} is running: stop it first")


def remove(run: RunEntry) -> None:
    """Removes the run's folder: renamed first, so that a part of it is never taken for a run.

    Raises:
        StorageError: the disk refused.
    """
    gone = run.folder.with_name(f".{run.folder.name}.{secrets.token_hex(4)}.tmp")
    with storage_errors(run.folder):
        run.folder.rename(gone)
        shutil.rmtree(gone)
