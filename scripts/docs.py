"""What `make docs` adds to the pages of docs/: the start page, the results with their plots, and the command reference.

mkdocs calls `on_files`. Links of README.md and results/ are of the repository; here they become those of the site.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGES = {"index.md": "README.md", "results.md": "results/README.md", "log.md": "results/LOG.md"}
"""Page of the site -> its source, for those that do not lie in docs/."""

WIDTH = 110  # columns of a help text
_LINK = re.compile(r"(\]\()([^)#\s]+)")


def on_files(files: Any, config: Any) -> Any:
    """Adds the pages to those that mkdocs found."""
    from mkdocs.structure.files import File

    for page in PAGES:
        files.append(File.generated(config, page, content=page_of(page)))
    files.append(File.generated(config, "reference.md", content=reference()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The text of a page, with the links of a page in docs/ that leave it."""
    source = page.file.src_uri
    return markdown if source in (*PAGES, "reference.md") else relinked(markdown, f"docs/{source}")


def page_of(page: str) -> str:
    """A page whose source lies outside of docs/, as a page of the site."""
    source = PAGES[page]
    return relinked((ROOT / source).read_text(encoding="utf-8"), source)


def relinked(text: str, source: str) -> str:
    """The text with links between files of the repository as links between pages. source: where the text lies."""
    pages = {path: page for page, path in PAGES.items()}

    def link(match: re.Match[str]) -> str:
        target = match[2]
        if re.match(r"[a-z]+:", target):
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        return match[1] + pages.get(path, re.sub(r"^(docs|results)/", "", path))

    return _LINK.sub(link, text)


def reference() -> str:
    """A page with the help of every command."""
    parts = [f"## `{' '.join(('kerv', *path))}`\n\n```text\n{help_of(path)}\n```\n" for path in commands()]
    return "\n".join(["# Command reference\n\nWhat `--help` says, command by command.\n", *parts])


def commands(path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The words of a command, then those of the commands below it, in the order of its help."""
    yield path
    below = help_of(path).partition("\nCommands:\n")[2].partition("\n\n")[0]
    for line in re.findall(r"^  (\S+(?: \S+)*)", below, re.MULTILINE):
        words = tuple(line.split())
        yield from commands(words if path and words[: len(path)] == path else (*path, words[0]))


def help_of(path: tuple[str, ...]) -> str:
    """What a command prints for --help."""
    from typer.testing import CliRunner

    from kerv_cli.cli.app import app

    result = CliRunner().invoke(app, [*path, "--help"], prog_name="kerv", env={"COLUMNS": str(WIDTH)})
    if result.exit_code:
        raise RuntimeError(f"kerv {' '.join(path)} --help: {result.output}")
    return str(result.output).rstrip()
