"""Turn a recording into a film for papers and slides.

The film shows the camera and, below it, one cell per token of the current decode.
"""

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
from kerv_cli.report.viewing.viewer import read_chunks

RATE = 20
"""Largest number of pictures per second of simulated time."""
PICTURE = 480  # least pixels of a picture's longer side
ROW = 22  # height in pixels of a row of tokens
BACKGROUND = (13, 16, 17)

Track = list[tuple[int, float, Any]]
"""Values of one entity (a named series in a recording), in order: (control step, simulated seconds, value)."""


def save_film(recording: Path, path: Path) -> Path:
    """Write a recording as a film and return the film's path. It plays in simulated time.

    Args:
        recording: The .rrd file.
        path: The film, which ends in .gif or .mp4 (H.264).

    Raises:
        UsageError: `path` has another ending, or the recording has no camera.
        KervError: The recording is damaged, or PyAV (needed for .mp4) is not installed.
        StorageError: Writing failed.
    """
    encoders = {".gif": _gif, ".mp4": _mp4}
    if path.suffix not in encoders:
        raise UsageError(f"--to {path}: name a file that ends in {' or '.join(encoders)}")
    tracks = _tracks(recording)
    camera = tracks.get("/camera", [])
    if len(camera) < 2:
        raise UsageError(f"{recording} has no camera images: run the rollout again with record=1")
    seconds = camera[-1][1] / len(camera)
    stride = max(1, round(1 / (RATE * seconds)))
    pictures = [_picture(frame, step, tracks) for step, _, frame in camera[::stride]]
    write_bytes(path, encoders[path.suffix](pictures, stride * seconds))
    return path


def _tracks(recording: Path) -> dict[str, Track]:
    """Read the values over time of camera, mode, forwards and tokens, by entity (a series' name in the recording)."""
    values = {"camera": "EncodedImage:blob", "mode": "StateChange:state", "decode": "Scalars:scalars"}
    values["tokens"] = values["mode"]
    tracks: dict[str, Track] = {}
    for chunk in read_chunks(recording)[1]:
        batch, name = chunk.to_record_batch(), values.get(chunk.entity_path.split("/")[1])
        if name in batch.schema.names and not chunk.is_static:
            steps, times = batch["step"].to_pylist(), batch["time"].cast("int64").to_numpy() / 1e9
            cells = (cell[0] for cell in batch[name].to_pylist())
            tracks.setdefault(chunk.entity_path, []).extend(zip(steps, times.tolist(), cells, strict=True))
    return {entity: sorted(track, key=lambda row: row[0]) for entity, track in tracks.items()}


def _value(track: Track, step: int) -> Any:
    """Return the latest value at a control step, or None before the first value."""
    count = bisect_right(track, step, key=lambda row: row[0])
    return track[count - 1][2] if count else None


def _picture(frame: Iterable[int], step: int, tracks: Mapping[str, Track]) -> Image.Image:
    """Return one picture of the film.

    Args:
        frame: The camera's image, as the bytes of a JPEG file.
        step: Control step of the image.
        tracks: Values of the recording, from `_tracks`.
    """
    view = Image.open(io.BytesIO(bytes(frame))).convert("RGB")
    scale = max(1, -(-PICTURE // max(view.size)))
    view = view.resize((view.width * scale, view.height * scale), Image.Resampling.LANCZOS)
    lines: dict[int, list[str]] = {}  # control step of the chunk -> entities of its tokens
    for name in tracks:
        if name.startswith("/tokens/"):
            lines.setdefault(int(name.split("/")[2].removeprefix("step_")), []).append(name)
    height = view.height + ROW * (1 + len(lines)) + 6
    picture = Image.new("RGB", (view.width + view.width % 2, height + height % 2), BACKGROUND)  # H.264: even
    picture.paste(view)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(13)
    mode, forwards = (_value(tracks.get(name, []), step) for name in ("/mode", "/decode/forwards"))
    draw.text((6, view.height + 4), f"step {step}: {mode or ''}, forwards: {forwards or 0:.0f}", "white", font)
    for line, number in enumerate(sorted(lines), 1):
        width = view.width / len(lines[number])
        for column, name in enumerate(lines[number]):
            kind, x, y = _value(tracks[name], step), column * width, view.height + ROW * line
            if kind in OUTCOMES:
                colour = tuple(OUTCOMES[kind].color >> shift & 0xFF for shift in (24, 16, 8))
                draw.rounded_rectangle((x + 2, y + 2, x + width - 2, y + ROW - 2), 4, colour)
                ink = "white" if sum(colour) < 330 else "black"
                draw.text((x + width / 2, y + ROW / 2), kind, ink, font, anchor="mm")
    return picture


def _gif(pictures: list[Image.Image], seconds: float) -> bytes:
    """Return the pictures as a GIF file. `seconds` is the duration of each."""
    buffer = io.BytesIO()
    first, *rest = (picture.quantize(128) for picture in pictures)
    first.save(buffer, "GIF", save_all=True, append_images=rest, duration=max(20, round(1000 * seconds)), loop=0)
    return buffer.getvalue()


def _mp4(pictures: list[Image.Image], seconds: float) -> bytes:
    """Return the pictures as an MP4 file. `seconds` is the duration of each."""
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
