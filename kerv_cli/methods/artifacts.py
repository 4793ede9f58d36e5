"""Find, check and load the files of a policy: its target, and artifacts such as drafter, datastore and calibration.

Each file is loaded and hashed once per process.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import sha256_of
from kerv_cli.base.manifests import check_files, read_file
from kerv_cli.base.paths import artifact_or_path, beside, check_name, check_not_shipped, find_target
from kerv_cli.base.registry import ArtifactPart
from kerv_cli.base.runtime import dtype_of
from kerv_cli.base.spaces import ActionSpace
from kerv_cli.engine.protocol import Target
from kerv_cli.methods.settings import PolicySettings
from kerv_cli.targets import checkpoint
from kerv_cli.targets.checkpoint import TargetDescription

TARGET = "target"


def measured_again(*words: str) -> str:
    """Return what to type to measure a calibration again, with further overrides."""
    return (
        f"run '{' '.join(['kerv calibrate', *words, 'replace=true'])}' with the same policy.target= and "
        "policy.artifacts=; for a shipped policy policy.artifacts.calibration=NAME instead of replace=true"
    )


AGAIN = measured_again()


T = TypeVar("T")
_LOADED: dict[tuple[Any, ...], Any] = {}  # the key holds everything on which a loaded artifact depends


@dataclass(frozen=True)
class Use:
    """What a policy's artifacts will be used for. `Artifact.check_use` refuses a use before any weights are loaded.

    Args:
        method: Settings of the method's parts, by the kind of the part, such as `proposer`.
        tasks: Full names of the tasks. Empty if a client of `kerv serve` names the tasks later.
    """

    method: Mapping[str, Any]
    tasks: tuple[str, ...] = ()


@dataclass(frozen=True)
class MadeFor:
    """The target that an artifact was made for. If `chunk` is 0, the artifact works for chunks of any length."""

    sha256: str
    actions: ActionSpace
    chunk: int = 0

    @classmethod
    def of(cls, target: TargetDescription) -> MadeFor:
        return cls(target.origin["sha256"], target.actions, target.chunk)


def check_sources(sources: Mapping[str, str], used: Mapping[str, str], what: str, again: str) -> None:
    """Refuse an artifact if its `sources` (hashes by kind) differ from the artifacts `used` by the policy."""
    for kind, digest in sources.items():
        if used.get(kind, digest) != digest:
            noun = kind if kind == TARGET else kind_of(kind).noun
            raise CheckpointError(f"{what} for {noun} {digest[:12]}, not for {used[kind][:12]}: {again}")


class Artifact(Generic[T]):
    """Base class of the kinds of artifacts, such as drafter, datastore and calibration.

    An artifact is made for one target. One of its files is a JSON file with the fields of the dataclass `schema`.
    Drafters with weights derive from `TrainableDrafter` (`drafters.py`).

    Attributes:
        kind: Name of the kind in settings and paths, such as `drafter`.
        noun: Name of the kind in messages, such as `early drafter`.
        made: Verb for making such an artifact, in messages, such as `trained`.
        command: Command-line arguments after `kerv` that make such an artifact. Empty if no command makes it.
    """

    kind: str
    noun: str
    made = "trained"
    command: tuple[str, ...] = ()
    schema: type[T]

    def again(self, *words: str) -> str:
        return f"run 'kerv {' '.join((*self.command, *words))}'"

    def path(self, results: str, name: str | None, target: Path) -> Path:
        return artifact_or_path(results, self.kind, name) if name else beside(target, self.kind)

    def json(self, path: Path) -> Path:
        return path / f"{self.kind}.json"

    def load(self, path: Path, artifacts: Artifacts) -> Any:
        """Check and load the artifact in `path`. A subclass returns what a method uses, such as a network."""
        return self.checked(path, artifacts.description)

    def made_for(self, description: T) -> MadeFor:
        fields: Any = description
        return MadeFor(fields.target, fields.actions, fields.chunk)

    def sources(self, description: T) -> Mapping[str, str]:
        """Return the hashes of the other artifacts that this artifact was made from, by kind."""
        return {}

    def check_use(self, description: T, use: Use) -> None:
        """Refuse a use for which the artifact lacks something. This base class allows every use."""

    def is_complete(self, description: T, kinds: Collection[str]) -> bool:
        """Return whether the artifact holds all that a policy needs of it. `kinds`: those that the policy has."""
        return True

    def digest(self, path: Path, description: T) -> str:
        """Return a hash that identifies the artifact. Stored episodes contain it."""
        return sha256_of(self.json(path))

    def read(self, path: Path) -> T:
        """Read the description of the artifact in `path`, whatever target the artifact was made for."""
        file = self.json(path)
        if not file.is_file():
            raise CheckpointError(f"no {self.noun} in {path}: {self.again()}, or name a folder that holds one")
        return self.described(file)

    def described(self, file: Path) -> T:
        try:
            description = read_file(self.schema, file)
        except CheckpointError as error:
            raise CheckpointError(f"{error}; {self.again()}") from error
        check_files(file.parent, getattr(description, "files", {}), self.again())
        return description

    def checked(self, path: Path, target: TargetDescription) -> T:
        """Read the description of the artifact in `path`, and check that it was made for this target."""
        description = self.read(path)
        made, what, again = self.made_for(description), f"the {self.noun} in {path}", self.again("replace=true")
        made.actions.check_same(target.actions, what, "the target", statistics=True)
        what = f"{what} was {self.made}"
        if made.chunk and made.chunk != target.chunk:
            raise CheckpointError(f"{what} for chunks of {made.chunk} steps, not of {target.chunk}: {again}")
        check_sources({TARGET: made.sha256}, {TARGET: target.origin["sha256"]}, what, again)
        return description


class Artifacts:
    """The target and the artifacts of one policy, checked and loaded on demand."""

    def __init__(self, results: str, policy: PolicySettings, device: str = "cpu", dtype: str = "float32") -> None:
        self.results, self.policy, self.device, self.dtype = results, policy, device, dtype
        for kind, name in policy.artifacts.items():
            if name is not None:  # stored settings may list kinds of a plugin that is missing now
                ArtifactPart.find(kind, "policy.artifacts")
        self.folder = find_target(results, policy.target)

    @functools.cached_property
    def description(self) -> TargetDescription:
        return checkpoint.read_target(self.folder)

    @property
    def target(self) -> Any:
        return _target(self.folder, self.description.sha256, self.device, self.dtype)

    def path(self, kind: str) -> Path:
        beside = Path(self.description.origin.get("base", self.folder))
        return kind_of(kind).path(self.results, self.policy.artifacts.get(kind), beside)

    def new(self, kind: str) -> Path:
        """Return the path to which a command writes an artifact. Paths inside shipped policies are refused."""
        name = self.policy.artifacts.get(kind)
        if name:
            check_name(name, f"policy.artifacts.{kind}:")
        path = self.path(kind)
        check_not_shipped(path, f"policy.artifacts.{kind}")
        return path

    def exists(self, kind: str) -> bool:
        return kind_of(kind).json(self.path(kind)).is_file()

    def check(self, kinds: Iterable[str], use: Use | None = None) -> dict[str, str]:
        """Check artifacts without loading weights. Return the hashes, by kind, of the target and of these artifacts."""
        hashes, sources = {TARGET: self.description.sha256}, []
        named = (f"policy.artifacts.{kind}={name}" for kind, name in self.policy.artifacts.items() if name)
        words = [f"policy.target={self.policy.target}", *named, "replace=true"]
        for kind in dict.fromkeys(kinds):
            files, path = kind_of(kind), self.path(kind)
            if files.command and not self.exists(kind):
                raise CheckpointError(f"no {files.noun} in {path}: {self._making(files)}")
            description = files.checked(path, self.description)
            hashes[kind] = files.digest(path, description)
            what = f"the {files.noun} in {path} was {files.made}"
            sources.append((files.sources(description), what, files.again(*words)))
            if use is not None:
                files.check_use(description, use)
        for hashes_of_sources, what, again in sources:
            check_sources(hashes_of_sources, hashes, what, again)
        return hashes

    def _making(self, files: Artifact[Any]) -> str:
        target, name = f"policy.target={self.policy.target}", self.policy.artifacts.get(files.kind)
        setting = f"policy.artifacts.{files.kind}"
        if name and "/" in name:
            return f"name a folder that holds one, or leave {setting}= out"
        making = " ".join((*files.command, target, f"{setting}={name}")) if name else f"prepare {target}"
        return f"run 'kerv {making}', or name a folder that holds one"

    def load(self, kind: str) -> Any:
        """Load the policy's artifact of this kind. Further calls in this process return the same object."""
        path, digest = self.path(kind), self.check([kind])[kind]
        key = kind, path, digest, self.folder, self.device, self.dtype
        if key not in _LOADED:
            _LOADED[key] = kind_of(kind).load(path, self)
        return _LOADED[key]


def kind_of(name: str) -> Artifact[Any]:
    return ArtifactPart.find(name).built()


@functools.lru_cache(maxsize=16)
def _target(folder: Path, sha256: str, device: str, dtype: str) -> Target:
    return checkpoint.load_target(folder, device, dtype_of(dtype))[0]
