"""`make docs`: the pages of docs/, the start page, the results and the command reference as a site in build/site.

They are collected in build/pages, from where zensical reads them. Links of README.md and results/ are of the
repository; here they become those of the site, and a link to a file that is no page becomes plain text.
"""

from __future__ import annotations

import posixpath
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "index.md": "README.md",
    "results.md": "results/README.md",
    "details.md": "results/details.md",
    "log.md": "results/LOG.md",
}
"""Page of the site -> its source, for those that do not lie in docs/."""

WIDTH = 110  # columns of a help text
_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]+)([^)]*)\)")


def collect(folder: Path) -> None:
    """Write the source of every page into the folder."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(ROOT / "docs", folder)
    sources = {path.name: f"docs/{path.name}" for path in folder.glob("*.md")} | PAGES
    for page, source in sources.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        (folder / page).write_text(relinked(text, source), encoding="utf-8")
    (folder / "reference.md").write_text(reference(), encoding="utf-8")


def relinked(text: str, source: str) -> str:
    """The text with links between files of the repository as links between pages. source: where the text lies."""
    pages = {path: page for page, path in PAGES.items()}

    def link(match: re.Match[str]) -> str:
        image, words, target, anchor = match.groups()
        if re.match(r"[a-z]+:", target):
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        page = pages.get(path, path.removeprefix("docs/"))
        return f"{image}[{words}]({page}{anchor})" if path in pages or path.startswith("docs/") else words

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


if __name__ == "__main__":
    collect(ROOT / "build/pages")
    sys.exit(subprocess.call([Path(sys.executable).with_name("zensical"), "build", "-f", "mkdocs.yml"], cwd=ROOT))
