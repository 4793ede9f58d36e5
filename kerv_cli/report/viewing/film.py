"""A recording as a film for papers and slides: the camera, and below it the decode's strip, a cell per token."""

from __future__ import annotations

import io
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from kerv_cli.base.errors import KervError, UsageError
from kerv_cli.base.files import write_bytes
from kerv_cli.report.viewing.token_outcomes import OUTCOMES
from kerv_cli.report.viewing.viewer import chunks_of

SUFFIXES = (".gif", ".mp4")
RATE = 20
"""Pictures per second of simulated time, at most."""
PICTURE = 480  # pixels of its longer side, at least
ROW = 22  # pixels of a line of the strip
BACKGROUND = (13, 16, 17)

Font = ImageFont.ImageFont | ImageFont.FreeTypeFont
Track = list[tuple[int, float, Any]]
"""(control step, simulated seconds, value) of an entity, in order."""


def save_film(recording: Path, path: Path) -> Path:
    """Writes the film, in simulated time -> `path`. The ending decides the format: .gif, or .mp4 (H.264).

    Raises:
        UsageError: another ending, or a recording without a camera. KervError: the recording is damaged, or PyAV is not
            installed. StorageError: writing failed.
    """
    if path.suffix not in SUFFIXES:
        raise UsageError(f"--to {path}: name a file that ends in {' or '.join(SUFFIXES)}")
    tracks = _tracks(recording)
    camera = tracks.get("/camera", [])
    if len(camera) < 2:
        raise UsageError(f"{recording} shows no camera: roll out again with record=1")
    seconds = camera[-1][1] / len(camera)
    stride = max(1, round(1 / (RATE * seconds)))
    pictures = [_picture(frame, step, tracks) for step, _, frame in camera[::stride]]
    encode = _gif if path.suffix == ".gif" else _mp4
    write_bytes(path, encode(pictures, stride * seconds))
    return path


def _tracks(recording: Path) -> dict[str, Track]:
    """Entity -> its track, of the camera, the modes, the forwards and the lanes of tokens."""
    values = {"/camera": "EncodedImage:blob", "/mode": "StateChange:state", "/decode/forwards": "Scalars:scalars"}
    tracks: dict[str, Track] = {}
    for chunk in chunks_of(recording):
        name = "StateChange:state" if chunk.entity_path.startswith("/tokens/") else values.get(chunk.entity_path, "")
        batch = chunk.to_record_batch()
        if name in batch.schema.names and not chunk.is_static:
            steps, times = batch["step"].to_pylist(), batch["time"].cast("int64").to_numpy() / 1e9
            cells = (cell[0] for cell in batch[name].to_pylist())
            tracks.setdefault(chunk.entity_path, []).extend(zip(steps, times.tolist(), cells, strict=True))
    for track in tracks.values():
        track.sort(key=lambda row: row[0])
    return tracks


def _at(track: Track, step: int) -> Any:
    """The value that holds at a control step; None before the first."""
    count = bisect_right(track, step, key=lambda row: row[0])
    return track[count - 1][2] if count else None


def _picture(frame: Iterable[int], step: int, tracks: Mapping[str, Track]) -> Image.Image:
    """One picture of the film. frame: the camera's JPEG."""
    view = Image.open(io.BytesIO(bytes(frame))).convert("RGB")
    scale = max(1, -(-PICTURE // max(view.size)))
    view = view.resize((view.width * scale, view.height * scale), Image.Resampling.LANCZOS)
    lanes = [name for name in tracks if name.startswith("/tokens/")]
    steps = sorted({int(name.split("/")[2].removeprefix("step_")) for name in lanes})
    high = ROW * (1 + len(steps)) + 6
    picture = Image.new(
        "RGB", (view.width + view.width % 2, (view.height + high + 1) // 2 * 2), BACKGROUND
    )  # H.264: even
    picture.paste(view)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(13)
    forwards = _at(tracks.get("/decode/forwards", []), step)
    count = "" if forwards is None else f", {forwards:.0f} forward{'s' * (forwards != 1)}"
    draw.text((6, view.height + 4), f"step {step}: {_at(tracks.get('/mode', []), step) or ''}{count}", "white", font)
    for row, number in enumerate(steps):
        of_step = [name for name in lanes if name.split("/")[2] == f"step_{number}"]
        wide = view.width / len(of_step)
        for column, name in enumerate(of_step):
            _cell(draw, font, _at(tracks[name], step), column * wide, view.height + ROW * (row + 1), wide)
    return picture


def _cell(draw: ImageDraw.ImageDraw, font: Font, kind: str | None, x: float, y: float, wide: float) -> None:
    if kind not in OUTCOMES:
        return
    colour = tuple(OUTCOMES[kind].color >> shift & 0xFF for shift in (24, 16, 8))
    draw.rounded_rectangle((x + 2, y + 2, x + wide - 2, y + ROW - 2), 4, colour)
    dark = sum(colour) < 330
    draw.text((x + wide / 2, y + ROW / 2), kind, "white" if dark else "black", font, anchor="mm")


def _gif(pictures: list[Image.Image], seconds: float) -> bytes:
    buffer = io.BytesIO()
    first, *rest = (picture.quantize(128) for picture in pictures)
    first.save(buffer, "GIF", save_all=True, append_images=rest, duration=max(20, round(1000 * seconds)), loop=0)
    return buffer.getvalue()


def _mp4(pictures: list[Image.Image], seconds: float) -> bytes:
    try:
        import av
    except ImportError as error:
        raise KervError("an .mp4 needs PyAV: pip install 'kerv[lerobot]', or name a .gif") from error
    from fractions import Fraction

    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as film:
        stream = film.add_stream("libx264", rate=Fraction(1 / seconds).limit_denominator(1000))
        stream.width, stream.height = pictures[0].size
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "18"}
        for picture in pictures:
            film.mux(stream.encode(av.VideoFrame.from_image(picture)))
        film.mux(stream.encode())
    return buffer.getvalue()
