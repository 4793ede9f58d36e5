"""The command that this process runs: its command-line arguments and its database.

This file imports only the standard library.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextvars import ContextVar
from urllib.parse import unquote

STORE = "KERV_STORE"
"""Environment variable with the URL of the database. If it is empty, the SQLite file in the results folder is used."""
_words: ContextVar[tuple[str, ...]] = ContextVar("words", default=())
_store: ContextVar[str] = ContextVar("store", default="")


def current_command() -> list[str]:
    """Return this process's command-line arguments, without `kerv` itself."""
    return list(_words.get())


def current_store() -> str:
    """Return the URL of the database that this command uses. Empty for the SQLite file in the results folder."""
    return _store.get() or os.environ.get(STORE, "")


@contextlib.contextmanager
def noted(words: Sequence[str]) -> Iterator[None]:
    """Set the current command's arguments (without `kerv`) to `words` during a `with` block.

    Studies and artifacts (weights or data) that the block makes are stored with these arguments. At the end of the
    block the earlier arguments are restored, because `kerv prepare` runs other commands inside its own block.
    """
    before = _words.set(tuple(words))
    try:
        yield
    finally:
        _words.reset(before)


def without_passwords(url: str) -> str:
    """Return a database's URL without passwords, which can be before the host and in the query."""
    address, _, query = re.sub(r"(://[^/@:]*):[^@]*@", r"\1@", url).partition("?")
    pairs = [one for one in query.split("&") if not unquote(one.partition("=")[0]).lower().endswith("password")]
    return "?".join(filter(None, (address, "&".join(pairs))))


@contextlib.contextmanager
def chosen_store(overrides: Iterable[str]) -> Iterator[list[str]]:
    """Use the database named by the override `store=URL` for the `with` block.

    Args:
        overrides: Overrides of a command. Without `store=`, the block uses the same database as the code before it.

    Yields:
        The overrides, with `store=` changed: its URL has no password, so that no password is ever stored. The URL is
        quoted if Hydra needs quotes.
    """
    overrides, chosen = list(overrides), _store.get()
    for number, override in enumerate(overrides):
        if override.startswith("store="):
            chosen = url = override.removeprefix("store=").strip("'\"")
            url = without_passwords(url)
            overrides[number] = f"store={url}" if re.fullmatch(r"[\w:/@.%+-]*", url) else f"store='{url}'"
    before = _store.set(chosen)
    try:
        yield overrides
    finally:
        _store.reset(before)
