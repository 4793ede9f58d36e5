"""Compute how much verified drafts can speed up a policy, from its size or from measured costs. It needs no torch."""

from __future__ import annotations

import bisect
import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kerv_cli.base.errors import UsageError
from kerv_cli.bench.physics import DEVICES, ENGINES, INSTRUCTION, SHAPES, Shape, encoder_of_weights, priced, vla_shape
from kerv_cli.bench.settings import EstimateSettings
from kerv_cli.episodes.cost import EXTRA_ROUND, Profile
from kerv_cli.report.profiles import NamedProfile, open_profiles
from kerv_cli.targets.openvla.config import TOWERS, Language

FLOW = (
    "speculation does not apply: a flow policy has no action tokens to draft. What applies: longer chunks (fewer "
    "decodes per second), and rollout.clock=real, which shows what its latency costs in success"
)
# Weights of layers and head, layers, vocabulary: SmolLM2-135M, TinyLlama, Llama-2 7B and 70B
PUBLISHED = ((0.135e9, 30, 49_152), (1.03e9, 22, 32_000), (6.61e9, 32, 32_000), (68.7e9, 80, 32_000))
LOOP = 256  # tokens that common loops decode for a FAST chunk, whatever its length (openpi)
_PATCHES = TOWERS["vit_so400m_patch14_siglip_224"].patches
_SHARE = 0.1  # of the weights are the vision encoder's, as in OpenVLA-7B
_SMALL = 50e6  # a policy with fewer weights is assumed to be like kerv's own: 8 layers, 256 ids
_CHANCES = 1000  # probabilities that the search for the break-even distinguishes


@dataclass(frozen=True)
class Draft:
    """A lossless method. A round drafts `chain` tokens. If 0, the prefill verifies one draft of the whole chunk."""

    method: str
    chain: int = 0
    source: str = ""  # kind of cost of a draft of the whole chunk; empty: it costs nothing

    def seconds(self, profile: Profile, tokens: int, chance: float) -> float:
        """Return the mean seconds of a decode of `tokens` tokens. `chance`: probability that a draft token is accepted.

        After a rejection, the drafter drafts again. Without a drafter, the target decodes the rest alone.
        """
        cost = functools.cache(profile.seconds)
        # by the number of committed tokens: of the rest of a decode, and of its next round alone
        after, alone, nothing = ([0.0] * (tokens + 1) for _ in range(3))

        def forward(kind: str, rows: int, depth: int, start: int, rest: Sequence[float]) -> float:
            total, reached = cost(kind, rows), 1.0
            for accepted in range(depth + 1):
                ends = reached * (1 - chance) if accepted < depth else reached
                stop, read = start + accepted + 1, accepted + (1 if start else profile.prompt)
                fed = cost("feed", read) if self.chain and tokens - stop > 1 else 0.0
                total, reached = total + ends * (fed + rest[stop]), reached * chance
            return total

        for start in range(tokens - 1, 0, -1):
            depth = min(self.chain, tokens - start - 1)
            drafting = cost("draft", depth) if depth else 0.0
            alone[start] = drafting + forward("verify", 1 + depth, depth, start, nothing)
            after[start] = drafting + forward("verify", 1 + depth, depth, start, after)
        whole = 0 if self.chain else tokens - 1
        first = cost("encode", 1) + (cost(self.source, 1) if self.source else 0.0)
        if profile.about.get(EXTRA_ROUND):  # as `prices` does: the round after the prefill runs once more
            after = [sum(pair) for pair in zip(after, alone, strict=True)]
        return first + forward("prefill", profile.prompt + whole, whole, 0, after)


DRAFTS = (Draft("last_action"), Draft("one_pass_strict", source="early"), Draft("naive_sd", chain=5))


def shape_of(weights: str) -> tuple[Shape, str]:
    """Return a policy's shape, and a text with its assumptions. `weights`: `7B` or the like, or a name in SHAPES."""
    if weights in SHAPES:
        return SHAPES[weights], ""
    total = number_of(weights)
    language = language_of((1 - _SHARE) * total)
    encoder, prompt = encoder_of_weights(_SHARE * total, _PATCHES), _PATCHES + INSTRUCTION
    layers = f"{language.num_hidden_layers} layers, {language.hidden_size} wide, {language.vocab_size} ids"
    assumed = f"assumed: {layers}; {_SHARE:.0%} of the weights in the vision encoder; a prompt of {prompt} tokens"
    return vla_shape(f"{weights} weights", language, prompt, encoder), assumed


def number_of(text: str) -> float:
    units = {"K": 1e3, "M": 1e6, "B": 1e9, "G": 1e9}
    try:
        number = float(text[:-1]) * units[text[-1].upper()] if text[-1:].upper() in units else float(text)
    except ValueError:
        number = math.nan
    if not 1e5 <= number <= 1e13:
        raise UsageError(f"weights={text}: write a number from 100K on, such as 7B, or {', '.join(SHAPES)}", "weights")
    return number


def language_of(weights: float) -> Language:
    """Return the shape of a Llama with about this many weights in layers and head, interpolated from PUBLISHED."""
    sizes, layers, vocabularies = np.log(np.array(PUBLISHED)).T
    at = math.log(weights)
    small = weights < _SMALL
    depth = 8 if small else round(math.exp(float(np.interp(at, sizes, layers))))
    ids = 256 if small else round(math.exp(float(np.interp(at, sizes, vocabularies))))
    # weights = 12 · depth · width² + ids · width
    width = round((math.sqrt(ids**2 + 48 * depth * weights) - ids) / (24 * depth))
    return Language(ids, max(width, 1), max(round(8 / 3 * width), 1), depth, 1)


def estimate(settings: EstimateSettings) -> Iterator[dict[str, Any]]:
    """Yield one dictionary per machine for JSON: machine, tokens, engines, notes, sentence; with `hz` also rate."""
    tokens = settings.tokens or (30 if settings.code == "fast" else 7)
    found: dict[str, list[NamedProfile]] = {}
    assumed = ""
    if not settings.weights and not settings.on:
        raise UsageError("name the policy by its size, weights=7B, or its measured costs, on=PROFILE")
    if settings.on:
        for one in open_profiles(settings.results, settings.on):
            found.setdefault(one.title, []).append(one)
    else:
        shape, assumed = shape_of(settings.weights)
        for device in map(DEVICES.__getitem__, dict.fromkeys(settings.device)):
            for engine in (ENGINES["tuned"], ENGINES["eager"]):
                rows = {"encode": 1, "prefill": shape.prompt, "verify": 1}
                bounds = {kind: engine.bound(shape.needs(kind, n), device) for kind, n in rows.items()}
                costs = NamedProfile(engine.name, priced(shape, device, engine), bounds)
                found.setdefault(f"{shape.name} on {device.title}, computed, not measured", []).append(costs)
    for machine, profiles in found.items():
        for costs in profiles:
            costs.check(tokens)
        engines = [engine_of(costs, tokens, settings.accepted) for costs in profiles]
        notes = [assumed] if assumed else []
        if settings.code == "fast":
            notes.append(_fast(profiles[0].profile, tokens))
        row: dict[str, Any] = {"machine": machine, "tokens": tokens, "engines": engines, "notes": notes}
        if settings.hz:
            row["rate"] = rate(engines, settings.hz, settings.actions)
        yield row | {"sentence": sentence(engines, tokens, settings)}


def engine_of(costs: NamedProfile, tokens: int, acceptance: Sequence[float]) -> dict[str, Any]:
    """Return a dictionary for JSON: the times of the parts of a chunk under AR, and the speed of each draft over AR."""
    profile = costs.profile
    parts = []
    for part, kind, seconds in (
        ("vision encoder", "encode", profile.seconds("encode", 1)),
        (f"prefill, {profile.prompt} tokens", "prefill", profile.seconds("prefill", profile.prompt)),
        (f"{tokens - 1} further tokens", "verify", (tokens - 1) * profile.seconds("verify", 1)),
        *([("a forward too many", "verify", profile.seconds("verify", 1))] if profile.about.get(EXTRA_ROUND) else []),
    ):
        parts.append({"part": part, "ms": 1e3 * seconds, "bound": costs.bounds.get(kind, "measured")})
    alone, drafts = profile.decode(tokens), []
    for one in DRAFTS:
        if not profile.lacks(["feed", "draft"] if one.chain else filter(None, [one.source])):
            speeds = {f"{chance:g}": alone / one.seconds(profile, tokens, chance) for chance in acceptance}
            drafts.append({"method": one.method, "speeds": speeds, "break_even": break_even(one, profile, tokens)})
            drafts[-1]["ceiling"] = alone / one.seconds(profile, tokens, 1.0)
    return {"engine": costs.name, "ms": 1e3 * alone, "parts": parts, "drafts": drafts}


def break_even(draft: Draft, profile: Profile, tokens: int) -> float | None:
    """Return the probability of acceptance at which drafting is as fast as AR. None if it is always slower."""
    alone = profile.decode(tokens) + 1e-12

    def enough(step: int) -> bool:
        return draft.seconds(profile, tokens, step / _CHANCES) <= alone

    step = bisect.bisect_left(range(_CHANCES + 1), True, key=enough)
    return None if step > _CHANCES else step / _CHANCES


def sentence(engines: Sequence[dict[str, Any]], tokens: int, settings: EstimateSettings) -> str:
    """State the largest speedup of verified drafts on the first engine, and the two changes that save most time."""
    best, worst = engines[0], engines[-1]
    chance = f"{sorted(settings.accepted)[len(settings.accepted) // 2]:g}"
    gains = {}
    for one in best["drafts"]:
        gains[f"{one['method']} ({one['speeds'][chance]:.2f} at acceptance {chance})"] = one["speeds"][chance]
    if (gain := worst["ms"] / best["ms"]) > 1:
        gains[f"a {best['engine']} engine ({gain:.2f} over {worst['engine']} code)"] = gain
    share = best["parts"][0]["ms"] / best["ms"]
    gains[f"a faster vision encoder (at most {1 / (1 - share):.2f})"] = 1 / (1 - share)
    first = [name for name in sorted(gains, key=lambda name: -gains[name]) if gains[name] > 1.05]
    ceiling = max(one["ceiling"] for one in best["drafts"])
    return (
        f"At {tokens} tokens and {best['ms']:.3g} ms per chunk verified drafts give at most {ceiling:.2f}; the encoder "
        f"takes {share:.0%}; what pays first is {', then '.join(first[:2]) or 'a smaller or faster target'}. "
        "method=last_action is the draft to try first: nothing is trained, and the tokens stay the same."
    )


def rate(engines: Sequence[dict[str, Any]], hz: float, actions: int) -> str:
    """Say which engines decode `actions` control steps fast enough for a robot that needs `hz` of them per second."""
    limit, words = 1e3 * actions / hz, []
    for one in engines:
        needed = one["ms"] / limit
        ceiling = max(draft["ceiling"] for draft in one["drafts"])
        who = "fast enough" if needed <= 1 else f"{needed:.2f} times too slow"
        who += ", more than verified drafts give" if needed > ceiling else ""
        words.append(f"{one['engine']}: AR takes {one['ms']:.3g} ms, {who}")
    return f"{hz:g} Hz leave {limit:.3g} ms per chunk. {'; '.join(words)}."


def _fast(profile: Profile, tokens: int) -> str:
    loop, stopped = profile.decode(LOOP), profile.decode(tokens)
    return (
        f"FAST: a chunk ends at its end token. A loop that always decodes {LOOP} tokens takes {1e3 * loop:.3g} ms, "
        f"stopping there {1e3 * stopped:.3g} ms, {loop / stopped:.1f} times less. FAST tokens are accepted less often "
        "than bins: measure the acceptance of yours"
    )


def part_rows(engines: Sequence[dict[str, Any]]) -> Iterator[dict[str, str]]:
    for parts in zip(*(one["parts"] for one in engines), strict=True):
        shares = [f"{part['ms'] / one['ms']:.0%}" for part, one in zip(parts, engines, strict=True)]
        cells = {"ms": _beside([f"{part['ms']:.3g}" for part in parts]), "share": _beside(shares)}
        yield {"one chunk under AR": parts[0]["part"], **cells, "bound": _beside([part["bound"] for part in parts])}
    whole = _beside([f"{one['ms']:.3g}" for one in engines])
    yield {"one chunk under AR": "all", "ms": whole, "share": "", "bound": ""}


def draft_rows(engines: Sequence[dict[str, Any]]) -> Iterator[dict[str, str]]:
    for drafts in zip(*(one["drafts"] for one in engines), strict=True):
        cells = {}
        for chance in drafts[0]["speeds"]:
            cells[f"acceptance {chance}"] = _beside([f"{one['speeds'][chance]:.2f}" for one in drafts])
        even = ["never" if one["break_even"] is None else f"{one['break_even']:.2f}" for one in drafts]
        ceilings = _beside([f"{one['ceiling']:.2f}" for one in drafts])
        yield {"method": drafts[0]["method"], **cells, "all accepted": ceilings, "break-even": _beside(even)}


def _beside(texts: Sequence[str]) -> str:
    return texts[0] if len(set(texts)) == 1 else " / ".join(texts)
