"""The page of one episode: its film, the outcome of every token, its times, and the button that records it."""

from __future__ import annotations

import functools
import itertools
import os
import re
import shlex
import signal
import socket
import subprocess
import time
import urllib.request
from collections import Counter
from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any
from urllib.error import URLError
from urllib.parse import quote

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from kerv_cli.base.errors import KervError
from kerv_cli.board.pages import CONTENT_POLICY, database_of, inside, render
from kerv_cli.board.recorder import RECORDER
from kerv_cli.catalogue.episodes import FoundEpisode, find_episode, outcomes
from kerv_cli.engine.record import PHASES, DecodeRecord
from kerv_cli.report.tables import dof_names
from kerv_cli.report.viewing.token_outcomes import OUTCOMES, chunk_size, outcomes_of, token_names, tokens_hash
from kerv_cli.report.viewing.viewer import Film, animation, film_of, viewer_command

# Factor by which a film plays slower than the robot moves
SLOWER = 2


def _found(request: Request) -> FoundEpisode:
    return find_episode(database_of(request), request.path_params["id"])


def _film(request: Request) -> Film:
    return film_of(inside(request, _found(request).recording))


def command_of(found: FoundEpisode) -> tuple[str, str]:
    """Return the command that repeats an episode, or why no command does: (command, "") or ("", reason)."""
    from kerv_cli.episodes.resolve import repeating_words

    episode, results = found.episode, str(found.store.database.results)
    setting, seeds = episode.setting, [*found.earlier, episode.seed]
    try:
        words = repeating_words(setting, episode.task, seeds)
    except KervError as error:
        return "", str(error)
    return shlex.join(["kerv", *words, *([] if results == "results" else [f"results={results}"])]), ""


def show_episode(request: Request) -> Response:
    """Show one episode. `?decode=N` chooses a decode."""
    found = _found(request)
    (decodes, steps), episode, row = found.decodes(), found.episode, found.row
    number = max((decode.actions.shape[1] for decode in decodes if decode.actions.ndim == 2), default=1)
    dofs = dof_names(episode.task, number)
    names = token_names(decodes, dofs)
    size = chunk_size(decodes, len(names))
    chunks = [outcomes_of(decode, size, len(names)) for decode in decodes]
    counts = Counter(map(attrgetter("kind"), itertools.chain.from_iterable(chunks)))
    command, why_not = command_of(found)
    text = request.query_params.get("decode", "")
    chosen = int(text) if re.fullmatch(r"\d{1,6}", text) and int(text) < len(decodes) else 0
    return render(
        request,
        "episode.html",
        decodes=list(zip(decodes, steps, chunks, strict=True)),
        names=names,
        is_coded=names is not dofs,
        counts=counts,
        styles=OUTCOMES,
        phases=_phases(row),
        others=[one for one in outcomes(found.store, episode.task, episode.seed) if one.episode is not None],
        command=command,
        why_not=why_not,
        chosen=chosen,
        **_film_values(request, found, steps[chosen] if steps else 0, decodes),
    )


def _phases(row: Mapping[str, Any]) -> dict[str, float]:
    if served := row["server_seconds"]:
        return {"policy's server": served, "the way to it and back": row["seconds"] - served}
    return {phase: row[f"seconds.{phase}"] for phase in PHASES if row[f"seconds.{phase}"]}


def _film_values(
    request: Request, found: FoundEpisode, step: int = 0, decodes: Sequence[DecodeRecord] | None = None
) -> dict[str, Any]:
    job = RECORDER.jobs.get(found.recording)
    values: dict[str, Any] = {"found": found, "step": step, "job": job, "film": None, "same": None, "rerun": ""}
    values["slower"] = SLOWER
    if found.recording.exists() and (job is None or job.future.done()):
        film = film_of(inside(request, found.recording))
        values["same"] = film.facts.get("tokens") == tokens_hash(found.decodes()[0] if decodes is None else decodes)
        address = f"{request.base_url}episodes/{found.id}/recording.rrd"
        values |= {"film": film, "rerun": f"/rerun/?url={quote(address, safe='')}"}
    return values


def show_film(request: Request) -> Response:
    """Show an episode's film, or the button that records it, or for how long its recording has been running."""
    return render(request, "episode_film.html", **_film_values(request, _found(request)))


def record(request: Request) -> Response:
    RECORDER.record(_found(request))
    return show_film(request)


_FOREVER = {"cache-control": "max-age=86400"}


def frame(request: Request) -> Response:
    """Return the film's image after the control step that the address names. Image 0 shows the start."""
    frames, step = _film(request).frames, request.path_params["step"]
    if step >= len(frames):
        raise HTTPException(404, f"the film has {len(frames)} frames, numbered from 0")
    return Response(frames[step], media_type="image/jpeg", headers=_FOREVER)


def animated(request: Request) -> Response:
    film = _film(request)
    if not film.frames:
        raise HTTPException(404, "the recording has no camera")
    return Response(animation(film, SLOWER), media_type="image/webp")


def recording(request: Request) -> Response:
    path = inside(request, _found(request).recording)
    return FileResponse(path, media_type="application/octet-stream", filename=path.name)


_VIEWER_FILES = ("", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico")
_VIEWER_SECONDS = 20.0
# Content security policy of Rerun's viewer: a WebAssembly program with a script in its page
_VIEWER_CONTENT = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' data: blob:; worker-src 'self' blob:; "
    "base-uri 'none'; frame-ancestors 'none'"
)


@functools.cache
def viewer_files() -> dict[str, tuple[bytes, str]]:
    """Return content and media type of each file of Rerun's web viewer, by the file's name.

    Only the web server in Rerun's package offers these files. It is started for a moment, and only this machine can
    reach it.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # with the address of a recording it serves no data of its own
    options = ["--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", str(port), "http://127.0.0.1/none.rrd"]
    nothing = subprocess.DEVNULL
    with subprocess.Popen([*viewer_command(), *options], stdout=nothing, stderr=nothing, start_new_session=True) as own:
        try:
            return {name: _fetched(f"http://127.0.0.1:{port}/{name}") for name in _VIEWER_FILES}
        finally:
            os.killpg(own.pid, signal.SIGKILL)


def _fetched(address: str) -> tuple[bytes, str]:
    end = time.monotonic() + _VIEWER_SECONDS
    while True:
        try:
            with urllib.request.urlopen(address, timeout=_VIEWER_SECONDS) as answer:
                content, kind = answer.read(), answer.headers.get_content_type()
            break
        except (URLError, OSError) as error:
            if time.monotonic() > end:
                raise KervError(f"Rerun's web viewer does not start: {error}") from error
            time.sleep(0.1)
    if kind == "text/html":
        content = re.sub(rb'<link[^>]*"https://fonts\.[^>]*>', b"", content)  # the board needs no network
    return content, kind


def viewer(request: Request) -> Response:
    name = request.path_params["name"]
    if name not in _VIEWER_FILES:
        raise HTTPException(404, "Rerun's viewer has no such file")
    content, kind = viewer_files()[name]
    return Response(content, media_type=kind, headers=_FOREVER | {CONTENT_POLICY: _VIEWER_CONTENT})


ROUTES = [
    Route("/episodes/{id:int}", show_episode),
    Route("/episodes/{id:int}/film", show_film),
    Route("/episodes/{id:int}/record", record, methods=["POST"]),
    Route("/episodes/{id:int}/frames/{step:int}", frame),
    Route("/episodes/{id:int}/film.webp", animated),
    Route("/episodes/{id:int}/recording.rrd", recording),
    Route("/rerun/{name:path}", viewer),
]
