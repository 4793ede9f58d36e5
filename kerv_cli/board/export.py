"""Write the board's pages as files that a browser opens without a server, and that can be sent to a colleague.

The pages come from the web app: this module calls the function of each, without a server or a network. Links lead to
the written files. A link to a page that is not exported becomes plain text. Elements with the attribute `data-live`,
such as forms and buttons, are left out.
"""

from __future__ import annotations

import html
import os
import re
from collections.abc import Collection
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urljoin, urlsplit

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Match
from starlette.staticfiles import StaticFiles

from kerv_cli.base.errors import KervError
from kerv_cli.board.app import failed, make_app
from kerv_cli.lab.database import Database

MOST_EPISODES = 400
"""Largest number of episodes that get a page."""
MOST_FILM_BYTES = 8_000_000
"""Films are left out after this many bytes."""
_VOID = {"area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "wbr"}
_LINKS = {"a": "href", "link": "href", "script": "src", "img": "src"}


def export_board(database: Database, names: Collection[str], folder: Path) -> list[Path]:
    """Write the pages of a board into a folder, and return the files, `index.html` first.

    Args:
        database: The database.
        names: Ids of the runs to export. Empty: all runs.
        folder: An empty folder.

    Raises:
        KervError: A page cannot be shown.
        StorageError: The disk is full or not writable.
    """
    app = make_app(database)
    app.state.only = frozenset(names)
    pages = _collected(app)
    written = []
    for address, content in pages.items():
        path = folder / file_of(address)
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, str):
            content = _Static(address, pages).rewritten(content).encode()
        path.write_bytes(content)
        written.append(path)
    return written


def file_of(address: str) -> str:
    """Return the name of the file for an address of the board. Empty if the page at the address is not exported."""
    path = unquote(urlsplit(address).path).strip("/")
    film = re.fullmatch(r"(episodes/\d+)/(?:frames/\d+|film\.gif)", path)
    if film:
        return f"{film[1]}.gif"
    if re.fullmatch(r"(static|report)/[\w.]+", path):
        return path
    if re.fullmatch(r"studies/[^/]+(/episodes|/failures)?|episodes/\d+|artifacts/.+", path):
        return re.sub(r"[^\w./+-]", "_", path) + ".html"
    return "" if path else "index.html"


def _asked(app: Starlette, address: str) -> Response:
    """Call the function of the page at an address, as for a GET. Return its answer."""
    parts = urlsplit(address)
    path, query = unquote(parts.path), parts.query.encode()
    scope: dict[str, Any] = {"type": "http", "method": "GET", "path": path, "query_string": query, "app": app}
    scope["headers"] = [(b"host", b"localhost")]
    for route in app.routes:
        match, found = route.matches(scope)
        if match is Match.FULL:
            scope |= found
            break
    request, answer = Request(scope), scope["endpoint"]
    try:
        if isinstance(answer, StaticFiles):
            file, _ = answer.lookup_path(Path(path).name)
            return Response(Path(file).read_bytes())
        page: Response = answer(request)
        return page
    except (KervError, HTTPException) as error:
        return failed(request, error)


def _collected(app: Starlette) -> dict[str, str | bytes]:
    """Ask for the first page and for all pages and files that it leads to. Return the answers by address.

    Failed answers are left out. Parts that a browser loads later (`hx-trigger="load"`) are put into their page.
    """
    pages: dict[str, str | bytes] = {}
    waiting, films, episodes = ["/"], 0, 0
    seen = set(waiting)
    while waiting:
        address = waiting.pop(0)
        is_film = file_of(address).endswith(".gif")
        if is_film and films >= MOST_FILM_BYTES:
            continue
        answer = _asked(app, address)
        if answer.status_code != 200:
            if address == "/":
                raise KervError(f"the board cannot show its first page: {bytes(answer.body).decode()[:200]}")
            continue
        pages[address] = content = bytes(answer.body)
        films += len(content) if is_film else 0
        if answer.media_type != "text/html":
            continue
        pages[address] = page = _filled(app, address, content.decode())
        for link in _links(address, page):
            if link in seen or not file_of(link):
                continue
            if re.fullmatch(r"/episodes/\d+", link):
                episodes += 1
                if episodes > MOST_EPISODES:
                    continue
            seen.add(link)
            waiting.append(link)
    return pages


def _filled(app: Starlette, address: str, text: str) -> str:
    """Return a page with the parts that a browser would load at once."""
    late = re.search(r'<(section) id="(\w+)"[^>]* hx-get="([^"]+)" hx-trigger="load".*?</section>', text, re.DOTALL)
    if late is None:
        return text
    part = _asked(app, urljoin(address, html.unescape(late[3])))
    return text.replace(late[0], bytes(part.body).decode())


def _plain(address: str, link: str) -> str:
    """Return the address that a link on a page leads to, without query. A frame of a film stands for the film."""
    path = urlsplit(urljoin(address, link)).path
    return re.sub(r"^(/episodes/\d+)/frames/\d+$", r"\1/film.gif", path)


def _links(address: str, text: str) -> list[str]:
    """Return the addresses that a page links to, each once."""
    found = re.findall(r'<(?:a|link|script|img)\b[^>]*?\b(?:href|src)="([^"?#][^"]*)"', text)
    return list(dict.fromkeys(_plain(address, html.unescape(one)) for one in found if not one.startswith("data:")))


class _Static(HTMLParser):
    """Rewrites a page of the board so that it works as a file, without the board.

    Args:
        address: The page's address.
        pages: Addresses of all exported pages and files.
    """

    def __init__(self, address: str, pages: Collection[str]) -> None:
        super().__init__(convert_charrefs=False)
        self.address, self.pages = address, pages
        self.parts: list[str] = []
        self.left_out: list[str] = []  # open elements from the outermost that is left out
        self.unlinked: list[bool] = []  # whether each open link has become text

    def rewritten(self, text: str) -> str:
        """Return the page as it is written to its file."""
        self.feed(text)
        self.close()
        return "".join(self.parts)

    def _target(self, link: str) -> str:
        """Return a link relative to the page's file. Empty if it leads to nothing that is exported."""
        target = _plain(self.address, link)
        if link.startswith(("?", "#")) or target not in self.pages:
            return ""
        folder = Path(file_of(self.address)).parent
        return quote(Path(os.path.relpath(file_of(target), folder)).as_posix())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Write an element's start, with its link changed. Leave out elements of the live board."""
        found = dict(attrs)
        if self.left_out or "data-live" in found:
            if tag not in _VOID:
                self.left_out.append(tag)
            return
        name = _LINKS.get(tag)
        if name in found and not str(found[name]).startswith("data:"):
            target = self._target(str(found.pop(name)))
            if tag == "a":
                self.unlinked.append(not target)
                tag = tag if target else "span"
            elif not target:
                return
            found |= {name: target} if target else {}
        self.parts.append(f"<{tag}")
        for key, value in found.items():
            if not key.startswith("hx-"):
                self.parts.append(f" {key}" if value is None else f' {key}="{html.escape(value)}"')
        self.parts.append(">")

    def handle_endtag(self, tag: str) -> None:
        """Write an element's end."""
        if self.left_out:
            while self.left_out and self.left_out.pop() != tag:
                pass
            return
        if tag == "a" and self.unlinked and self.unlinked.pop():
            tag = "span"
        self.parts.append(f"</{tag}>")

    def _write(self, text: str) -> None:
        if not self.left_out:
            self.parts.append(text)

    def handle_data(self, data: str) -> None:
        """Write text."""
        self._write(data)

    def handle_entityref(self, name: str) -> None:
        """Write a named character."""
        self._write(f"&{name};")

    def handle_charref(self, name: str) -> None:
        """Write a numbered character."""
        self._write(f"&#{name};")

    def handle_decl(self, decl: str) -> None:
        """Write the document's type."""
        self._write(f"<!{decl}>")
