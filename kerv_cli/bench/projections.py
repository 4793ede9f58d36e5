"""Compute what a model's decodes cost on GPUs that this machine lacks. It needs no torch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from kerv_cli.bench.physics import DEVICES, ENGINES, ROOFLINE, SHAPES, SHARE, Device, Engine, priced
from kerv_cli.bench.settings import BenchSettings
from kerv_cli.episodes.cost import EXTRA_ROUND, Profile

ACTION = 7  # tokens of one action of OpenVLA. Published times are of one action.


@dataclass(frozen=True)
class Projection:
    """Computed times of a model's decodes on a device. Nothing was measured.

    The times follow from the model's shape, that is from the sizes of its layers and the lengths of its sequences.
    """

    name: str  # name of the profile, such as `a100-openvla-7b-eager`
    device: Device
    engine: Engine
    profile: Profile  # seconds of each phase of a decode
    floors: Profile  # the shortest seconds that the device allows, for the same phases

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
            end += "" if settings.share == SHARE else f"-share{settings.share:g}"  # the usual file stays
            yield Projection(f"{name}-{shape.name}{end}", device, chosen, priced(shape, device, chosen), floors)


def projection_rows(computed: Iterable[Projection]) -> Iterator[dict[str, str]]:
    for one in computed:
        row = {"profile": one.name, "device": one.device.title, "engine": one.engine.name}
        row["encoder ms"] = f"{1e3 * one.profile.seconds('encode', 1):.2f}"
        row["one token ms"] = f"{1e3 * one.profile.seconds('verify', 1):.2f}"
        row["seven tokens ms"] = f"{1e3 * one.profile.decode(ACTION):.2f}"
        row["floor ms"] = f"{1e3 * one.floors.decode(ACTION):.2f}"
        yield row
