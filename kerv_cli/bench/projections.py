"""Compute what a model's decodes cost on GPUs that are not here, and compare with published times. No torch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from kerv_cli.bench.physics import DEVICES, ENGINES, ROOFLINE, SHAPES, Device, Engine, priced
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.episodes.cost import EXTRA_ROUND, Profile

ACTION = 7  # tokens of one action of OpenVLA. Published times are of one action.


@dataclass(frozen=True)
class Anchor:
    """A published time of one action of OpenVLA-7B: one sequence, seven tokens, vision included.

    Attributes:
        device: Name in `DEVICES`.
        engine: The engine that was timed. It is `ROOFLINE` if the source computed the shortest possible time.
        low: Shortest published time, milliseconds.
        high: Longest published time, milliseconds.
        source: Who published the time.
        weight: Bytes per weight of the language model.
    """

    device: str
    engine: Engine
    low: float
    high: float
    source: str
    weight: float = 2.0

    @property
    def ours(self) -> float:
        shape = SHAPES["openvla-7b"]
        shape = replace(shape, sizes=replace(shape.sizes, weight=self.weight))
        return 1e3 * priced(shape, DEVICES[self.device], self.engine).decode(ACTION)


# Published times of OpenVLA-7B. `tests/test_physics.py` compares them with `ours`. docs/measuring.md has both.
ANCHORS = (
    Anchor("h100", ROOFLINE, 30.7, 30.7, "VLA-Perf (NVIDIA, arXiv 2602.18397): vision 0.56, prefill 4.1, tokens 26.0"),
    Anchor("a100", ROOFLINE, 55.1, 55.1, "VLA-Perf: vision 1.2, prefill 11.2, tokens 42.7"),
    Anchor("a100", ENGINES["eager"], 170, 199, "Hugging Face code; 174 = vision 8 + trunk 113 + system 53 (HeiSD)"),
    Anchor("4090", ENGINES["eager"], 162, 229, "Hugging Face code 162 (2026-07) and 229; SGLang 173"),
    Anchor("3090", ENGINES["eager"], 283, 283, "Hugging Face code (2026-07)"),
    Anchor("orin", ENGINES["tuned"], 345, 400, "2.5 to 2.9 actions per second in int4", weight=0.5),
)


@dataclass(frozen=True)
class Projection:
    """Computed times of a model's decodes on a device. Nothing was measured.

    The times follow from the model's shape, that is from the sizes of its layers and the lengths of its sequences.

    Attributes:
        name: Name of the profile, such as `a100-openvla-7b-eager`.
        device: The device.
        engine: The code that runs the model, such as `eager`.
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
            **({EXTRA_ROUND: True} if engine.extra_round else {}),
            "profile": profile,
        }


def projections(settings: BenchSettings) -> Iterator[Projection]:
    """Yield the times of the model `settings.projected`, for each device in `settings.projections` and each engine."""
    shape = SHAPES[settings.projected]
    for name, (bandwidth, flops) in settings.projections.items():
        title = DEVICES[name].title if name in DEVICES else name
        device = Device(title, bandwidth * 1e9, flops * 1e12)
        floors = priced(shape, device, ROOFLINE)
        for engine in ENGINES.values():
            chosen, end = replace(engine, share=settings.share), "" if engine.name == "tuned" else f"-{engine.name}"
            yield Projection(f"{name}-{shape.name}{end}", device, chosen, priced(shape, device, chosen), floors)


def projection_rows(computed: Iterable[Projection]) -> Iterator[dict[str, str]]:
    for one in computed:
        row = {"profile": one.name, "device": one.device.title, "engine": one.engine.name}
        row["encoder ms"] = f"{1e3 * one.profile.seconds('encode', 1):.2f}"
        row["one token ms"] = f"{1e3 * one.profile.seconds('verify', 1):.2f}"
        row["seven tokens ms"] = f"{1e3 * one.profile.decode(ACTION):.2f}"
        row["floor ms"] = f"{1e3 * one.floors.decode(ACTION):.2f}"
        yield row


def anchor_rows() -> Iterator[dict[str, str]]:
    for one in ANCHORS:
        row = {"device": DEVICES[one.device].title, "engine": one.engine.name}
        if one.weight < 1:
            row["engine"] += ", int4"
        row["published, ms"] = f"{one.low:g}" if one.low == one.high else f"{one.low:g}–{one.high:g}"
        yield row | {"ours, ms": f"{one.ours:.1f}", "source": one.source}
