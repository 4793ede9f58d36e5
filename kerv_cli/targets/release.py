"""Installs an archive of a released policy: `kerv build policy` checks it and puts it where policies are looked for."""

from __future__ import annotations

import shutil
import tarfile
import tempfile
import urllib.error
import urllib.request
from pathlib import Path

from kerv_cli.base.errors import CheckpointError, KervError, UsageError
from kerv_cli.base.files import sha256_of, write_folder
from kerv_cli.base.places import as_path, results_dir
from kerv_cli.targets.checkpoint import read_target
from kerv_cli.targets.folders import RELEASED
from kerv_cli.targets.settings import BuildPolicySettings

TIMEOUT = 60.0  # seconds without an answer


def install(settings: BuildPolicySettings) -> Path:
    """Unpack the archive `settings.source`. Return the policy's folder below `<results>/pretrained`.

    Weights are checked against their description. The target is checked against the hash that kerv knows, or another
    policy's archive against the hash in the settings.

    Raises:
        UsageError: There is no source, no archive, or nothing to check it with.
        CheckpointError: The archive is another one than was asked for, damaged, or holds no policy.
        KervError: The download failed.
        StorageError: Writing failed.
    """
    source = settings.source
    if not source:
        raise UsageError("source=FILE: name the archive of a policy, by URL or path")
    with tempfile.TemporaryDirectory() as scratch:
        archive = _archive(source, Path(scratch))
        digest = sha256_of(archive)
        if settings.sha256 and digest != settings.sha256.lower():
            raise CheckpointError(f"{source} has SHA-256 {digest}, not sha256={settings.sha256}")
        policy = _unpacked(archive, Path(scratch) / "content", source)
        target = read_target(policy / "target")  # checks the weights
        if target.sha256 != RELEASED.get(policy.name, target.sha256):
            raise CheckpointError(f"{source} holds another target than kerv's {policy.name}: fetch it again")
        if policy.name not in RELEASED and not settings.sha256:
            raise UsageError(f"{policy.name} is no policy of kerv: set sha256={digest} if you trust {source}")
        folder = results_dir(settings.results) / "pretrained" / policy.name
        if not write_folder(folder, lambda new: shutil.copytree(policy, new, dirs_exist_ok=True)):
            raise UsageError(f"{folder} is there already: remove it first")
    return folder


def _archive(source: str, scratch: Path) -> Path:
    """Return the file of a path, or the download of a URL."""
    if not source.startswith(("http://", "https://")):
        path = as_path(source)
        if not path.is_file():
            raise UsageError(f"source={source}: no such file")
        return path
    path = scratch / "archive"
    try:
        with urllib.request.urlopen(source, timeout=TIMEOUT) as answer, path.open("wb") as file:
            shutil.copyfileobj(answer, file)
    except (urllib.error.URLError, OSError, ValueError) as error:
        if isinstance(error, urllib.error.HTTPError):
            error.close()  # it holds the connection
        raise KervError(f"source={source} cannot be fetched: {getattr(error, 'reason', error)}") from error
    return path


def _unpacked(archive: Path, content: Path, source: str) -> Path:
    """Return the one policy's folder in the archive."""
    try:
        with tarfile.open(archive) as file:
            file.extractall(content, filter="data")
    except (tarfile.TarError, EOFError, OSError) as error:
        raise CheckpointError(f"source={source} is no intact archive (.tar.gz): {error}") from error
    folders = [path.parents[1] for path in content.glob("*/target/target.json")]
    if len(folders) != 1:
        raise CheckpointError(f"source={source} holds no policy: one folder with target/target.json in it")
    return folders[0]
