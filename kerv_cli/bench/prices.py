"""Price decodes: what an action costs on a GPU, and how fast each family of methods can be.

Nothing is run and nothing is measured. This module needs no torch. `tables.py` turns the results into text. AR is
autoregressive decoding.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from kerv_cli.bench.described import Described
from kerv_cli.bench.expected import TABLES, Decodes, Drafts, Recorded, recorded
from kerv_cli.bench.physics import DEVICES, ENGINES, ROOFLINE, SHAPES, Device, Engine, Shape, priced
from kerv_cli.bench.settings import BenchSettings, EstimateSettings
from kerv_cli.engine.cost import Profile
from kerv_cli.report.profiles import NamedProfile, open_profiles

NO_TOKENS = (
    "speculation does not apply: the policy emits no action tokens, so there is nothing to draft. What applies: longer "
    "chunks (fewer decodes per second), and rollout.clock=real, which shows what its latency costs in success"
)


@dataclass(frozen=True)
class Family:
    """Methods that draft in the same way.

    Attributes:
        name: Name in the table.
        method: Method of `conf/method` that represents the family.
        drafts: How the methods draft in the fastest case. In this case they retrieve a draft and skip verification
            wherever they are allowed to.
        length: Published mean number of tokens committed per verification, for chunks of seven tokens. None if it is
            not published.
        reported: Speed against AR that the paper reports for its own machine. Empty if the paper reports none.
    """

    name: str
    method: str
    drafts: Drafts
    length: float | None = None
    reported: str = ""


_TREE = Drafts(5, 49)
FAMILIES = (
    Family("drafter, chain", "spec_vla", Drafts(15)),
    Family("drafter, tree", "spec_vla", _TREE, length=(3.63 + 3.91) / 2, reported="1.22–1.42"),
    Family("tree, then prediction", "kerv", _TREE, reported="1.27–1.37 × naive SD"),
    Family(
        "retrieval, then tree",
        "heisd",
        replace(_TREE, source="retrieval", retrieved=1.0, skipped=1.0),
        reported="up to 2.45",
    ),
    Family("one pass", "one_pass", Drafts(source="early", in_prefill=True)),
    Family("streak", "one_pass_streak", Drafts(15, source="early", in_prefill=True, skipped=1.0)),
    Family("unverified", "early_unverified", Drafts(source="early", skipped=1.0)),
)
"""Families of methods. The published length is Spec-VLA's, as HeiSD quotes it (docs/methods.md §2.3)."""
ACTION = 7
"""Number of tokens of one action of OpenVLA. Published lengths and times are for chunks of one action."""


def computed(policy: Described, device: Device) -> Iterator[NamedProfile]:
    """Yield the costs of a policy on a device, one profile for each engine. The profile has the engine's name."""
    shape, encoder = policy.shape, policy.encoder
    assert shape is not None
    for engine in ENGINES.values():
        profile, bounds = priced(shape, device, engine), {}
        for kind, rows in {"encode": 1, "prefill": shape.prompt, "verify": 1}.items():
            bounds[kind] = engine.bound(shape.needs(kind, rows), device)
        if encoder is not None:
            profile = replace(profile, phases={**profile.phases, "encode": ((1,), (encoder,))})
            bounds["encode"] = "given"
        elif not profile.seconds("encode", 1):
            bounds["encode"] = "none"
        yield NamedProfile(engine.name, profile, bounds)


def costs_of(settings: EstimateSettings, policy: Described | None) -> Iterator[tuple[str, NamedProfile]]:
    """Yield the title of a machine and the costs of a policy on it, for each machine and each engine.

    Without a policy, yield the title and the costs of each profile in `settings.on`.
    """
    if policy is None:
        for one in open_profiles(settings.results, settings.on):
            yield one.title, one
        return
    for name in dict.fromkeys(settings.device):
        for costs in computed(policy, DEVICES[name]):
            yield DEVICES[name].title, costs


@dataclass(frozen=True)
class Answer:
    """How fast a family of methods is, for one policy on one machine. Speeds are against AR: 2.0 means twice as fast.

    Attributes:
        family: Name of the family.
        method: Method that represents the family.
        ceiling: Speed if every draft token is accepted, and if verification is skipped in every decode in which the
            method may skip it.
        at_published_acceptance: Speed at the acceptance that the paper reports. None if the paper reports none.
        paper_reports: Speed that the paper reports for its own machine. None if the paper reports none.
        at_own_acceptance: Speed at the acceptance that kerv measured. None if the tables in results/tables have no
            such method.
        own_acceptance_from: The file in results/tables that holds the measured acceptance, and the row's label. None
            if `at_own_acceptance` is None.
        break_even_tokens: Accepted draft tokens per verification at which the family is as fast as AR. None if the
            family is always slower, or skips verification.
        is_verified: Whether the family never skips verification.
    """

    family: str
    method: str
    ceiling: float
    at_published_acceptance: float | None
    paper_reports: str | None
    at_own_acceptance: float | None
    own_acceptance_from: str | None
    break_even_tokens: float | None
    is_verified: bool


@dataclass(frozen=True)
class Estimate:
    """How fast speculative decoding can make a policy, for given costs of the policy's operations.

    Attributes:
        costs: Seconds of each operation of the policy's decodes.
        tokens: N, tokens of a chunk.
    """

    costs: NamedProfile
    tokens: int

    @property
    def seconds(self) -> float:
        """Seconds of one autoregressive decode."""
        return self.costs.profile.decode(self.tokens)

    @cached_property
    def parts(self) -> dict[str, tuple[float, str]]:
        """Maps each part of an autoregressive decode to its seconds and to what takes most of them."""
        profile, rest, parts = self.costs.profile, self.tokens - 1, {}
        for name, kind, seconds in (
            ("vision encoder", "encode", profile.seconds("encode", 1)),
            (f"prefill, {profile.prompt} tokens", "prefill", profile.seconds("prefill", profile.prompt)),
            (f"{rest} further token{'s' * (rest != 1)}", "verify", rest * profile.seconds("verify", 1)),
        ):
            parts[name] = seconds, self.costs.bounds.get(kind, "measured")
        return parts

    @property
    def encoder(self) -> float:
        """The vision encoder's share of an autoregressive decode."""
        return self.parts["vision encoder"][0] / self.seconds

    @cached_property
    def answers(self) -> list[Answer]:
        """The speeds of all families of methods that the profile can price."""
        profile, answers = self.costs.profile, []
        for family in FAMILIES:
            drafts, published, own, source, even = family.drafts, None, None, None, None
            if profile.lacks([drafts.source] if drafts.source else ["feed", "draft"]):
                continue
            best = Decodes(profile, self.tokens, drafts)
            if family.length is not None:
                paper = Decodes(profile, ACTION, drafts)
                published = best.speed([paper.acceptance_for(1 + (ACTION - 1) / family.length)])
            if (shown := closest(self.tokens, family)) is not None:
                chance = Decodes(profile, shown.tokens, shown.drafts).acceptance_for(shown.forwards)
                own = Decodes(profile, self.tokens, shown.drafts).speed([chance])
                source = f"results/tables/{shown.table}.csv, {shown.label}"
            if not drafts.skipped and (means := best.break_even()) is not None:
                even = means.accepted / means.verifications if means.verifications else 0.0
            speeds = best.speed([1.0]), published, family.reported or None, own, source, even
            answers.append(Answer(family.name, family.method, *speeds, not drafts.skipped))
        return answers


def closest(tokens: int, family: Family) -> Recorded | None:
    """Return a measured setting from results/tables for a family: same method, and same kind of draft (chain or tree).

    Tables are searched in order, those with a chunk length close to `tokens` tokens first. None if no table has such a
    setting.
    """
    for table in sorted(TABLES, key=lambda name: abs(TABLES[name] - tokens)):
        for one in recorded(table):
            if one.method == family.method and bool(one.drafts.nodes) == bool(family.drafts.nodes):
                return one
    return None


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
        """The time of one action that kerv computes for this device and engine, to compare with the published time.

        The unit is milliseconds.
        """
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
"""Published times of OpenVLA-7B. `tests/test_physics.py` compares them with `ours`. docs/measuring.md has both."""


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
        """The projection as values for JSON (docs/formats.md)."""
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


def projections(settings: BenchSettings) -> Iterator[Projection]:
    """Yield the times of the model `settings.projected`, for each device in `settings.projections` and each engine."""
    shape: Shape = SHAPES[settings.projected]
    for name, (bandwidth, flops) in settings.projections.items():
        title = DEVICES[name].title if name in DEVICES else name
        device = Device(title, bandwidth * 1e9, flops * 1e12)
        floors = priced(shape, device, ROOFLINE)
        for engine in ENGINES.values():
            chosen, end = replace(engine, share=settings.share), "" if engine.name == "tuned" else f"-{engine.name}"
            yield Projection(f"{name}-{shape.name}{end}", device, chosen, priced(shape, device, chosen), floors)
