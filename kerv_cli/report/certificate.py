"""Issues the certificate of success from a study's paired episodes (docs/methods.md §4.6, ours)."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from kerv_cli.base.config import as_words, compose
from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import write_json
from kerv_cli.base.places import check_not_shipped
from kerv_cli.base.provenance import provenance
from kerv_cli.base.registry import METHOD_KINDS, part_of
from kerv_cli.episodes.identity import ENGINE
from kerv_cli.episodes.policy import artifacts_of
from kerv_cli.episodes.resolve import ResolvedStudy
from kerv_cli.episodes.settings import WAITS, RolloutSettings
from kerv_cli.lab.plan import Wanted, seeds_text
from kerv_cli.lab.store import StudyStore
from kerv_cli.methods.certified.betting import more_to_decide, p_value
from kerv_cli.methods.certified.certificate import Candidate, Certificate, CertificateArtifact
from kerv_cli.methods.compose import Method
from kerv_cli.report.measures import paired
from kerv_cli.report.statistics import MOST_PAIRS
from kerv_cli.report.tables import load_study
from kerv_cli.worlds import resolve_tasks, spec_of

POINTS = 100.0


def folder_of(resolved: ResolvedStudy) -> Path:
    """The certificate's folder, of a study that meets its conditions (`_check_conditions`).

    Raises:
        UsageError: settings that differ in more than how they trust, or seeds that are not for selection; a shipped
            policy's certificate.
    """
    baseline, *candidates = _settings(resolved)
    if not candidates:
        raise UsageError(f"study '{resolved.study.name}' has nothing but its baseline to certify")
    _check_conditions(resolved)
    first, tasks = candidates[0], resolve_tasks(baseline.task)
    seeds = range(first.seed, first.seed + first.episodes)
    spec_of(tasks[0]).seeds.check(seeds, "selection", f"seed={first.seed}")
    artifacts = artifacts_of(first)
    folder = artifacts.path(CertificateArtifact.kind)
    check_not_shipped(folder, "policy.artifacts.certificate")
    return folder


def _check_conditions(resolved: ResolvedStudy) -> None:
    """Refuses what a certificate does not say: it names one chunk, method, world, policy and number format, of a world
    that is not stressed and waits, and compares with AR.

    Raises:
        UsageError: names the setting and what to change.
    """
    baseline, first = _settings(resolved)[:2]
    for label, other in resolved.settings.items():
        keys = _CONDITIONS if other is baseline else (*_CONDITIONS, *_OF_CANDIDATES)
        differing = [key for key in keys if attrgetter(key)(other) != attrgetter(key)(first)]
        if differing:
            raise UsageError(
                f"setting '{label}' differs in {differing[0]}=: a certificate is of settings that differ in "
                f"{'= and '.join(_VARIED)}= alone, and of AR under the same conditions"
            )
    drafting = [kind for kind in (*_VARIED, "proposer") if getattr(baseline, kind).kind != "none"]
    if drafting:
        raise UsageError(
            f"the baseline '{resolved.study.baseline}' has {drafting[0]}={getattr(baseline, drafting[0]).kind}: a "
            f"certificate compares with AR, set {drafting[0]}=none there"
        )
    if first.world.stress.active:
        raise UsageError("world.stress: a certificate says nothing of a stressed world, leave it out")
    if first.rollout.clock != WAITS:
        raise UsageError(f"rollout.clock={first.rollout.clock}: a certificate is of a world that waits, leave it out")


def deployment_note(resolved: ResolvedStudy) -> str:
    """One sentence where method=one_pass_certified decodes otherwise than the study's settings, with the words that
    change that; else empty."""
    preset, study = compose("rollout", ["method=one_pass_certified"], RolloutSettings).parts(), _settings(resolved)[1]
    kinds = [kind for kind, part in study.parts().items() if kind not in _VARIED and part != preset[kind]]
    was = " ".join(word for kind in kinds for word in _difference(kind, preset[kind], getattr(study, kind)))
    words = " ".join(word for kind in kinds for word in _difference(kind, getattr(study, kind), preset[kind]))
    return words and f"method=one_pass_certified has {was}, this study {words}: to deploy its certificate add '{words}'"


def _difference(kind: str, part: Any, other: Any) -> list[str]:
    """The words that put a part, by its settings, in the place of another of its kind."""
    chosen = [] if part.kind == other.kind else [f"{kind}={part.kind}"]
    base = dataclasses.asdict(part_of(kind, part.kind).default if chosen else other)
    changed = {f"{kind}.{name}": value for name, value in dataclasses.asdict(part).items() if value != base[name]}
    return as_words(*chosen, **changed)


def certify(
    resolved: ResolvedStudy, store: StudyStore, wanted: Sequence[Wanted], margin: float, delta: float
) -> Certificate:
    """Tests the study's settings in their order, each at delta, up to the first that is not shown to lose at most
    `margin` points (fixed-sequence testing: the probability that any certified one loses more is delta at most)."""
    baseline, first = _settings(resolved)[:2]
    episodes = load_study(store, wanted).episodes
    episodes = episodes[episodes["repeat"] == 0]  # a repeat is another time, not another pair
    ar = episodes[episodes["label"] == resolved.study.baseline]
    candidates: list[Candidate] = []
    chosen, testing = None, True
    for label, settings in resolved.settings.items():
        if label == resolved.study.baseline:
            continue
        pairs = paired(episodes[episodes["label"] == label], ar)
        both = pairs[["success_baseline", "success_method"]].to_numpy(float)
        p = p_value(_values(both), _bound(margin), delta) if testing else None
        candidates.append(
            Candidate(
                label=label,
                skip=dataclasses.asdict(settings.skip),
                draft=dataclasses.asdict(settings.prefill_draft),
                pairs=len(pairs),
                ar=int(both[:, 0].sum()),
                successes=int(both[:, 1].sum()),
                lost=int((both[:, 0] > both[:, 1]).sum()),
                won=int((both[:, 0] < both[:, 1]).sum()),
                p=p,
                needed=_needed(both, margin, delta) if p is not None and p > delta else 0,
            )
        )
        testing = p is not None and p <= delta
        chosen = len(candidates) - 1 if testing else chosen
    artifacts = artifacts_of(first)
    hashes = artifacts.check(need for settings in _settings(resolved)[1:] for need in Method.of(settings).needs)
    tasks = resolve_tasks(baseline.task)
    return Certificate(
        target=hashes.pop("target"),
        actions=artifacts.description.actions,
        chunk=first.chunk or artifacts.description.chunk,
        environment=spec_of(tasks[0]).name,
        tasks=list(tasks),
        drafts=hashes,
        method={kind: dataclasses.asdict(getattr(first, kind)) for kind in METHOD_KINDS if kind not in _VARIED},
        world={"camera": dataclasses.asdict(first.world.camera), "horizon": first.world.horizon},
        dtype=first.runtime.dtype,
        margin=margin,
        delta=delta,
        seeds=seeds_text(one.seed for one in wanted),
        candidates=candidates,
        chosen=chosen,
        provenance={"command": "kerv calibrate success", "engine": ENGINE, **provenance(first.runtime.device)},
    )


_VARIED = ("prefill_draft", "skip")
"""Kinds in which candidates may differ."""

_CONDITIONS = ("task", "seed", "episodes", "world", "rollout.clock", "runtime.dtype", "policy.kind", "policy.target")
"""What all settings have in common, the baseline too."""

_OF_CANDIDATES = ("chunk", "policy", *(kind for kind in METHOD_KINDS if kind not in _VARIED))
"""What all candidates have in common."""


def write(folder: Path, certificate: Certificate) -> Path:
    """Writes the certificate -> its file."""
    path = CertificateArtifact().json(folder)
    write_json(path, {**dataclasses.asdict(certificate), "actions": certificate.actions.as_dict()})
    return path


def candidate_rows(certificate: Certificate) -> list[dict[str, str]]:
    """A row per candidate, as text."""
    return [
        {
            "setting": one.label,
            "success": f"{one.successes}/{one.pairs}",
            "AR": f"{one.ar}/{one.pairs}",
            "lost / won": f"{one.lost} / {one.won}",
            "p": "not tested"
            if one.p is None
            else f"{one.p:.3g}" + (" certified" if one.p <= certificate.delta else ""),
            "pairs needed": _needed_text(one.needed),
        }
        for one in certificate.candidates
    ]


def _needed_text(pairs: int) -> str:
    """`Candidate.needed` in words."""
    if pairs > MOST_PAIRS:
        return f"more than {MOST_PAIRS:,}"
    return {0: "", -1: "not at these rates"}.get(pairs, f"about {pairs} more")


def _bound(margin: float) -> float:
    return (1 + margin / POINTS) / 2


def _values(both: np.ndarray) -> np.ndarray:
    """(n, 2) success of AR and of the rule -> v (n,) = (1 + AR − rule) / 2, in an order that has nothing to do with the
    tasks."""
    values = (1 + both[:, 0] - both[:, 1]) / 2
    seed = int.from_bytes(hashlib.sha256(str(len(values)).encode()).digest()[:4], "big")
    return np.random.default_rng(seed).permutation(values)


def _needed(both: np.ndarray, margin: float, delta: float) -> int:
    """Pairs that are missing at these rates; −1: never."""
    more = more_to_decide(_values(both), _bound(margin), delta)
    return int(more) if math.isfinite(more) else -1


def _settings(resolved: ResolvedStudy) -> list[RolloutSettings]:
    """The baseline's settings, then the candidates' in their order."""
    others = [settings for label, settings in resolved.settings.items() if label != resolved.study.baseline]
    return [resolved.settings[resolved.study.baseline], *others]
