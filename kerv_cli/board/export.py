"""Write the board's pages as files that a browser opens without a server, and that can be sent to a colleague.

The pages come from the web app: this module requests each of them as a browser would, without a network. Links lead to
the written files. A link to a page that is not exported becomes plain text. Elements with the attribute `data-live`,
such as forms and buttons, are left out.
"""

from __future__ import annotations

import asyncio
import html
import os
import re
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urljoin, urlsplit

from starlette.applications import Starlette

from kerv_cli.base.errors import KervError
from kerv_cli.board.app import make_app
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
        names: Ids of the runs to export. Empty: all of them.
        folder: An empty folder.

    Raises:
        KervError: A page cannot be shown.
        StorageError: The disk is full or not writable.
    """
    app = make_app(database)
    app.state.only = frozenset(names)
    with ThreadPoolExecutor(1) as own:  # a notebook's thread has an event loop already
        pages = own.submit(asyncio.run, _collected(app)).result()
    written = []
    for address, answer in pages.items():
        path = folder / file_of(address)
        path.parent.mkdir(parents=True, exist_ok=True)
        content = answer.body
        if answer.is_page:
            content = _Static(address, pages).rewritten(answer.text).encode()
        path.write_bytes(content)
        written.append(path)
    return written


def file_of(address: str) -> str:
    """Return the name of the file for an address of the board. Empty if it is not exported."""
    path = unquote(urlsplit(address).path).strip("/")
    film = re.fullmatch(r"(episodes/\d+)/(?:frames/\d+|film\.gif)", path)
    if film:
        return f"{film[1]}.gif"
    if re.fullmatch(r"(static|report)/[\w.]+", path):
        return path
    if re.fullmatch(r"studies/[^/]+(/episodes|/failures)?|episodes/\d+|artifacts/.+", path):
        return re.sub(r"[^\w./+-]", "_", path) + ".html"
    return "" if path else "index.html"


@dataclass
class _Answer:
    """An answer of the web app."""

    status: int = 0
    kind: str = ""
    body: bytes = b""

    @property
    def is_page(self) -> bool:
        """Whether it is HTML."""
        return self.kind.startswith("text/html")

    @property
    def text(self) -> str:
        """The answer as text."""
        return self.body.decode()


async def _asked(app: Starlette, address: str) -> _Answer:
    """Return what the web app answers to GET, without a network."""
    parts, answer = urlsplit(address), _Answer()
    scope: dict[str, Any] = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "GET", "scheme": "http",
        "path": unquote(parts.path), "raw_path": parts.path.encode(), "query_string": parts.query.encode(),
        "root_path": "", "headers": [(b"host", b"localhost")], "client": None, "server": ("localhost", 80),
    }  # fmt: skip

    is_sent = False

    async def receive() -> dict[str, Any]:
        nonlocal is_sent
        if is_sent:
            await asyncio.Event().wait()  # a file's answer waits for the end of the connection, which never comes
        is_sent = True
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Any) -> None:
        if message["type"] == "http.response.start":
            answer.status = message["status"]
            answer.kind = dict(message["headers"]).get(b"content-type", b"").decode()
        else:
            answer.body += message.get("body", b"")

    await app(scope, receive, send)
    return answer


async def _collected(app: Starlette) -> dict[str, _Answer]:
    """Ask for the first page and for all that it leads to. Return the answers by address, without those that fail.

    Parts of a page that a browser loads later (`hx-trigger="load"`) are put into it.
    """
    waiting, pages, films, episodes = ["/"], dict[str, _Answer](), 0, 0
    seen = set(waiting)
    while waiting:
        address = waiting.pop(0)
        if not _is_film(address) or films < MOST_FILM_BYTES:
            answer = await _asked(app, address)
            if address == "/" and answer.status != 200:
                raise KervError(f"the board cannot show its first page: {answer.text[:200]}")
            if answer.status == 200:
                pages[address] = answer
                films += len(answer.body) if _is_film(address) else 0
        if address not in pages or not pages[address].is_page:
            continue
        page = pages[address]
        page.body = (await _filled(app, address, page.text)).encode()
        for link in _links(address, page.text):
            if link in seen or not file_of(link):
                continue
            if re.fullmatch(r"/episodes/\d+", link):
                episodes += 1
                if episodes > MOST_EPISODES:
                    continue
            seen.add(link)
            waiting.append(link)
    return pages


def _is_film(address: str) -> bool:
    return file_of(address).endswith(".gif")


async def _filled(app: Starlette, address: str, text: str) -> str:
    """Return a page with the parts that a browser would load at once."""
    late = re.search(r'<(section) id="(\w+)"[^>]* hx-get="([^"]+)" hx-trigger="load".*?</section>', text, re.DOTALL)
    if late is None:
        return text
    part = await _asked(app, urljoin(address, html.unescape(late[3])))
    return text.replace(late[0], part.text)


def _plain(address: str, link: str) -> str:
    """Return the address that a link on a page leads to, without query. A frame of a film stands for the film."""
    path = urlsplit(urljoin(address, link)).path
    return re.sub(r"^(/episodes/\d+)/frames/\d+$", r"\1/film.gif", path)


def _links(address: str, text: str) -> list[str]:
    """Return the addresses that a page links to, each once."""
    found = re.findall(r'<(?:a|link|script|img)\b[^>]*?\b(?:href|src)="([^"?#][^"]*)"', text)
    return list(dict.fromkeys(_plain(address, html.unescape(one)) for one in found if not one.startswith("data:")))


class _Static(HTMLParser):
    """Rewrites a page of the board for the file system.

    Args:
        address: The page's address.
        pages: All that is exported, by address.
    """

    def __init__(self, address: str, pages: Mapping[str, _Answer]) -> None:
        super().__init__(convert_charrefs=False)
        self.address, self.pages = address, pages
        self.parts: list[str] = []
        self.left_out: list[str] = []  # open elements from the outermost that is left out
        self.unlinked: list[bool] = []  # whether each open link has become text

    def rewritten(self, text: str) -> str:
        """Return the page for the file system."""
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
        kept = {key: value for key, value in found.items() if not key.startswith("hx-")}
        texts = (f' {key}="{html.escape(value)}"' if value is not None else f" {key}" for key, value in kept.items())
        self.parts.append(f"<{tag}{''.join(texts)}>")

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
