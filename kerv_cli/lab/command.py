"""The command that this process runs: its words and its database. Imports nothing heavy."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterable, Iterator, Sequence

STORE = "KERV_STORE"
"""Environment variable with the URL of the database. Empty: SQLite in the results folder."""
_words: list[str] = []


def current_command() -> list[str]:
    """Return the words after `kerv` of this process's command."""
    return list(_words)


def set_command(words: Sequence[str]) -> list[str]:
    """Set the words after `kerv` of this process's command, and return those set before."""
    before = list(_words)
    _words[:] = words
    return before


@contextlib.contextmanager
def chosen_store(overrides: Iterable[str]) -> Iterator[list[str]]:
    """Use the database that `store=URL` names, in this process and its workers, until the block ends.

    Args:
        overrides: Overrides of a command. Without a `store=` the variable KERV_STORE stays as it is.

    Yields:
        The same overrides. A URL has lost its password, so that none is stored, and is quoted if Hydra needs that.
    """
    overrides, before = list(overrides), os.environ.get(STORE)
    for number, override in enumerate(overrides):
        if override.startswith("store="):
            os.environ[STORE] = url = override.removeprefix("store=").strip("'\"")
            url = re.sub(r"(://[^/@:]*):[^/@]*@", r"\1@", url)
            overrides[number] = f"store={url}" if re.fullmatch(r"[\w:/@.%+-]*", url) else f"store='{url}'"
    try:
        yield overrides
    finally:
        if before is None:
            os.environ.pop(STORE, None)
        else:
            os.environ[STORE] = before
