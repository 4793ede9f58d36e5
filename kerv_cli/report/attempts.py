"""See to it that a policy is tested for a certificate only once, on seeds that no other study ran.

A further test must be asked for and gets a smaller error probability (docs/methods.md §4.6).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import sqlalchemy as sa

from kerv_cli.base.durations import count
from kerv_cli.base.errors import UsageError
from kerv_cli.lab.database import SETTINGS, STUDIES, WANTED
from kerv_cli.lab.plan import Episode
from kerv_cli.lab.store import StudyStore
from kerv_cli.methods.certified.certificate import Attempt, Certificate, CertificateArtifact


def charged(
    certificate: Certificate, store: StudyStore, episodes: Sequence[Episode], paths: Iterable[Path], again: bool
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
            return replace(certificate, delta=attempt.delta, earlier=earlier[:number])
    if earlier and not again:
        raise UsageError(
            f"this policy has had {count(len(earlier), 'test')}, on seeds "
            f"{', '.join(one.seeds for one in earlier)}: another one is another chance to certify falsely. Set "
            f"again=true to test on other seeds at delta={certificate.delta / 2 ** len(earlier):g}"
        )
    for attempt in earlier:
        if attempt.seeds_served & {one.seed for one in episodes}:
            raise UsageError(f"seeds {attempt.seeds} served an earlier test of this policy: set seed= to others")
    if study := _other_study(certificate.target, store, episodes):
        raise UsageError(f"study '{study}' ran this policy on some of these seeds: set seed= to others")
    return replace(certificate, delta=certificate.delta / 2 ** len(earlier), earlier=earlier)


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


def _other_study(target: str, store: StudyStore, episodes: Sequence[Episode]) -> str:
    """Return the name of another study in which the policy ran some of these episodes. Empty if there is none."""
    wanted = {(one.task, one.seed) for one in episodes}
    seeds = {seed for _, seed in wanted}
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
