"""Paths in the results folder (docs/formats.md), and the folders of targets, shipped or trained."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

from kerv_cli.base.errors import StorageError, UsageError
from kerv_cli.base.files import storage_errors, visible

# Pattern of names that can be used for a folder in the results folder: no slash, no leading dot.
PLAIN_NAME = re.compile(r"\w[\w.+-]{0,199}")

# Names of the shipped policies. A checkout contains all of them, the wheel only `mt10-h1`.
RELEASED = ("libero-state", "mt10-state", "mt10-h1", "mt10-h1-parallel", "mt50-plain", "mt50-vision")

# Name of the file from which a training can resume, in the artifact's folder. Shipped artifacts do not have it.
RESUME = "resume.pt"


def results_dir(results: str) -> Path:
    path = Path(results).expanduser()
    try:
        is_file = path.exists() and not path.is_dir()
    except OSError as error:
        raise UsageError(f"results={results[:80]}: {error.strerror}") from error
    if is_file:
        raise UsageError(f"results={results} is a file: name a folder")
    return path


def check_writable(results: str) -> Path:
    """Check that the results folder can be written. Return it, or the nearest existing folder above it."""
    folder = results_dir(results)
    parent = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not parent.is_dir():
        raise UsageError(f"results={results}: {parent} is a file, name a folder")
    try:
        # an unnamed file, if the file system supports that: nothing is left if the process is killed here
        with storage_errors(folder), tempfile.TemporaryFile(dir=parent):
            pass
    except OSError as error:
        raise StorageError(f"cannot write {folder}: {error.strerror}") from error
    return parent


def artifact(results: str, kind: str, name: str) -> Path:
    return results_dir(results) / "artifacts" / kind / check_name(name, f"{kind} name")


def artifact_or_path(results: str, kind: str, name: str) -> Path:
    return Path(name).expanduser() if "/" in name else artifact(results, kind, name)


def check_name(name: str, what: str) -> str:
    if len(name.encode()) > 200:
        raise UsageError(f"{what} '{name[:40]}…' has {len(name.encode())} bytes: at most 200")
    if not PLAIN_NAME.fullmatch(name):
        raise UsageError(
            f"{what} '{name}' must be letters, digits, '_', '-', '+', '.' and begin with a letter or a digit"
        )
    return name


def shipped_dir() -> Path:
    package = Path(__file__).resolve().parents[1]
    checkout = package.parent / "results" / "pretrained"
    return checkout if checkout.is_dir() else package / "pretrained"


def find_target(results: str, name: str) -> Path:
    """Return a target's folder. `name` is a path if it has a slash, else the name of a trained or shipped target."""
    policies = results_dir(results) / "pretrained"
    folders = [artifact_or_path(results, "target", name)]
    if "/" not in name:
        folders += [policies / name / "target", shipped_dir() / name / "target"]
    for folder in folders:
        if (folder / "target.json").is_file():
            return folder
    if name in RELEASED:
        raise UsageError(
            f"policy '{name}' is not in this wheel: fetch {name}.tar.gz of the release, then 'mkdir -p {policies} && "
            f"tar -xzf {name}.tar.gz -C {policies}'"
        )
    if (folders[0] / RESUME).is_file():
        raise UsageError(
            f"target '{name}' is unfinished: 'kerv runs show target/{name}' shows the command that goes on with its "
            "training"
        )
    making = f"make it with 'kerv train target name={name}'"
    remedies = ["name a folder that holds target.json" if "/" in name else making]
    names = target_names(results)
    remedies += [f"take one of {', '.join(names)}"] if names else []
    raise UsageError(f"no target '{name}' in {', '.join(map(str, folders))}: {', or '.join(remedies)}")


def check_free(path: Path, setting: str, replace: bool) -> None:
    """Refuse an existing file or folder unless `replace`. The error suggests another value of the key `setting`."""
    if not replace and (path.is_file() or visible(path)):
        raise UsageError(f"{path} is there already: choose another {setting}=NAME, or type replace=true to replace it")


def new_target(results: str, name: str) -> Path:
    folder = artifact(results, "target", name)
    for policies in (shipped_dir(), results_dir(results) / "pretrained"):
        if name in RELEASED or (policies / name).is_dir():
            raise UsageError(f"name={name} is the name of a policy that ships with kerv: choose another name=")
    return folder


def check_not_shipped(path: Path, word: str) -> None:
    """Refuse to replace an artifact of a shipped policy. The error suggests another value of the key `word`."""
    made_here = (path / RESUME).is_file()
    if path.exists() and (path.parent / "target" / "target.json").is_file() and not made_here:
        raise UsageError(f"{path} is there, as a part of a shipped policy: {word}=NAME makes one of yours")


def target_names(results: str) -> list[str]:
    folder, shipped = results_dir(results), []
    for policies in (shipped_dir(), folder / "pretrained"):
        shipped += [path.parts[-3] for path in policies.glob("[!.]*/target/target.json")]
    stored = [path.parent.name for path in folder.glob("artifacts/target/[!.]*/target.json")]
    return list(dict.fromkeys([*sorted(shipped), *sorted(stored)]))


def beside(target: Path, kind: str) -> Path:
    """Return the default folder of an artifact that belongs to a target. The folder need not exist.

    For a shipped target `pretrained/<name>/target` this is `pretrained/<name>/<kind>`, for a trained target
    `artifacts/target/<name>` it is `artifacts/<kind>/<name>`. For any other target it is `<target>/<kind>`.
    """
    if target.name == "target":
        return target.parent / kind
    return target.parent.parent / kind / target.name if target.parent.name == "target" else target / kind
