"""Install a released policy from an archive, for `kerv build policy`: download, check, unpack."""

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

TIMEOUT = 60.0  # seconds without an answer after which a download fails


def install(settings: BuildPolicySettings) -> Path:
    """Unpack the archive `settings.source` and return the policy's folder in `<results>/pretrained`.

    The weights must have the hash in their description. For kerv's own policies this must be the hash in RELEASED. For
    any other policy the archive must have the hash `settings.sha256`.

    Raises:
        UsageError: The source is missing, `sha256` is missing for a policy that is not kerv's, or the policy exists.
        CheckpointError: The archive is damaged, has a different hash, or contains no policy.
        KervError: The download failed.
        StorageError: The disk is full or read-only, or permission is missing.
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
    """Return the path of the archive. A URL is downloaded into the folder `scratch`."""
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
    """Unpack an archive and return the folder of the policy in it.

    Args:
        archive: The archive (.tar.gz).
        content: Folder to unpack to.
        source: Path or URL of the archive as typed, for the error message.

    Raises:
        CheckpointError: The archive is damaged, or does not contain exactly one policy.
    """
    try:
        with tarfile.open(archive) as file:
            file.extractall(content, filter="data")
    except (tarfile.TarError, EOFError, OSError) as error:
        raise CheckpointError(f"source={source} is no intact archive (.tar.gz): {error}") from error
    folders = [path.parents[1] for path in content.glob("*/target/target.json")]
    if len(folders) != 1:
        raise CheckpointError(f"source={source} holds no policy: one folder with target/target.json in it")
    return folders[0]
