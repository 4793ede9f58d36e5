"""The files of a policy: its target and the artifacts that belong to it. Each is loaded and hashed once per process."""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import sha256_of
from kerv_cli.base.manifests import check_files, read_file
from kerv_cli.base.places import artifact
from kerv_cli.base.registry import find
from kerv_cli.base.runtime import DTYPES
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.protocol import Target
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.targets import checkpoint
from kerv_cli.targets.checkpoint import TargetDescription
from kerv_cli.targets.folders import beside, find_target

TARGET = "target"


T = TypeVar("T")
_LOADED: dict[tuple[Any, ...], Any] = {}
"""Artifacts of this process by everything that they depend on."""


@dataclass(frozen=True)
class Use:
    """What the artifacts of a method are used for, before anything is loaded.

    Args:
        method: Kind -> settings of the method's parts.
        dtype: Number format of the models.
        environment: Name of the policy's environment.
        tasks: Full names of the tasks; empty if a client names them later.
        world: Camera and horizon; None if they are a client's.
    """

    method: Mapping[str, Any]
    dtype: str
    environment: str
    tasks: tuple[str, ...] = ()
    world: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class MadeFor:
    """The target that an artifact was made for.

    Attributes:
        sha256: Hash of its weights.
        actions: Its action space.
        chunk: H; 0 if it does not matter.
    """

    sha256: str
    actions: ActionSpace
    chunk: int = 0

    @classmethod
    def of(cls, target: TargetDescription) -> MadeFor:
        """Return the target of a description."""
        return cls(target.origin["sha256"], target.actions, target.chunk)

    def check_same(self, target: MadeFor, what: str, made: str, again: str) -> None:
        """Refuse another target.

        Args:
            target: The policy's.
            what: Names the artifact in messages.
            made: How it was made, e.g. `trained`.
            again: The remedy.

        Raises:
            CheckpointError: Another action space, normalisation, chunk length or other weights.
        """
        self.actions.check_same(target.actions, what, "the target", statistics=True)
        if self.chunk and self.chunk != target.chunk:
            raise CheckpointError(f"{what} was {made} for chunks of {self.chunk} steps, not of {target.chunk}: {again}")
        check_sources({TARGET: self.sha256}, {TARGET: target.sha256}, f"{what} was {made}", again)


def check_sources(sources: Mapping[str, str], used: Mapping[str, str], what: str, again: str) -> None:
    """Refuse an artifact that was made from other artifacts than those of the policy.

    Args:
        sources: Kind -> hash of what it was made from. Kinds that the policy does not use do not matter.
        used: Kind -> hash of the policy's target and artifacts.
        what: Beginning of the message, e.g. `the early drafter in FOLDER was trained`.
        again: The remedy.

    Raises:
        CheckpointError: The policy uses another artifact of one of these kinds.
    """
    for kind, digest in sources.items():
        if used.get(kind, digest) != digest:
            noun = kind if kind == TARGET else kind_of(kind).noun
            raise CheckpointError(f"{what} for {noun} {digest[:12]}, not for {used[kind][:12]}: {again}")


def removal(kind: str, path: Path) -> str:
    """Return how to make room for a new artifact."""
    return f"remove it with 'kerv runs rm {kind}/{path.name}'" if path.parent.name == kind else f"move {path} aside"


class Artifact(Generic[T]):
    """A kind of artifact: one JSON of the dataclass `schema`, perhaps with other files beside it, made for one target.

    `TrainableDrafter` (`drafters.py`) is the base of those with weights.

    Attributes:
        kind: Its name among the parts.
        noun: Its name in messages.
        made: How it is made, e.g. `trained`.
        command: Words after `kerv` that make one; empty if no command does.
    """

    kind: str
    noun: str
    made = "trained"
    command: tuple[str, ...] = ()
    schema: type[T]

    @property
    def again(self) -> str:
        """How to get one that is missing or does not fit."""
        return f"run 'kerv {' '.join(self.command)}'"

    def anew(self, path: Path) -> str:
        """Return how to replace one that was made for another target."""
        return self.again

    def path(self, results: str, name: str | None, target: Path) -> Path:
        """Return its path: that of a name, else the one beside the target in the folder `target`."""
        return artifact(results, self.kind, name) if name else beside(target, self.kind)

    def json(self, path: Path) -> Path:
        """Return the file of its description."""
        return path / f"{self.kind}.json"

    def load(self, path: Path, artifacts: Artifacts) -> Any:
        """Return the artifact, loaded for the target of `artifacts`. One without other files is its description.

        Raises:
            CheckpointError: As `checked`, or files that do not fit.
        """
        return self.checked(path, artifacts.description)

    def made_for(self, description: T) -> MadeFor:
        """Return the target that it was made for."""
        fields: Any = description
        return MadeFor(fields.target, fields.actions, fields.chunk)

    def sources(self, description: T) -> Mapping[str, str]:
        """Return kind -> hash of the other artifacts that it was made from."""
        return {}

    def needs(self, description: T) -> tuple[str, ...]:
        """Return further kinds that a method with this artifact reads. Only the artifact knows them."""
        return ()

    def check_use(self, description: T, use: Use) -> None:
        """Refuse a use that the artifact does not fit.

        Raises:
            UsageError: Another method or world than it was made for.
            CheckpointError: It lacks something that the method reads.
        """

    def command_beside(self, kinds: Collection[str]) -> tuple[str, ...]:
        """Return `command` for a target that has artifacts of these `kinds`."""
        return self.command

    def is_complete(self, description: T, kinds: Collection[str]) -> bool:
        """Return whether it has all that `command` would make of the artifacts `kinds`."""
        return True

    def digest(self, path: Path, description: T) -> str:
        """Return the hash by which it counts in the identity of results."""
        return sha256_of(self.json(path))

    def read(self, path: Path) -> T:
        """Return its description, whatever its target.

        Raises:
            CheckpointError: It is missing, damaged or of another format, or its files are not those that it names.
        """
        file = self.json(path)
        if not file.is_file():
            raise CheckpointError(f"no {self.noun} in {path}: {self.again}, or name a folder that holds one")
        return self.described(file)

    def described(self, file: Path) -> T:
        """Return the description in an existing file. The errors are those of `read`."""
        try:
            description = read_file(self.schema, file)
        except CheckpointError as error:
            raise CheckpointError(f"{error}; {self.again}") from error
        check_files(file.parent, getattr(description, "files", {}), self.again)
        return description

    def checked(self, path: Path, target: TargetDescription) -> T:
        """Return its description, if it was made for this target.

        Raises:
            CheckpointError: As `read`, or another target, action space or chunk length.
        """
        description = self.read(path)
        made_for, what = self.made_for(description), f"the {self.noun} in {path}"
        made_for.check_same(MadeFor.of(target), what, self.made, self.anew(path))
        return description


class Artifacts:
    """The artifacts of one policy, checked and loaded on demand."""

    def __init__(
        self, results: str, policy: PolicySettings, search: Any = None, device: str = "cpu", dtype: str = "float32"
    ) -> None:
        self.results, self.policy, self.search, self.device, self.dtype = results, policy, search, device, dtype
        for kind in policy.artifacts:
            find("artifact", kind, "policy.artifacts")
        self.folder = find_target(results, policy.target)

    @functools.cached_property
    def description(self) -> TargetDescription:
        """The target's description. Its weights are not loaded."""
        return checkpoint.read_target(self.folder)

    @property
    def target(self) -> Any:
        """The target, loaded: a Target, of most families a ReadableTarget."""
        return _target(self.folder, self.description.sha256, self.device, self.dtype)

    def path(self, kind: str) -> Path:
        """Return the path of the artifact of this kind."""
        beside = Path(self.description.origin.get("base", self.folder))
        return kind_of(kind).path(self.results, self.policy.artifacts.get(kind), beside)

    def check(self, kinds: Iterable[str], use: Use | None = None) -> dict[str, str]:
        """Return kind -> hash, of the target and of `kinds`.

        Args:
            kinds: Kinds of artifacts.
            use: What they are for. None: not checked.

        Raises:
            CheckpointError: One is missing, damaged, or was made for another target, or from another artifact than the
                one among `kinds`.
            UsageError: One does not fit its use.
        """
        hashes, sources, todo = {TARGET: self.description.sha256}, [], list(kinds)
        for kind in todo:
            if kind in hashes:
                continue
            files, path = kind_of(kind), self.path(kind)
            if files.command and not files.json(path).is_file():
                line = " ".join(self._making(files))
                raise CheckpointError(f"no {files.noun} in {path}: run 'kerv {line}', or name a folder that holds one")
            description = files.checked(path, self.description)
            hashes[kind] = files.digest(path, description)
            todo += files.needs(description)
            what = f"the {files.noun} in {path} was {files.made}"
            sources.append((files.sources(description), what, files.anew(path)))
            if use is not None:
                files.check_use(description, use)
        for hashes_of_sources, what, again in sources:
            check_sources(hashes_of_sources, hashes, what, again)
        return hashes

    def _making(self, files: Artifact[Any]) -> tuple[str, ...]:
        """Return the words of the command that makes a missing artifact."""
        target, name = f"policy.target={self.policy.target}", self.policy.artifacts.get(files.kind)
        if name is None or "/" in name:
            return "prepare", target
        return *files.command, target, f"policy.artifacts.{files.kind}={name}"

    def load(self, kind: str) -> Any:
        """Return the artifact, loaded for the target. It is one object per process.

        Raises:
            CheckpointError: As `check`.
        """
        path, digest = self.path(kind), self.check([kind])[kind]
        key = kind, path, digest, self.folder, self.device, self.dtype, repr(self.search)
        if key not in _LOADED:
            _LOADED[key] = kind_of(kind).load(path, self)
        return _LOADED[key]


def kind_of(name: str) -> Artifact[Any]:
    """Return the kind of artifact of this name.

    Raises:
        UnknownName: There is none.
    """
    return find("artifact", name).built()


@functools.lru_cache(maxsize=16)
def _target(folder: Path, sha256: str, device: str, dtype: str) -> Target:
    return checkpoint.load_target(folder, device, DTYPES[dtype])[0]
