"""Say what speculation can give a policy: what an action costs, and how fast each family of methods can be.

Nothing is run and nothing is measured. This module needs no torch.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from kerv_cli.base.errors import UsageError
from kerv_cli.bench.described import Described
from kerv_cli.bench.expected import Decodes, Drafts
from kerv_cli.bench.physics import ENGINES, Device, Engine, Shape, priced
from kerv_cli.bench.recorded import TABLES, Recorded, nearest_table, recorded
from kerv_cli.engine.cost import Profile

NO_TOKENS = (
    "speculation does not apply: the policy emits no action tokens, so there is nothing to draft. What applies: longer "
    "chunks (fewer decodes per second), and rollout.clock=real, which shows what its latency costs in success"
)


@dataclass(frozen=True)
class Family:
    """Methods that draft in the same way.

    Attributes:
        name: Name in the table.
        method: The method that stands for it, see `conf/method`.
        drafts: How it drafts at best: whatever can be retrieved or skipped is.
        length: Tokens that a verification commits, of seven, as its paper has them. None: not published.
        reported: The paper's own speed against AR, on its machine.
    """

    name: str
    method: str
    drafts: Drafts
    length: float | None = None
    reported: str = ""


_TREE = Drafts(5, 49)
FAMILIES = (
    Family("drafter, chain", "spec_vla_tuned", Drafts(15)),
    Family("drafter, tree", "spec_vla", _TREE, length=(3.63 + 3.91) / 2, reported="1.22–1.42"),
    Family("tree, then prediction", "kerv", _TREE, reported="1.27–1.37 × naive SD"),
    Family("retrieval, then tree", "heisd", replace(_TREE, source="retrieval", retrieved=1.0), reported="up to 2.45"),
    Family("one pass", "one_pass", Drafts(source="early", in_prefill=True)),
    Family("streak", "one_pass_streak", Drafts(15, source="early", in_prefill=True, skipped=1.0)),
    Family("unverified", "early_unverified", Drafts(source="early", skipped=1.0)),
    Family("unverified, own encoder", "scout_unverified", Drafts(source="scout", skipped=1.0, encodes=False)),
)
"""Families of methods. The published length is Spec-VLA's, as HeiSD quotes it (docs/methods.md §2.3)."""
_PUBLISHED_TOKENS = 7


@dataclass(frozen=True)
class Costs:
    """The costs of a policy's decodes with an engine.

    Attributes:
        engine: Name of the engine, or of a measured profile.
        profile: Seconds of each phase.
        bounds: What bounds the encoder, the prefill and one further token. Empty if the profile was measured.
    """

    engine: str
    profile: Profile
    bounds: Mapping[str, str]


def computed(policy: Described, device: Device) -> list[Costs]:
    """Return the costs of a policy on a device, with each engine."""
    assert policy.shape is not None
    return [_computed(policy.shape, policy.encoder, device, engine) for engine in ENGINES.values()]


def _computed(shape: Shape, encoder: float | None, device: Device, engine: Engine) -> Costs:
    profile = priced(shape, device, engine)
    needs = {"encode": shape.needs("encode", 1), "prefill": shape.needs("prefill", shape.prompt)}
    needs["verify"] = shape.needs("verify", 1)
    bounds = {kind: engine.bound(one, device) for kind, one in needs.items()}
    if encoder is not None:
        profile = replace(profile, phases={**profile.phases, "encode": ((1,), (encoder,))})
        bounds["encode"] = "given"
    elif not profile.seconds("encode", 1):
        bounds["encode"] = "none"
    return Costs(engine.name, profile, bounds)


def check_tokens(name: str, profile: Profile, tokens: int) -> None:
    """Check that a profile has costs of chunks of so many tokens.

    Raises:
        UsageError: Its costs are for shorter chunks.
    """
    if profile.tokens < tokens:
        command = f"kerv bench target={profile.about.get('target', 'TARGET')} tokens={tokens}"
        raise UsageError(f"on={name}: its costs are for chunks of {profile.tokens} tokens. Measure it with '{command}'")


@dataclass(frozen=True)
class Answer:
    """What a family of methods gives with an engine. Speeds are against AR.

    Attributes:
        family: The family.
        ceiling: Speed if every draft token is accepted and every decode that may is executed unverified.
        published: Speed at the acceptance that its paper reports. None: it reports none.
        own: Speed at kerv's own acceptance. None: no table has it.
        recorded: The setting of a published table that kerv's acceptance is from.
        break_even: Accepted draft tokens per verification with which it is as fast as AR. None: it never is, or it
            verifies nothing.
    """

    family: Family
    ceiling: float
    published: float | None
    own: float | None
    recorded: Recorded | None
    break_even: float | None


@dataclass(frozen=True)
class Estimate:
    """What speculation can give a policy with an engine.

    Attributes:
        costs: What its decodes cost.
        tokens: N, tokens of a chunk.
    """

    costs: Costs
    tokens: int

    @property
    def seconds(self) -> float:
        """Seconds of one autoregressive decode."""
        return self.costs.profile.decode(self.tokens)

    @cached_property
    def parts(self) -> dict[str, tuple[float, str]]:
        """Part of an autoregressive decode -> its seconds, and what bounds them."""
        profile, bounds = self.costs.profile, self.costs.bounds
        rest = self.tokens - 1
        seconds = {
            "vision encoder": ("encode", profile.seconds("encode", 1)),
            f"prefill, {profile.prompt} tokens": ("prefill", profile.seconds("prefill", profile.prompt)),
            f"{rest} further token{'s' * (rest != 1)}": ("verify", rest * profile.seconds("verify", 1)),
        }
        return {name: (taken, bounds.get(kind, "measured")) for name, (kind, taken) in seconds.items()}

    @property
    def encoder(self) -> float:
        """The vision encoder's share of an autoregressive decode."""
        return self.parts["vision encoder"][0] / self.seconds

    @cached_property
    def answers(self) -> list[Answer]:
        """What each family of methods gives that the profile can price."""
        table = recorded(nearest_table(self.tokens))
        return [
            self._answer(family, table)
            for family in FAMILIES
            if not self.costs.profile.lacks([family.drafts.source] if family.drafts.source else ["feed", "draft"])
        ]

    def _answer(self, family: Family, table: Sequence[Recorded]) -> Answer:
        profile, best = self.costs.profile, Decodes(self.costs.profile, self.tokens, family.drafts)
        published, own = None, None
        if family.length is not None:
            paper = Decodes(profile, _PUBLISHED_TOKENS, family.drafts)
            chance = paper.acceptance_for(1 + (_PUBLISHED_TOKENS - 1) / family.length)
            published = best.speed([chance])
        shown = closest(table, family)
        if shown is not None:
            chance = Decodes(profile, shown.tokens, shown.drafts).acceptance_for(shown.forwards)
            own = Decodes(profile, self.tokens, shown.drafts).speed([chance])
        even = None if family.drafts.skipped else best.break_even()
        return Answer(family, best.speed([1.0]), published, own, shown, even and even.accepted_each)


def closest(table: Iterable[Recorded], family: Family) -> Recorded | None:
    """Return the setting of a table that stands for a family: its method's, if possible with drafts of its form."""
    settings = [one for one in table if one.method == family.method]
    alike = [one for one in settings if bool(one.drafts.nodes) == bool(family.drafts.nodes)]
    return next(iter([*alike, *settings]), None)


def sentence(estimates: Sequence[Estimate]) -> str:
    """Return one sentence that answers whether speculation helps.

    Args:
        estimates: Of the same policy on the same device: the best engine first.
    """
    best, worst = estimates[0], estimates[-1]
    verified = [one for one in best.answers if not one.family.drafts.skipped]
    tokens = f"At {best.tokens} token{'s' * (best.tokens != 1)} and {1e3 * best.seconds:.3g} ms per action"
    if not verified:
        return f"{tokens} nothing can be said: the profile has no cost of a draft."
    top = max(verified, key=lambda one: one.ceiling)
    most = max(best.answers, key=lambda one: one.ceiling)
    unverified = f" (unverified drafts, a policy of their own: {most.ceiling:.3g})" if most is not top else ""
    gains = {f"{one.family.method} ({one.own:.2f} at kerv's acceptance)": one.own for one in verified if one.own}
    if worst is not best and worst.seconds > best.seconds:
        gain = worst.seconds / best.seconds
        gains[f"a {best.costs.engine} engine ({gain:.2f} over {worst.costs.engine} code)"] = gain
    without = 1 / (1 - best.encoder)
    gains[f"a faster vision encoder (at most {without:.2f})"] = without
    first = sorted(gains, key=lambda name: -gains[name])
    names = [name for name in first if gains[name] > 1.05] or ["a smaller or faster target"]
    engine = f" with a {best.costs.engine} engine" if best.costs.bounds else ""
    return (
        f"{tokens}{engine} speculation can give at most {top.ceiling:.2f}{unverified}; the encoder takes "
        f"{100 * best.encoder:.0f} %; what pays first is {', then '.join(names[:2])}."
    )


def rate(estimates: Sequence[Estimate], hz: float, actions: int) -> str:
    """Return a sentence that says who decodes fast enough for a robot.

    Args:
        estimates: Of the same policy on the same device.
        hz: Control steps per second.
        actions: Control steps per chunk.
    """
    limit, words = actions / hz, []
    for one in estimates:
        enough = [x.family.method for x in one.answers if x.own and one.seconds / x.own <= limit]
        best = [x.family.method for x in one.answers if one.seconds / x.ceiling <= limit]
        who = "AR is fast enough" if one.seconds <= limit else ""
        who = who or (f"at kerv's acceptance {', '.join(enough)} would be" if enough else "")
        who = who or (f"only with all drafts accepted {', '.join(best)} would be" if best else "no method is")
        words.append(f"{one.costs.engine}: AR takes {1e3 * one.seconds:.3g} ms, {who}")
    return f"{hz:g} Hz leave {1e3 * limit:.3g} ms per decode. {'; '.join(words)}."


def document(estimates: Sequence[Estimate]) -> list[dict[str, Any]]:
    """Return estimates for JSON."""
    return [
        {
            "engine": one.costs.engine,
            "ms": 1e3 * one.seconds,
            "encoder_share": one.encoder,
            "parts": [{"part": name, "ms": 1e3 * taken, "bound": by} for name, (taken, by) in one.parts.items()],
            "families": [_answer_row(answer) for answer in one.answers],
        }
        for one in estimates
    ]


def _answer_row(answer: Answer) -> dict[str, Any]:
    family, own = answer.family, answer.recorded
    return {
        "family": family.name,
        "method": family.method,
        "ceiling": answer.ceiling,
        "at_published_acceptance": answer.published,
        "paper_reports": family.reported or None,
        "at_own_acceptance": answer.own,
        "own_acceptance_from": own and f"results/tables/{own.table}.csv, {own.label}",
        "break_even_tokens": answer.break_even,
    }


PART_COLUMNS = ("one action under AR", "ms", "share", "bound")
FAMILY_COLUMNS = (
    "family",
    "method",
    "ceiling",
    "at the paper's acceptance",
    "paper reports",
    "at kerv's",
    "break-even",
)


def part_rows(estimates: Sequence[Estimate]) -> list[tuple[str, ...]]:
    """Return a row per part of an autoregressive decode. Each cell has the engines side by side."""
    rows: list[tuple[str, ...]] = []
    for name in estimates[0].parts:
        cells = [(*one.parts[name], one.parts[name][0] / one.seconds) for one in estimates]
        times = (_beside(f"{1e3 * taken:.3g}" for taken, _, _ in cells), _beside(f"{100 * x:.0f} %" for *_, x in cells))
        rows.append((name, *times, _beside(by for _, by, _ in cells)))
    return [*rows, ("all", _beside(f"{1e3 * one.seconds:.3g}" for one in estimates), "", "")]


def family_rows(estimates: Sequence[Estimate]) -> list[tuple[str, ...]]:
    """Return a row per family of methods. Each cell has the engines side by side."""
    rows: list[tuple[str, ...]] = []
    for answers in zip(*(one.answers for one in estimates), strict=True):
        family = answers[0].family
        even = [_number(one.break_even) if not family.drafts.skipped else "–" for one in answers]
        never = ["never" if x == "–" and not family.drafts.skipped else x for x in even]
        rows.append(
            (
                family.name,
                family.method,
                _beside(_number(one.ceiling) for one in answers),
                _beside(_number(one.published) for one in answers),
                family.reported or "–",
                _beside(_number(one.own) for one in answers),
                _beside(never),
            )
        )
    return rows


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}" if value < 10 else f"{value:.1f}"


def _beside(cells: Iterable[str]) -> str:
    """Return cells side by side, or one if all are equal."""
    texts = list(cells)
    return texts[0] if len(set(texts)) == 1 else " / ".join(texts)


def notes(policy: Described | None, estimates: Sequence[Estimate]) -> list[str]:
    """Return what the tables rest on, a line each."""
    table = nearest_table(estimates[0].tokens)
    source = "this installation has no results/tables"
    if any(one.recorded for one in estimates[0].answers):
        length = TABLES[table]
        source = f"results/tables/{table}.csv, {length} tokens per chunk, on its own tasks; yours may be lower"
    assumed = [f"assumed: {'; '.join(policy.assumed)}"] if policy and policy.assumed else []
    return [*assumed, f"kerv's acceptance: {source}"]
