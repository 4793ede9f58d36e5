"""Write the board's pages as files that a browser opens without a server, and that can be sent to a colleague.

The web app is called directly. Links lead to the written files. A link to a page that is not exported becomes text.
"""

from __future__ import annotations

import asyncio
import html
import os
import re
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urljoin, urlsplit

from starlette.applications import Starlette
from starlette.datastructures import Headers

from kerv_cli.base.errors import KervError
from kerv_cli.board.app import make_app
from kerv_cli.lab.database import Database

# Episodes that get a page
MOST_EPISODES = 400
# Once the exported films have this many bytes in all, further films are left out.
MOST_FILM_BYTES = 8_000_000


def export_board(
    database: Database,
    names: Collection[str],
    folder: Path,
    advance: Callable[[int, int, str], None],
) -> list[Path]:
    """Write the pages of a board into an empty folder, and return the paths of the files, `index.html` first.

    Args:
        names: Ids of the runs to export. If empty, all runs are exported.
        advance: Called before each page, with the number of finished pages, the number of all pages that are known so
            far, and the page's address.
    """
    app = make_app(database)
    app.state.only, app.state.live = frozenset(names), False
    pages = _collected(app, advance)
    written = []
    for address, content in pages.items():
        path = folder / file_of(address)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(_as_file(address, content, pages).encode() if isinstance(content, str) else content)
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


def _asked(app: Starlette, address: str) -> tuple[int, str, bytes]:
    """Send a GET request to the app. Return status, media type and content of the answer."""
    parts = urlsplit(address)
    sent: list[Any] = []

    async def receive() -> Any:
        await asyncio.Event().wait()  # nobody disconnects

    async def send(message: Any) -> None:
        sent.append(message)

    path, query, headers = unquote(parts.path), parts.query.encode(), [(b"host", b"localhost")]
    scope = {"type": "http", "method": "GET", "path": path, "query_string": query, "headers": headers, "root_path": ""}
    with ThreadPoolExecutor(1) as thread:  # this thread may have an event loop
        thread.submit(asyncio.run, app(scope, receive, send)).result()
    start, *rest = sent
    content = b"".join(message.get("body", b"") for message in rest)
    return start["status"], Headers(raw=start["headers"])["content-type"], content


def _collected(app: Starlette, advance: Callable[[int, int, str], None]) -> dict[str, str | bytes]:
    """Return the first page and all pages and files that it leads to, by address. Failed answers are left out.

    Parts that a browser loads later (`hx-trigger="load"`) are put into their page.
    """
    pages: dict[str, str | bytes] = {}
    waiting, films, episodes = ["/"], 0, 0
    seen = set(waiting)
    while waiting:
        address = waiting.pop(0)
        advance(len(seen) - len(waiting) - 1, len(seen), address)
        is_film = file_of(address).endswith(".gif")
        if is_film and films >= MOST_FILM_BYTES:
            continue
        status, kind, content = _asked(app, address)
        if status != 200:
            if address == "/":
                raise KervError(f"the board cannot show its first page: {content.decode()[:200]}")
            continue
        pages[address] = content
        films += len(content) if is_film else 0
        if not kind.startswith("text/html"):
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
    late = re.search(r'<(section) id="(\w+)"[^>]* hx-get="([^"]+)" hx-trigger="load".*?</section>', text, re.DOTALL)
    if late is None:
        return text
    _, _, part = _asked(app, urljoin(address, html.unescape(late[3])))
    return text.replace(late[0], part.decode())


def _plain(address: str, link: str) -> str:
    path = urlsplit(urljoin(address, link)).path
    return re.sub(r"^(/episodes/\d+)/frames/\d+$", r"\1/film.gif", path)


def _links(address: str, text: str) -> list[str]:
    found = re.findall(r'<(?:a|link|script|img)\b[^>]*?\b(?:href|src)="(?!data:)([^"?#][^"]*)"', text)
    return list(dict.fromkeys(_plain(address, html.unescape(one)) for one in found))


def _as_file(address: str, text: str, pages: Collection[str]) -> str:
    """Rewrite a page of the board so that it works as a file, beside the exported `pages`."""
    folder = Path(file_of(address)).parent

    def target(link: str) -> str:
        path = _plain(address, html.unescape(link))
        if link.startswith(("?", "#")) or path not in pages:
            return ""
        return quote(Path(os.path.relpath(file_of(path), folder)).as_posix())

    def anchor(found: re.Match[str]) -> str:
        before, link, after, content = found.groups()
        place = target(link)
        return f'<a{before} href="{place}"{after}>{content}</a>' if place else f"<span{before}{after}>{content}</span>"

    def loaded(found: re.Match[str]) -> str:
        start, link, end = found.groups()
        place = link if link.startswith("data:") else target(link)
        return f"{start}{place}{end}" if place else ""

    text = re.sub(r'\shx-[\w-]+="[^"]*"', "", text)
    text = re.sub(r'<a\b([^>]*?) href="([^"]*)"([^>]*)>(.*?)</a>', anchor, text, flags=re.DOTALL)
    return re.sub(r'(<(?:link|script|img)\b[^>]*? (?:href|src)=")([^"]*)("[^>]*>)', loaded, text)
