"""Make the film of README.md: one episode under several settings of a study, in the time that inference takes.

    python scripts/film.py STUDY TASK SEED OUT.webp SETTING… [--results DIR]

Each robot moves when its decode is done; the simulator's time is left out. Under it, a column of squares per decode,
a square per token. Episodes are recorded first if they have no recording.
"""

from __future__ import annotations

import argparse
import io
import itertools
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from kerv_cli.board.recorder import record_episode
from kerv_cli.catalogue.episodes import find_episode, outcomes
from kerv_cli.lab.database import opened
from kerv_cli.lab.store import Study, loaded
from kerv_cli.report.viewing.token_outcomes import OUTCOMES, TokenOutcome, chunk_size, outcomes_of
from kerv_cli.report.viewing.viewer import film_of

SIDE, GAP, SQUARE, HEADER, FOOTER = 176, 8, 8, 22, 24
"""Pixels: edge of an image, gap between panels, edge of a token, height of the title and of the line of numbers."""
FPS, SLOWER, STILL = 10, 1, 2.5
"""Frames per second; how many times slower than inference the film plays; seconds that the last frame stays."""
BACK, TEXT, WON = (24, 26, 30), (235, 235, 235), (123, 203, 143)


@dataclass(frozen=True)
class Panel:
    """One episode as the film shows it.

    Attributes:
        label: Name of the setting.
        success: Whether it solved the task.
        ends: Seconds of inference until the end of each decode.
        steps: Control steps executed until the end of each decode.
        forwards: Forwards of the target until the end of each decode.
        chunks: What happened to each token, by decode.
        frames: Camera images, one before the first control step and one after each.
    """

    label: str
    success: bool
    ends: list[float]
    steps: list[int]
    forwards: list[int]
    chunks: list[list[TokenOutcome]]
    frames: list[Image.Image]


def read_panel(store: Study, label: str, task: str, seed: int) -> Panel:
    """Read an episode and its recording, which is made if it is missing."""
    (row,) = [one for one in outcomes(store, task, seed) if one.label == label and one.episode is not None]
    found = find_episode(store.database, row.episode)
    if not found.recording.exists():
        error = record_episode(found)
        if error:
            raise SystemExit(error)
    decodes, starts = found.decodes()
    images = [Image.open(io.BytesIO(frame)).convert("RGB") for frame in film_of(found.recording).frames]
    dofs = decodes[0].actions.shape[1]
    size = chunk_size(decodes, dofs)
    return Panel(
        label,
        bool(row.success),
        list(itertools.accumulate(one.seconds for one in decodes)),
        [start + len(one.actions) for start, one in zip(starts, decodes, strict=True)],
        list(itertools.accumulate(one.forwards for one in decodes)),
        [outcomes_of(one, size, dofs) for one in decodes],
        [image.resize((SIDE, SIDE)) for image in images],
    )


def draw_panel(draw: ImageDraw.ImageDraw, canvas: Image.Image, panel: Panel, left: int, seconds: float) -> None:
    """Draw a panel as it is after so many seconds of inference."""
    done = sum(end <= seconds for end in panel.ends)
    over = done == len(panel.ends)
    step = panel.steps[done - 1] if done else 0
    canvas.paste(panel.frames[min(step, len(panel.frames) - 1)], (left, HEADER))
    colour = WON if over and panel.success else TEXT
    draw.text((left, 3), panel.label, fill=colour, font=ImageFont.load_default(13))
    shown = SIDE // SQUARE
    for column, chunk in enumerate(panel.chunks[max(0, done - shown) : done]):
        for line, one in enumerate(chunk):
            x, y = left + column * SQUARE, HEADER + SIDE + 4 + line * SQUARE
            draw.rectangle((x, y, x + SQUARE - 2, y + SQUARE - 2), fill=f"#{OUTCOMES[one.kind].color >> 8:06x}")
    passed = min(seconds, panel.ends[-1])
    text = f"{passed:.1f} s   {panel.forwards[done - 1] if done else 0} forwards"
    bottom = HEADER + SIDE + 6 + len(panel.chunks[0]) * SQUARE
    draw.text((left, bottom), text, fill=colour, font=ImageFont.load_default(12))


def make_film(panels: list[Panel]) -> bytes:
    """Return the film as an animated WebP that plays again and again."""
    width = len(panels) * (SIDE + GAP) + GAP
    height = HEADER + SIDE + 6 + len(panels[0].chunks[0]) * SQUARE + FOOTER
    pictures = []
    for number in range(int(FPS * SLOWER * max(panel.ends[-1] for panel in panels)) + 2):
        canvas = Image.new("RGB", (width, height), BACK)
        draw = ImageDraw.Draw(canvas)
        for index, panel in enumerate(panels):
            draw_panel(draw, canvas, panel, GAP + index * (SIDE + GAP), number / FPS / SLOWER)
        pictures.append(canvas)
    times = [1000 // FPS] * (len(pictures) - 1) + [int(1000 * STILL)]
    buffer = io.BytesIO()
    first, *others = pictures
    first.save(buffer, "webp", save_all=True, append_images=others, duration=times, loop=0, quality=55, method=6)
    return buffer.getvalue()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("study")
    parser.add_argument("task")
    parser.add_argument("seed", type=int)
    parser.add_argument("out", type=Path)
    parser.add_argument("settings", nargs="+")
    parser.add_argument("--results", type=Path, default=Path("results"))
    given = parser.parse_args()
    study = loaded(Study(opened(given.results), given.study))
    given.out.write_bytes(make_film([read_panel(study, name, given.task, given.seed) for name in given.settings]))
    print(f"{given.out}: {given.out.stat().st_size // 1000} kB")
