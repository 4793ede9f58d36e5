"""Issue a certificate of success from a study's paired episodes.

The certificate states how much success a setting loses at most against AR (docs/methods.md §4.6, ours). AR is the
study's baseline. The other settings are the candidates. The seeds must be new: no other study ran the policy on them.
A policy is tested once. Only `again=true` allows a further test, with a smaller error probability.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from collections.abc import Iterable, Sequence
from operator import attrgetter
from pathlib import Path

import numpy as np
import pandas as pd
import sqlalchemy as sa

from kerv_cli.base.durations import count
from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import write_json
from kerv_cli.base.paths import beside, results_dir
from kerv_cli.base.registry import METHOD_KINDS
from kerv_cli.episodes.identity import ENGINE
from kerv_cli.episodes.policy import artifacts_of
from kerv_cli.episodes.resolve import ResolvedStudy
from kerv_cli.episodes.settings import WAITS, RolloutSettings
from kerv_cli.lab.database import SETTINGS, STUDIES, WANTED, now
from kerv_cli.lab.plan import Episode, seeds_text
from kerv_cli.lab.store import Study
from kerv_cli.methods.certified.certificate import Attempt, Candidate, Certificate, CertificateArtifact
from kerv_cli.methods.compose import Method
from kerv_cli.report.betting import p_value
from kerv_cli.report.measures import paired
from kerv_cli.report.tables import load_study
from kerv_cli.targets.provenance import provenance
from kerv_cli.training.settings import CalibrateSuccessSettings
from kerv_cli.worlds import resolve_tasks, spec_of

POINTS = 100.0
SOLVED_BY_AR = 0.5
"""Smallest success rate of AR for which a certificate is issued."""

_VARIED = ("prefill_draft", "skip")
"""Kinds of parts in which the candidates may differ."""
_CONDITIONS = ("task", "seed", "episodes", "world", "rollout.clock", "runtime.dtype", "policy.kind", "policy.target")
"""Settings that must be the same for all candidates and the baseline."""
_OF_CANDIDATES = ("chunk", "policy", *(kind for kind in METHOD_KINDS if kind not in _VARIED))
"""Settings that must be the same for all candidates. The baseline may differ."""


def folder_of(resolved: ResolvedStudy) -> Path:
    """Check that a study can give a certificate. Return the folder to write the certificate into.

    Raises:
        UsageError: The study has only a baseline, or a certificate does not apply to the study. Or its seeds are
            outside the range reserved for selection, or the folder belongs to a policy that kerv ships.
    """
    candidates = _candidates(resolved)
    if not candidates:
        raise UsageError(f"study '{resolved.study.name}' has only its baseline: add a setting to certify")
    _check_conditions(resolved)
    first = next(iter(candidates.values()))
    tasks = resolve_tasks(first.task)
    seeds = range(first.seed, first.seed + first.episodes)
    spec_of(tasks[0]).seeds.check(seeds, "selection", f"seed={first.seed}")
    return artifacts_of(first).new(CertificateArtifact.kind)


def _check_conditions(resolved: ResolvedStudy) -> None:
    """Refuse studies to which a certificate does not apply.

    Candidates may differ only in the settings `prefill_draft` and `skip`. The baseline must be AR. All settings must
    have the same tasks, seeds, policy, number format and world, without stress. The world must wait during decodes.

    Raises:
        UsageError: A condition is not met.
    """
    baseline, first = resolved.settings[resolved.study.baseline], next(iter(_candidates(resolved).values()))
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


def planned_certificate(
    resolved: ResolvedStudy, store: Study, wanted: Sequence[Episode], settings: CalibrateSuccessSettings
) -> Certificate:
    """Return the certificate before its test has run. It says what will be tested, in which order and how.

    Args:
        resolved: The study.
        store: The same study, as it is stored in the database.
        wanted: Episodes that the test will use.
        settings: Settings of the test.

    Raises:
        UsageError: The policy was tested before and `settings.again` is not set, or its seeds were used before.
        CheckpointError: An artifact of a candidate is missing or damaged.
    """
    tested = _candidates(resolved)
    first = next(iter(tested.values()))
    artifacts, tasks = artifacts_of(first), resolve_tasks(first.task)
    needs = [one.needs for one in map(Method.of, tested.values())]
    hashes = artifacts.check(itertools.chain.from_iterable(needs))
    candidates = []
    for label, one in tested.items():
        skip, draft = dataclasses.asdict(one.skip), dataclasses.asdict(one.prefill_draft)
        candidates.append(Candidate(label, skip=skip, draft=draft))
    certificate = Certificate(
        target=hashes.pop("target"),
        actions=artifacts.description.actions,
        chunk=first.chunk or artifacts.description.chunk,
        environment=spec_of(tasks[0]).name,
        tasks=list(tasks),
        drafts=hashes,
        method={kind: dataclasses.asdict(getattr(first, kind)) for kind in METHOD_KINDS if kind not in _VARIED},
        world={"camera": dataclasses.asdict(first.world.camera), "horizon": first.world.horizon},
        dtype=first.runtime.dtype,
        margin=settings.margin,
        delta=settings.delta,
        seeds=seeds_text([one.seed for one in wanted]),
        candidates=candidates,
        chosen=None,
        provenance={"command": "kerv calibrate success", "engine": ENGINE, **provenance(first.runtime.device)},
        made=now(),
    )
    folders = {*(results_dir(first.results) / "artifacts/certificate").glob("*")}
    folders |= {artifacts.path(CertificateArtifact.kind), beside(artifacts.folder, CertificateArtifact.kind)}
    return charged(certificate, store, wanted, sorted(folders), settings.again)


def charged(
    certificate: Certificate, store: Study, episodes: Sequence[Episode], paths: Iterable[Path], again: bool
) -> Certificate:
    """Set the error probability of a planned test, and record the policy's earlier tests.

    The n-th test of a policy gets delta / 2^(n − 1). An identical repeat does not count as a new test.

    Args:
        certificate: The planned certificate. Its `delta` is the error probability of a first test.
        store: The study whose episodes are the test.
        episodes: The episodes of the test.
        paths: Folders of existing certificates. Certificates of other policies do not count.
        again: Whether a further test of the policy is wanted.

    Returns:
        The certificate with its `earlier` tests and the `delta` of this test.

    Raises:
        UsageError: The policy was tested before and `again` is not set. Or an earlier test of this policy used one of
            these seeds. Or another study ran the policy on one of these tasks and seeds.
    """
    earlier = attempts_on(certificate.target, paths)
    for number, attempt in enumerate(earlier):
        if (attempt.test, attempt.delta) == (certificate.test, certificate.delta / 2**number):
            return dataclasses.replace(certificate, delta=attempt.delta, earlier=earlier[:number])
    if earlier and not again:
        raise UsageError(
            f"this policy has had {count(len(earlier), 'test')}, on seeds "
            f"{', '.join(one.seeds for one in earlier)}: another one is another chance to certify falsely. Set "
            f"again=true to test on other seeds at delta={certificate.delta / 2 ** len(earlier):g}"
        )
    for attempt in earlier:
        if not attempt.seeds_served.isdisjoint([one.seed for one in episodes]):
            raise UsageError(f"seeds {attempt.seeds} served an earlier test of this policy: set seed= to others")
    if study := _other_study(certificate.target, store, episodes):
        raise UsageError(f"study '{study}' ran this policy on some of these seeds: set seed= to others")
    return dataclasses.replace(certificate, delta=certificate.delta / 2 ** len(earlier), earlier=earlier)


def attempts_on(target: str, folders: Iterable[Path]) -> list[Attempt]:
    """Return all tests of a policy, the oldest first.

    Args:
        target: Hash of the policy's weights.
        folders: Folders of existing certificates.
    """
    found: list[Attempt] = []
    artifact = CertificateArtifact()
    for folder in folders:
        if artifact.json(folder).is_file():
            certificate = artifact.read(folder)
            if certificate.target == target:
                own = [certificate.attempt] if certificate.is_tested else []
                found += [one for one in (*certificate.earlier, *own) if one not in found]
    return sorted(found, key=lambda one: one.made)


def _other_study(target: str, store: Study, episodes: Sequence[Episode]) -> str:
    """Return the name of another study in which the policy ran some of these episodes. Empty if there is none."""
    wanted, seeds = set(map(attrgetter("task", "seed"), episodes)), [one.seed for one in episodes]
    query = (
        sa.select(STUDIES.c.name, SETTINGS.c.identity, WANTED.c.task, WANTED.c.seed)
        .select_from(WANTED.join(SETTINGS).join(STUDIES))
        .where(STUDIES.c.name != store.name, WANTED.c.episode_id.is_not(None))
        .where(WANTED.c.seed.between(min(seeds), max(seeds)))
    )
    with store.database.reading() as connection:
        for name, identity, task, seed in connection.execute(query):
            if identity.get("target") == target and (task, seed) in wanted:
                return str(name)
    return ""


def certify(certificate: Certificate, store: Study, wanted: Sequence[Episode], baseline: str) -> Certificate:
    """Test the candidates (the settings other than AR) in their order, each at level delta, until one fails.

    Return the certificate with the results. By fixed-sequence testing, the probability that any certified setting
    loses more than `margin` points is at most delta. Nothing is tested if AR solves less than half of its episodes.

    Args:
        certificate: The planned certificate.
        store: The stored episodes of its study.
        wanted: Episodes to use.
        baseline: Label of AR.
    """
    episodes = load_study(store, wanted).episodes
    episodes = episodes[episodes["repeat"] == 0]  # a repeat measures the same world again: it is no further pair
    pairs = paired(episodes, dict.fromkeys([one.label for one in certificate.candidates], baseline))
    testing = bool(episodes.loc[episodes["label"] == baseline, "success"].mean() >= SOLVED_BY_AR)
    candidates: list[Candidate] = []
    chosen = None
    for planned in certificate.candidates:
        own = pairs[pairs["label"] == planned.label]
        candidates.append(_candidate(planned, own, certificate.margin, certificate.delta, testing))
        testing = candidates[-1].p is not None and candidates[-1].p <= certificate.delta
        chosen = len(candidates) - 1 if testing else chosen
    return dataclasses.replace(certificate, candidates=candidates, chosen=chosen)


def _candidate(planned: Candidate, pairs: pd.DataFrame, margin: float, delta: float, testing: bool) -> Candidate:
    """Return a candidate with the results of its episodes and of its test against AR.

    Args:
        planned: The candidate without results.
        pairs: Its episodes paired with AR's, from `paired`.
        margin: Largest acceptable loss of success, in points.
        delta: Level of the test.
        testing: Whether to compute a p-value. False after an earlier setting has failed, or if AR solves too little.
    """
    ar, own = pairs["success_baseline"].to_numpy(float), pairs["success_method"].to_numpy(float)
    # (n,) values in a random order, independent of the tasks
    seed = int.from_bytes(hashlib.sha256(str(len(ar)).encode()).digest()[:4], "big")
    values, bound = np.random.default_rng(seed).permutation((1 + ar - own) / 2), (1 + margin / POINTS) / 2
    p = p_value(values, bound, delta) if testing else None
    return dataclasses.replace(
        planned,
        pairs=len(pairs),
        ar=int(ar.sum()),
        successes=int(own.sum()),
        lost=int((ar > own).sum()),
        won=int((ar < own).sum()),
        p=p,
    )


def write(folder: Path, certificate: Certificate) -> Path:
    """Write the certificate into the folder and return the file's path."""
    path = CertificateArtifact().json(folder)
    write_json(path, {**dataclasses.asdict(certificate), "actions": certificate.actions.as_dict()})
    return path


def candidate_rows(certificate: Certificate) -> list[dict[str, str]]:
    """Return the table of candidates to print: one dictionary of column to text per candidate."""
    rows = []
    for one in certificate.candidates:
        test = {"p": "not tested", "certified": ""}
        if one.p is not None:
            test = {"p": f"{one.p:.3g}", "certified": "yes" if one.p <= certificate.delta else "no"}
        success = {"success": f"{one.successes}/{one.pairs}", "success of AR": f"{one.ar}/{one.pairs}"}
        rows.append({"setting": one.label, **success, "lost / won": f"{one.lost} / {one.won}", **test})
    return rows


def _candidates(resolved: ResolvedStudy) -> dict[str, RolloutSettings]:
    """Return the settings of a study other than its baseline by label, in the study's order."""
    settings = dict(resolved.settings)
    del settings[resolved.study.baseline]
    return settings
