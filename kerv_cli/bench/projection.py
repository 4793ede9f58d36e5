"""Write computed profiles of a shape on GPUs, and compare them with what others published. Nothing is measured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from kerv_cli.base.files import write_json
from kerv_cli.base.places import results_dir
from kerv_cli.bench.physics import DEVICES, ENGINES, ROOFLINE, SHAPES, Device, Engine, Shape, priced
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.engine.cost import Profile

ACTION = 7
"""Number of tokens of one action of OpenVLA."""


@dataclass(frozen=True)
class Anchor:
    """A published time of one action of OpenVLA-7B: one sequence, seven tokens, vision included.

    Attributes:
        device: Name in `DEVICES`.
        engine: The engine, or `ROOFLINE`.
        low: Shortest published time, milliseconds.
        high: Longest published time, milliseconds.
        source: Who published it.
        weight: Bytes of a weight of the language model.
    """

    device: str
    engine: Engine
    low: float
    high: float
    source: str
    weight: float = 2.0

    @property
    def ours(self) -> float:
        """The computed time, milliseconds."""
        shape = SHAPES["openvla-7b"]
        shape = replace(shape, sizes=replace(shape.sizes, weight=self.weight))
        return 1e3 * priced(shape, DEVICES[self.device], self.engine).decode(ACTION)


ANCHORS = (
    Anchor("h100", ROOFLINE, 30.7, 30.7, "VLA-Perf (NVIDIA, arXiv 2602.18397): vision 0.56, prefill 4.1, tokens 26.0"),
    Anchor("a100", ROOFLINE, 55.1, 55.1, "VLA-Perf: vision 1.2, prefill 11.2, tokens 42.7"),
    Anchor("a100", ENGINES["eager"], 170, 199, "Hugging Face code; 174 = vision 8 + trunk 113 + system 53 (HeiSD)"),
    Anchor("4090", ENGINES["eager"], 162, 229, "Hugging Face code 162 (2026-07) and 229; SGLang 173"),
    Anchor("3090", ENGINES["eager"], 283, 283, "Hugging Face code (2026-07)"),
    Anchor("orin", ENGINES["tuned"], 345, 400, "2.5 to 2.9 actions per second in int4", weight=0.5),
)
"""Published times of OpenVLA-7B. `tests/test_physics.py` compares them with ours, docs/measuring.md prints them."""

ANCHOR_COLUMNS = ("device", "engine", "published, ms", "ours, ms", "source")


def anchor_rows() -> list[tuple[str, ...]]:
    """Return a row per published time with the columns ANCHOR_COLUMNS."""
    return [
        (
            DEVICES[one.device].title,
            one.engine.name + (", int4" if one.weight < 1 else ""),
            f"{one.low:g}" if one.low == one.high else f"{one.low:g}–{one.high:g}",
            f"{one.ours:.1f}",
            one.source,
        )
        for one in ANCHORS
    ]


@dataclass(frozen=True)
class Projection:
    """The computed times of a shape on a device with an engine.

    Attributes:
        name: Name of the profile, such as `a100-openvla-7b-eager`.
        device: The device.
        engine: The engine.
        profile: Seconds of each phase of a decode.
        floors: The shortest seconds that the device allows, for the same phases.
    """

    name: str
    device: Device
    engine: Engine
    profile: Profile
    floors: Profile

    @property
    def document(self) -> dict[str, Any]:
        """The projection for JSON (docs/formats.md)."""
        profile = self.profile.as_dict()
        for costs in profile["phases"].values():
            costs["seconds"] = [float(f"{seconds:.4g}") for seconds in costs["seconds"]]
        device, engine = self.device, self.engine
        published = f"{device.bandwidth / 1e9:g} GB/s, {device.flops / 1e12:g} TFLOP/s"
        return {
            "target": self.profile.about["target"],
            "dtype": "bfloat16",
            "device_name": device.title,
            "engine": engine.name,
            "projected": True,
            "from": f"{published}, {100 * engine.share:.0f} % of both; {engine.source}",
            "encoder_floor": float(f"{self.floors.seconds('encode', 1):.4g}"),
            "encoder_system": engine.system,
            "profile": profile,
        }

    @property
    def row(self) -> tuple[str, ...]:
        """Row with the columns PROJECTION_COLUMNS."""
        encoder, token = self.profile.seconds("encode", 1), self.profile.seconds("verify", 1)
        times = (encoder, token, self.profile.decode(ACTION), self.floors.decode(ACTION))
        return (self.name, self.device.title, self.engine.name, *(f"{1e3 * seconds:.2f}" for seconds in times))


PROJECTION_COLUMNS = ("profile", "device", "engine", "encoder ms", "one token ms", "seven tokens ms", "floor ms")


def projections(settings: BenchSettings) -> Iterator[Projection]:
    """Yield the times of the shape `settings.projected`, on each of its devices with each engine."""
    shape: Shape = SHAPES[settings.projected]
    for name, (bandwidth, flops) in settings.projections.items():
        title = DEVICES[name].title if name in DEVICES else name
        device = Device(title, bandwidth * 1e9, flops * 1e12)
        floors = priced(shape, device, ROOFLINE)
        for engine in ENGINES.values():
            chosen, end = replace(engine, share=settings.share), "" if engine.name == "tuned" else f"-{engine.name}"
            yield Projection(f"{name}-{shape.name}{end}", device, chosen, priced(shape, device, chosen), floors)


def write(settings: BenchSettings, projection: Projection) -> Path:
    """Write a computed profile as a JSON file. Return its path."""
    path = results_dir(settings.results) / "bench" / f"{projection.name}-profile.json"
    write_json(path, projection.document)
    return path
