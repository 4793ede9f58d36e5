"""The files of a policy: the target and the artifacts that belong to it, each loaded and hashed once per process,
however many settings of a study share them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.places import artifact, beside, find_target
from kerv_cli.base.registry import find, load
from kerv_cli.base.settings import PolicySettings
from kerv_cli.base.spaces import ActionSpace

if TYPE_CHECKING:
    from kerv_cli.engine.protocol import Target
    from kerv_cli.targets.checkpoint import TargetDescription


@dataclass(frozen=True)
class Request:
    """The target to check or load an artifact for. search: settings of a datastore's search."""

    description: TargetDescription
    search: Any = None
    target: Target | None = None  # loaded, where the artifact is to be loaded for it


NOUNS = {"early": "early drafter", "score": "learned score"}
"""Kind of artifact -> its name in messages, where that is another."""


@dataclass(frozen=True)
class MadeFrom:
    """What an artifact was made from: kind -> hash of the target or artifact that it names as a source.

    what: the artifact in messages. made: e.g. trained. again: the remedy.
    """

    what: str
    made: str
    again: str
    hashes: Mapping[str, str]

    def check_same(self, used: Mapping[str, str]) -> None:
        """Refuses the artifact where its sources are not the policy's. used: kind -> hash of the policy's target and
        artifacts; a source of a kind that the policy does not use does not matter.

        Raises:
            CheckpointError: the policy uses another artifact of the same kind as one of its sources.
        """
        for kind, digest in self.hashes.items():
            if used.get(kind, digest) != digest:
                raise CheckpointError(
                    f"{self.what} was {self.made} for {NOUNS.get(kind, kind)} {digest[:12]}, not for "
                    f"{used[kind][:12]}: {self.again}"
                )


def no_sources(path: Path) -> MadeFrom:
    """`Artifact.sources` of a kind that is made from target and demonstrations alone: none."""
    return MadeFrom("", "", "", {})


@dataclass(frozen=True)
class Artifact:
    """One kind of artifact.

    place: (results, name or None, the target's folder) -> its path; None names the one beside the target. check: (path,
    request) -> its hash, or CheckpointError where it is missing, damaged or another target's. load: (path, request) ->
    the loaded artifact. sources: path of a checked one -> the other artifacts that it was made from.
    """

    kind: str
    place: Callable[[str, str | None, Path], Path]
    check: Callable[[Path, Request], str]
    load: Callable[[Path, Request], Any]
    sources: Callable[[Path], MadeFrom] = no_sources


def artifact_folder(kind: str) -> Callable[[str, str | None, Path], Path]:
    """`Artifact.place` of a kind that is a folder: the named one, else the one beside the target."""

    def place(results: str, name: str | None, target: Path) -> Path:
        return artifact(results, kind, name) if name else beside(target, kind)

    return place


@dataclass(frozen=True)
class MadeFor:
    """The target that an artifact was made for: SHA-256 of its weights, its action space, H (0: any)."""

    sha256: str
    actions: ActionSpace
    chunk: int = 0

    def check_same(self, target: MadeFor, what: str, made: str, again: str) -> None:
        """Refuses another target. what: the artifact in messages. made: e.g. trained. again: the remedy.

        Raises:
            CheckpointError: another action space, normalisation, chunk length or other weights.
        """
        self.actions.check_same(target.actions, what, "the target", statistics=True)
        if self.chunk != target.chunk:
            raise CheckpointError(f"{what} was {made} for chunks of {self.chunk} steps, not of {target.chunk}: {again}")
        MadeFrom(what, made, again, {"target": self.sha256}).check_same({"target": target.sha256})


class Artifacts:
    """The artifacts of one policy, checked and loaded on demand.

    results, policy, search: as in RolloutSettings. device, dtype: of what is loaded, as `runtime.set_up` gives them.
    """

    def __init__(
        self, results: str, policy: PolicySettings, search: Any = None, device: str = "cpu", dtype: str = "float32"
    ) -> None:
        self.results, self.policy, self.search, self.device, self.dtype = results, policy, search, device, dtype
        self.folder = find_target(results, policy.target)

    @functools.cached_property
    def description(self) -> TargetDescription:
        """The target's description; its weights are not loaded."""
        from kerv_cli.targets.checkpoint import read_target

        return read_target(self.folder)

    @property
    def target(self) -> Target:
        """The target, loaded."""
        return _target(self.folder, self.description.sha256, self.device, self.dtype)

    def place(self, kind: str) -> Path:
        """Path of the artifact of this kind."""
        return _kind(kind).place(self.results, self.policy.named(kind), self.folder)

    def check(self, kinds: Iterable[str]) -> dict[str, str]:
        """Kind -> hash, of the target and of `kinds`.

        Raises:
            CheckpointError: one is missing, damaged, or was made for another target, or from another artifact than the
                one among `kinds`.
        """
        request, kinds = Request(self.description, self.search), tuple(kinds)
        hashes = {"target": self.description.sha256}
        hashes |= {kind: _kind(kind).check(self.place(kind), request) for kind in kinds}
        for kind in kinds:
            _kind(kind).sources(self.place(kind)).check_same(hashes)
        return hashes

    def load(self, kind: str) -> Any:
        """The artifact, for the loaded target; one object per process.

        Raises:
            CheckpointError: as `check`.
        """
        digest = self.check([kind])[kind]
        return _artifact(kind, self.place(kind), digest, _Owner(self.folder, self.device, self.dtype, self.search))


@dataclass(frozen=True)
class _Owner:
    """Of a loaded artifact. search: settings without a hash of their own, compared by their text."""

    folder: Path
    device: str
    dtype: str
    search: Any

    def __hash__(self) -> int:
        return hash((self.folder, self.device, self.dtype, repr(self.search)))


def _kind(name: str) -> Artifact:
    artifact_kind: Artifact = load(find("artifact", name).build)
    return artifact_kind


@functools.lru_cache(maxsize=16)
def _target(folder: Path, sha256: str, device: str, dtype: str) -> Target:
    from kerv_cli.base.runtime import DTYPES
    from kerv_cli.targets.checkpoint import load_target

    return load_target(folder, device, DTYPES[dtype])[0]


@functools.lru_cache(maxsize=64)
def _artifact(kind: str, path: Path, digest: str, owner: _Owner) -> Any:
    from kerv_cli.targets.checkpoint import read_target

    description = read_target(owner.folder)
    target = _target(owner.folder, description.sha256, owner.device, owner.dtype)
    return _kind(kind).load(path, Request(description, owner.search, target))
