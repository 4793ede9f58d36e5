"""Rows and sentences in which `kerv bench` and `kerv estimate` show their results. This module needs no torch."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from kerv_cli.bench.physics import DEVICES
from kerv_cli.bench.prices import ACTION, ANCHORS, FAMILIES, Answer, Estimate, Projection, closest

if TYPE_CHECKING:
    from kerv_cli.bench.described import Described
    from kerv_cli.bench.measure import Phase

Row = dict[str, str]
"""Cells of a row by the names of their columns."""


def card_rows(card: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield rows (name, value): sizes of the model, rates of the device, and shortest times of forwards.

    Args:
        card: Result of `measure.card_of`.
    """
    yield "weights that a forward reads", f"{card['weights'] / 1e6:.1f} M, {card['weight_bytes'] / 1e6:.1f} MB"
    yield "cache of prompt and chunk", f"{card['cache_bytes'] / 1e6:.2f} MB"
    yield "memory, measured", f"{card['bandwidth'] / 1e9:.1f} GB/s"
    yield "memory that holds the weights, measured", f"{card['bandwidth_of_weights'] / 1e9:.1f} GB/s"
    yield "arithmetic, measured", f"{card['flops'] / 1e9:.0f} GFLOP/s"
    for name, (reading, computing) in card["floors"].items():
        why = "to read the weights" if reading >= computing else "for the arithmetic"
        yield f"floor of {name}", f"{1e3 * max(reading, computing):.2f} ms, {why}"


def phase_rows(phases: Sequence[Phase]) -> Iterator[Row]:
    """Yield a row per measured phase. The floor is the shortest time that the device allows."""
    for phase in phases:
        row = {"phase": phase.name}
        for name, seconds in (("median ms", phase.seconds), ("p95", phase.p95), ("least", phase.least)):
            row[name] = f"{1e3 * seconds:.2f}"
        limits = dict.fromkeys(("GB/s", "GFLOP/s", "floor ms", "least ÷ floor"), "–")
        if phase.floor > 0:
            limits["GB/s"] = f"{phase.read / phase.seconds / 1e9:.1f}"
            limits["GFLOP/s"] = f"{phase.flops / phase.seconds / 1e9:.0f}"
            limits["floor ms"] = f"{1e3 * phase.floor:.3f}"
            limits["least ÷ floor"] = f"{phase.least / phase.floor:.1f}"
        yield row | limits


def projection_rows(computed: Iterable[Projection]) -> Iterator[Row]:
    """Yield a row per computed profile."""
    for one in computed:
        row = {"profile": one.name, "device": one.device.title, "engine": one.engine.name}
        row["encoder ms"] = f"{1e3 * one.profile.seconds('encode', 1):.2f}"
        row["one token ms"] = f"{1e3 * one.profile.seconds('verify', 1):.2f}"
        row["seven tokens ms"] = f"{1e3 * one.profile.decode(ACTION):.2f}"
        row["floor ms"] = f"{1e3 * one.floors.decode(ACTION):.2f}"
        yield row


def anchor_rows() -> Iterator[Row]:
    """Yield a row per published time of OpenVLA-7B, with the time that kerv computes."""
    for one in ANCHORS:
        row = {"device": DEVICES[one.device].title, "engine": one.engine.name}
        if one.weight < 1:
            row["engine"] += ", int4"
        row["published, ms"] = f"{one.low:g}" if one.low == one.high else f"{one.low:g}–{one.high:g}"
        yield row | {"ours, ms": f"{one.ours:.1f}", "source": one.source}


def part_rows(estimates: Sequence[Estimate]) -> Iterator[Row]:
    """Yield one row per part of an autoregressive decode. Each cell lists the figures of all engines."""
    for name in estimates[0].parts:
        taken, shares, bounds = [], [], []
        for one in estimates:
            seconds, bound = one.parts[name]
            taken.append(f"{1e3 * seconds:.3g}")
            shares.append(f"{100 * seconds / one.seconds:.0f} %")
            bounds.append(bound)
        cells = {"ms": _beside(taken), "share": _beside(shares), "bound": _beside(bounds)}
        yield {"one action under AR": name} | cells
    whole = _beside([f"{1e3 * one.seconds:.3g}" for one in estimates])
    yield {"one action under AR": "all", "ms": whole, "share": "", "bound": ""}


def family_rows(estimates: Sequence[Estimate]) -> Iterator[Row]:
    """Yield one row per family of methods. Each cell lists the figures of all engines."""
    for answers in zip(*[one.answers for one in estimates], strict=True):
        first = answers[0]
        yield {
            "family": first.family,
            "method": first.method,
            "ceiling": _numbers(answers, "ceiling"),
            "at the paper's acceptance": _numbers(answers, "at_published_acceptance"),
            "paper reports": first.paper_reports or "–",
            "at kerv's": _numbers(answers, "at_own_acceptance"),
            "break-even": _numbers(answers, "break_even_tokens", "never" if first.is_verified else "–"),
        }


def _numbers(answers: Iterable[Answer], name: str, none: str = "–") -> str:
    """Return the field `name` of several answers as one cell. The text `none` stands for None."""
    texts = []
    for answer in answers:
        value = getattr(answer, name)
        texts.append(none if value is None else f"{value:.2f}" if value < 10 else f"{value:.1f}")
    return _beside(texts)


def _beside(texts: Sequence[str]) -> str:
    """Return the texts as one cell, side by side. If all texts are equal, the cell has the text once."""
    return texts[0] if len(set(texts)) == 1 else " / ".join(texts)


def trace_row(found: Mapping[str, Any]) -> dict[str, object]:
    """Return a row about a setting of a trace, from a result of `trace.price` or `trace.choose_length`."""
    if "best" not in found:
        row: dict[str, object] = {name: found[name] for name in ("setting", "tokens", "episodes", "decodes")}
        for name in ("decode", "episode"):
            row[f"ms per {name}"] = f"{found[f'ms_per_{name}']:.4g}"
        return row | {"speed against AR": _speed(found)}
    lengths, sure = found["speeds"], found["sure"]
    return {
        "setting": found["setting"],
        "tokens": found["tokens"],
        "fastest length": found["best"],
        "speed against AR": _speed(lengths[found["best"]]),
        "fastest of resamples": "–" if math.isnan(sure) else f"{100 * sure:.0f} %",
        "by length": ", ".join(f"{one['length']}: {one['speed']:.2f}" for one in lengths[1:]),
    }


def _speed(found: Mapping[str, float]) -> str:
    """Return a speed as text, with its 95 % interval unless the interval is NaN."""
    interval = "" if math.isnan(found["low"]) else f" ({found['low']:.2f}–{found['high']:.2f})"
    return f"{found['speed']:.2f}{interval}"


def sentence(estimates: Sequence[Estimate]) -> str:
    """Return one sentence that answers whether speculation helps.

    Args:
        estimates: Estimates of one policy on one device, one per engine, the best engine first.
    """
    best, worst = estimates[0], estimates[-1]
    verified = [one for one in best.answers if one.is_verified]
    tokens = f"At {best.tokens} token{'s' * (best.tokens != 1)} and {1e3 * best.seconds:.3g} ms per action"
    if not verified:
        return f"{tokens} nothing can be said: the profile has no cost of a draft."
    top = max(verified, key=lambda one: one.ceiling)
    most = max(best.answers, key=lambda one: one.ceiling)
    unverified = f" (unverified drafts, a policy of their own: {most.ceiling:.3g})" if most is not top else ""
    gains = {}
    for one in verified:
        if one.at_own_acceptance:
            gains[f"{one.method} ({one.at_own_acceptance:.2f} at kerv's acceptance)"] = one.at_own_acceptance
    if worst is not best and worst.seconds > best.seconds:
        gain = worst.seconds / best.seconds
        gains[f"a {best.costs.name} engine ({gain:.2f} over {worst.costs.name} code)"] = gain
    without = 1 / (1 - best.encoder)
    gains[f"a faster vision encoder (at most {without:.2f})"] = without
    first = sorted(gains, key=lambda name: -gains[name])
    names = [name for name in first if gains[name] > 1.05] or ["a smaller or faster target"]
    engine = f" with a {best.costs.name} engine" if best.costs.bounds else ""
    return (
        f"{tokens}{engine} speculation can give at most {top.ceiling:.2f}{unverified}; the encoder takes "
        f"{100 * best.encoder:.0f} %; what pays first is {', then '.join(names[:2])}."
    )


def rate(estimates: Sequence[Estimate], hz: float, actions: int) -> str:
    """Return a sentence that says which methods decode fast enough for a robot.

    Args:
        estimates: Estimates of one policy on one device, one per engine.
        hz: Control steps per second that the robot needs.
        actions: Control steps per chunk.
    """
    limit, words = actions / hz, []
    for one in estimates:
        enough, best = [], []
        for answer in one.answers:
            if answer.at_own_acceptance and one.seconds / answer.at_own_acceptance <= limit:
                enough.append(answer.method)
            if one.seconds / answer.ceiling <= limit:
                best.append(answer.method)
        who = "no method is"
        if one.seconds <= limit:
            who = "AR is fast enough"
        elif enough:
            who = f"at kerv's acceptance {', '.join(enough)} would be"
        elif best:
            who = f"only with all drafts accepted {', '.join(best)} would be"
        words.append(f"{one.costs.name}: AR takes {1e3 * one.seconds:.3g} ms, {who}")
    return f"{hz:g} Hz leave {1e3 * limit:.3g} ms per decode. {'; '.join(words)}."


def document(one: Estimate) -> dict[str, Any]:
    """Return an estimate for JSON."""
    parts = [{"part": name, "ms": 1e3 * taken, "bound": by} for name, (taken, by) in one.parts.items()]
    families = []
    for answer in one.answers:
        families.append(asdict(answer))
        del families[-1]["is_verified"]
    about = {"engine": one.costs.name, "ms": 1e3 * one.seconds, "encoder_share": one.encoder}
    return {**about, "parts": parts, "families": families}


def notes(policy: Described | None, estimates: Sequence[Estimate]) -> list[str]:
    """Return the assumptions behind the tables, one line each."""
    best, methods = estimates[0], dict[tuple[str, int], list[str]]()
    priced = set(map(attrgetter("family"), best.answers))
    for family in FAMILIES:
        if family.name in priced and (shown := closest(best.tokens, family)) is not None:
            methods.setdefault((shown.table, shown.tokens), []).append(family.method)
    sources = []
    for (table, tokens), names in methods.items():
        sources.append(f"{table}.csv ({tokens} tokens per chunk) for {', '.join(names)}")
    source = "this installation has no results/tables"
    if sources:
        source = f"results/tables/{'; '.join(sources)}. On your tasks it may be lower"
    assumed = [f"assumed: {'; '.join(policy.assumed)}"] if policy and policy.assumed else []
    return [*assumed, f"kerv's acceptance: {source}"]
