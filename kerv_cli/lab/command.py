"""The command that this process runs: its command-line arguments and its database. This file imports nothing heavy."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from urllib.parse import unquote

STORE = "KERV_STORE"
"""Environment variable with the URL of the database. If empty, it is a SQLite file in the results folder."""
_words: list[str] = []


def current_command() -> list[str]:
    """Return this process's command-line arguments, without `kerv` itself."""
    return list(_words)


@contextlib.contextmanager
def noted(words: Sequence[str]) -> Iterator[None]:
    """Remember a command's arguments (without `kerv`) inside this `with` block, to store them with what it makes.

    At the end the arguments from before the block are remembered again, because `kerv prepare` runs other commands
    inside its own.
    """
    before = current_command()
    _words[:] = words
    try:
        yield
    finally:
        _words[:] = before


def without_passwords(url: str) -> str:
    """Return a database's URL without the password before its host and without those in its query."""
    address, _, query = re.sub(r"(://[^/@:]*):[^/@]*@", r"\1@", url).partition("?")
    pairs = [one for one in query.split("&") if not unquote(one.partition("=")[0]).lower().endswith("password")]
    return "?".join(filter(None, (address, "&".join(pairs))))


@contextlib.contextmanager
def chosen_store(overrides: Iterable[str]) -> Iterator[list[str]]:
    """Use the database named by the override `store=URL`, in this process and its workers, for the `with` block.

    Args:
        overrides: Overrides of a command. The environment variable KERV_STORE is set to the value of `store=`. Without
            it the variable stays as it is.

    Yields:
        The same overrides, but without the URL's password, so that it is never stored. The URL is quoted if Hydra needs
        that.
    """
    overrides, before = list(overrides), os.environ.get(STORE)
    for number, override in enumerate(overrides):
        if override.startswith("store="):
            os.environ[STORE] = url = override.removeprefix("store=").strip("'\"")
            url = without_passwords(url)
            overrides[number] = f"store={url}" if re.fullmatch(r"[\w:/@.%+-]*", url) else f"store='{url}'"
    try:
        yield overrides
    finally:
        if before is None:
            os.environ.pop(STORE, None)
        else:
            os.environ[STORE] = before
