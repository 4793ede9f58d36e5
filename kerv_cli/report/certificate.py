"""Issue a certificate of success from a study's paired episodes.

The certificate bounds the success that a setting loses against autoregressive decoding (AR; docs/methods.md §4.6,
ours). AR is the study's baseline. The other settings are the candidates. The seeds must be new: no other study ran the
policy on them. A policy is tested once. Only `again=true` allows a further test, with a smaller error probability.

The test uses the predictable plug-in bets of Waudby-Smith and Ramdas (2024). The values are in [0, 1]. The hypothesis
is that each value has an expectation of at least `bound`, given the values before it. A bettor bets against the
hypothesis. Each bet is made before the next value is known. The bettor's wealth starts at 1. If the hypothesis is true,
the bets do not win on average, and the probability that the wealth ever reaches 1/δ is at most δ (Ville's inequality).
So a wealth of 1/δ rejects the hypothesis at level δ, and the wealth may be checked after each value.

Values of different groups, such as tasks, must come in random order. Sorted values would reject the hypothesis only
because of their order.

For a certificate of success, each value comes from two episodes with the same seed, one by autoregressive decoding and
one by the method. Let a be 1 if autoregressive decoding succeeds, else 0. Let b be 1 if the method succeeds, else 0.
The value is (1 + a − b) / 2, so 0, ½ or 1. The bound is (1 + m) / 2, where m is the margin. The hypothesis is that the
method's rate of success is lower by at least m.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterable, Sequence
from operator import attrgetter
from pathlib import Path

import numpy as np
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
from kerv_cli.report.measures import paired
from kerv_cli.report.tables import load_study
from kerv_cli.targets.provenance import provenance
from kerv_cli.training.settings import CalibrateSuccessSettings
from kerv_cli.worlds import resolve_tasks, spec_of

POINTS = 100.0
MOST = 0.75  # largest share of the wealth that a bet may lose
SOLVED_BY_AR = 0.5
"""Smallest success rate of AR for which a certificate is issued."""

_VARIED = ("prefill_draft", "skip")
"""Kinds of parts in which the candidates may differ."""
_CONDITIONS = ("task", "seed", "episodes", "world", "rollout.clock", "runtime.dtype", "policy.kind", "policy.target")
"""Settings that must be the same for all candidates and the baseline."""
_SHARED = tuple(kind for kind in METHOD_KINDS if kind not in _VARIED)
_OF_CANDIDATES = ("chunk", "policy", *_SHARED)
"""Settings that must be the same for all candidates, but may be different for the baseline."""


def folder_of(resolved: ResolvedStudy) -> Path:
    """Check that a certificate can be issued from a study. Return the folder to write the certificate into.

    Candidates may differ only in the settings `prefill_draft` and `skip`. The baseline must be AR. All settings must
    have the same tasks, seeds, policy, number format and world, without stress. The world must wait during decodes.

    Raises:
        UsageError: The study has only a baseline, or one of these conditions is not met. Or the study's seeds are
            outside the range reserved for selection, or the folder belongs to a policy that kerv ships.
    """
    candidates = _candidates(resolved)
    if not candidates:
        raise UsageError(f"study '{resolved.study.name}' has only its baseline: add a setting to certify")
    baseline, first = resolved.settings[resolved.study.baseline], next(iter(candidates.values()))
    for label, other in resolved.settings.items():
        for key in _CONDITIONS if other is baseline else (*_CONDITIONS, *_OF_CANDIDATES):
            if attrgetter(key)(other) != attrgetter(key)(first):
                raise UsageError(
                    f"setting '{label}' differs in {key}=: a certificate is of settings that differ in "
                    f"{'= and '.join(_VARIED)}= alone, and of AR under the same conditions"
                )
    for kind in (*_VARIED, "proposer"):
        if (chosen := getattr(baseline, kind).kind) != "none":
            raise UsageError(
                f"the baseline '{resolved.study.baseline}' has {kind}={chosen}: a certificate compares with AR, set "
                f"{kind}=none there"
            )
    if first.world.stress.active:
        raise UsageError("world.stress: a certificate says nothing of a stressed world, leave it out")
    if first.rollout.clock != WAITS:
        raise UsageError(f"rollout.clock={first.rollout.clock}: a certificate is of a world that waits, leave it out")
    seeds = range(first.seed, first.seed + first.episodes)
    spec_of(resolve_tasks(first.task)[0]).seeds.check(seeds, "selection", f"seed={first.seed}")
    return artifacts_of(first).new(CertificateArtifact.kind)


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
        UsageError: A different test of this policy was run before and `settings.again` is not set. Or another study or
            a different earlier test ran the policy on one of these seeds.
        CheckpointError: An artifact of a candidate is missing or damaged, or an existing certificate is damaged.
    """
    tested = _candidates(resolved)
    first = next(iter(tested.values()))
    artifacts, tasks = artifacts_of(first), resolve_tasks(first.task)
    needs, candidates = list[str](), []
    for label, one in tested.items():
        needs += Method.of(one).needs
        skip, draft = dataclasses.asdict(one.skip), dataclasses.asdict(one.prefill_draft)
        candidates.append(Candidate(label, skip=skip, draft=draft))
    hashes = artifacts.check(needs)
    certificate = Certificate(
        target=hashes.pop("target"),
        actions=artifacts.description.actions,
        chunk=first.chunk or artifacts.description.chunk,
        environment=spec_of(tasks[0]).name,
        tasks=list(tasks),
        drafts=hashes,
        method={kind: dataclasses.asdict(getattr(first, kind)) for kind in _SHARED},
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

    The n-th test of a policy gets delta / 2^(n − 1). Repeating exactly the same test (same candidates, seeds, margin,
    delta and so on) does not count as a new test. It gets the same error probability as before, and needs no `again`.

    Args:
        certificate: The planned certificate. Its `delta` is the error probability of a first test.
        store: The study whose episodes are the test.
        episodes: The episodes of the test.
        paths: Folders of existing certificates. Certificates of other policies do not count.
        again: Whether a further, different test of the policy is allowed.

    Returns:
        The certificate with its `earlier` tests and the `delta` of this test.

    Raises:
        UsageError: A different test of this policy was run before and `again` is not set. Or a different earlier test
            of this policy used one of these seeds. Or another study ran the policy on one of these tasks and seeds. A
            repeated test raises none of these errors.
        CheckpointError: A certificate is damaged.
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

    Raises:
        CheckpointError: A certificate is damaged.
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
    """Return the name of another study in which the policy ran one of these tasks with the same seed. Empty if none."""
    wanted, seeds = set(map(attrgetter("task", "seed"), episodes)), sorted(map(attrgetter("seed"), episodes))
    query = (
        sa.select(STUDIES.c.name, SETTINGS.c.identity, WANTED.c.task, WANTED.c.seed)
        .select_from(WANTED.join(SETTINGS).join(STUDIES))
        .where(STUDIES.c.name != store.name, WANTED.c.episode_id.is_not(None))
        .where(WANTED.c.seed.between(seeds[0], seeds[-1]))
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
        store: The study with the stored episodes.
        wanted: Episodes to use.
        baseline: Label of AR.
    """
    episodes = load_study(store, wanted).episodes
    episodes = episodes[episodes["repeat"] == 0]  # a repeat measures the same world again: it is no further pair
    pairs = paired(episodes, dict.fromkeys(map(attrgetter("label"), certificate.candidates), baseline))
    testing = bool(episodes.loc[episodes["label"] == baseline, "success"].mean() >= SOLVED_BY_AR)
    candidates: list[Candidate] = []
    chosen = None
    for planned in certificate.candidates:
        of_planned = pairs[pairs["label"] == planned.label]
        ar, own = of_planned["success_baseline"].to_numpy(float), of_planned["success_method"].to_numpy(float)
        # (n,) values in a random order, independent of the tasks
        seed = int.from_bytes(hashlib.sha256(str(len(ar)).encode()).digest()[:4], "big")
        values = np.random.default_rng(seed).permutation((1 + ar - own) / 2)
        p = p_value(values, (1 + certificate.margin / POINTS) / 2, certificate.delta) if testing else None
        lost, won, solved = int((ar > own).sum()), int((ar < own).sum()), int(own.sum())
        tested = dataclasses.replace(
            planned, pairs=len(ar), ar=int(ar.sum()), successes=solved, lost=lost, won=won, p=p
        )
        candidates.append(tested)
        testing = p is not None and p <= certificate.delta
        chosen = len(candidates) - 1 if testing else chosen
    return dataclasses.replace(certificate, candidates=candidates, chosen=chosen)


def write(folder: Path, certificate: Certificate) -> Path:
    """Write the certificate into the folder and return the file's path."""
    path = CertificateArtifact().json(folder)
    write_json(path, {**dataclasses.asdict(certificate), "actions": certificate.actions.as_dict()})
    return path


def candidate_rows(certificate: Certificate) -> list[dict[str, str]]:
    """Return the table of candidates to print: for each candidate a dictionary from column name to text."""
    rows = []
    for one in certificate.candidates:
        test = {"p": "not tested", "certified": ""}
        if one.p is not None:
            test = {"p": f"{one.p:.3g}", "certified": "yes" if one.p <= certificate.delta else "no"}
        success = {"success": f"{one.successes}/{one.pairs}", "success of AR": f"{one.ar}/{one.pairs}"}
        rows.append({"setting": one.label, **success, "lost / won": f"{one.lost} / {one.won}", **test})
    return rows


def _candidates(resolved: ResolvedStudy) -> dict[str, RolloutSettings]:
    """Return all settings of a study except the baseline, by label, in the study's order."""
    settings = dict(resolved.settings)
    del settings[resolved.study.baseline]
    return settings


def bets(values: np.ndarray, bound: float, delta: float) -> np.ndarray:
    """Return the size of the bet on each value. A bet multiplies the wealth by 1 + size · (bound − value).

    Each bet depends only on the values before it and on the number of values n. So n must be chosen before the test.

    Args:
        values: (n,) in [0, 1], in the order in which they came.
        bound: The hypothesis is that the mean is at least `bound`, in (0, 1).
        delta: Error probability δ for which the bets are optimised.

    Returns:
        (n,) sizes of the bets.
    """
    count = np.arange(1, len(values) + 1)
    mean = (0.5 + np.cumsum(values)) / (count + 1)
    variance = (0.25 + np.cumsum((values - mean) ** 2)) / (count + 1)
    before = np.concatenate([[0.25], variance])[:-1]
    aim = 2 * math.log(1 / delta) / max(1, len(values))
    return np.minimum(np.sqrt(aim / before), MOST / (1 - bound))


def wealth(values: np.ndarray, bound: float, delta: float) -> np.ndarray:
    """Return the bettor's wealth after each value, (n,). It starts at 1 and grows if the mean is below `bound`.

    Args:
        values: (n,) in [0, 1], in the order in which they came.
        bound: The hypothesis is that the mean is at least `bound`, in (0, 1).
        delta: Error probability δ for which the bets are optimised. A test at another level δ′ may use the same wealth.
            That test rejects the hypothesis if the wealth reaches 1/δ′.
    """
    return np.exp(np.cumsum(np.log1p(bets(values, bound, delta) * (bound - values))))


def p_value(values: np.ndarray, bound: float, delta: float) -> float:
    """Return the p-value of the hypothesis that the mean is at least `bound`. It is 1 if there are no values.

    A bettor with an initial wealth of 1 bets against the hypothesis. The p-value is 1 divided by the largest wealth so
    far. So the p-value stays valid if it is checked after each value.

    Args:
        values: (n,) in [0, 1], in the order in which they came.
        bound: The hypothesis is that the mean is at least `bound`, in (0, 1).
        delta: Error probability δ for which the bets are optimised.
    """
    return float(1 / max(1.0, wealth(values, bound, delta).max(initial=1.0)))
