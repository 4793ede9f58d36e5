"""Find the folders of targets, shipped or trained, and of the artifacts that belong to them."""

from __future__ import annotations

from pathlib import Path

from kerv_cli.base.config import conf_dir
from kerv_cli.base.errors import UsageError
from kerv_cli.base.files import read_yaml_lines
from kerv_cli.base.paths import artifact_or_path, results_dir

RELEASED = ("libero-state", "mt10-state", "mt10-vision", "mt10-vision-parallel", "mt50-plain", "mt50-vision")
"""Names of the shipped policies. A checkout contains all of them, the wheel only `mt10-vision`."""

RESUME = "resume.pt"
"""File in the folder of a trained artifact from which its training can resume. Shipped artifacts do not have it."""


def shipped_dir() -> Path:
    """Return the folder of the shipped policies.

    It is `results/pretrained` in a checkout, else `pretrained` inside the installed package (`mt10-vision` alone).
    """
    package = Path(__file__).resolve().parents[1]
    checkout = package.parent / "results" / "pretrained"
    return checkout if checkout.is_dir() else package / "pretrained"


def find_target(results: str, name: str) -> Path:
    """Return the folder of a target.

    Args:
        results: The results folder.
        name: Path of the folder, which must contain a slash, or a name. A name is first looked up among the targets in
            the results folder, then among the shipped policies.

    Raises:
        UsageError: There is no such target. The message lists the existing ones.
    """
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
    making = command_of_a_study(f"name={name}") or f"kerv train target name={name}"
    remedies = ["name a folder that holds target.json" if "/" in name else f"make it with '{making}'"]
    names = target_names(results)
    remedies += [f"take one of {', '.join(names)}"] if names else []
    raise UsageError(f"no target '{name}' in {', '.join(map(str, folders))}: {', or '.join(remedies)}")


def command_of_a_study(word: str) -> str | None:
    """Return the command that a study's file gives for making what the study needs, if one contains the setting `word`.

    Args:
        word: A setting with its value, such as `name=mt10-h1-150m` or `policy.artifacts.drafter=mt10-h1-few`.
    """
    for path in sorted((conf_dir() / "study").glob("*.yaml")):
        for command in read_yaml_lines(path, f"study={path.stem}")[0].get("first", []):
            if word in command.split():
                return str(command)
    return None


def check_not_shipped(path: Path, word: str) -> None:
    """Check that writing an artifact does not replace an artifact of a shipped policy.

    Args:
        path: Folder to write to.
        word: Setting that chooses another folder, such as `policy.artifacts.scout`. Text for the error message.

    Raises:
        UsageError: The folder exists and belongs to a shipped policy, and the user has not trained its artifact.
    """
    made_here = (path / RESUME).is_file()
    if path.exists() and (path.parent / "target" / "target.json").is_file() and not made_here:
        raise UsageError(f"{path} is there, as a part of a shipped policy: {word}=NAME makes one of yours")


def target_names(results: str) -> list[str]:
    """Return the names of all targets: the shipped and unpacked policies, then those in the results folder."""
    folder, shipped = results_dir(results), []
    for policies in (shipped_dir(), folder / "pretrained"):
        shipped += [path.parts[-3] for path in policies.glob("[!.]*/target/target.json")]
    stored = [path.parent.name for path in folder.glob("artifacts/target/[!.]*/target.json")]
    return list(dict.fromkeys([*sorted(shipped), *sorted(stored)]))


def beside(target: Path, kind: str) -> Path:
    """Return the default folder of an artifact that belongs to a target. The folder need not exist.

    For a shipped target `pretrained/<name>/target` this is `pretrained/<name>/<kind>`, for a trained target
    `artifacts/target/<name>` it is `artifacts/<kind>/<name>`. For any other target it is a subfolder `<kind>`.

    Args:
        target: Folder of the target.
        kind: Kind of artifact, such as `drafter`.
    """
    if target.name == "target":
        return target.parent / kind
    return target.parent.parent / kind / target.name if target.parent.name == "target" else target / kind
