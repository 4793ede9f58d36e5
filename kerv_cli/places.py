"""Where things lie below the results folder (ARCHITECTURE, On disk)."""

from __future__ import annotations

from pathlib import Path

from kerv_cli.errors import CheckpointError, UsageError


def results_dir(results: str) -> Path:
    path = Path(results).expanduser()
    if path.exists() and not path.is_dir():
        raise UsageError(f"results={results} is a file: name a folder")
    return path


def artifact(results: str, kind: str, name: str) -> Path:
    """The folder of something trained or built; a name with a slash is a path of its own."""
    if "/" in name:
        return Path(name).expanduser()
    return results_dir(results) / "artifacts" / kind / name


def shipped_dir() -> Path:
    """`results/pretrained` of the checkout that the package runs from."""
    return Path(__file__).resolve().parent.parent / "results" / "pretrained"


def find_target(results: str, name: str) -> Path:
    """The target's folder: a path, a freshly trained artifact, else what the project ships.

    Raises:
        CheckpointError: nothing of that name; the line lists what there is.
    """
    if "/" in name:
        places = [Path(name).expanduser()]
    else:
        places = [
            artifact(results, "target", name),
            results_dir(results) / "pretrained" / name / "target",
            shipped_dir() / name / "target",
        ]
    for place in places:
        if (place / "target.json").is_file():
            return place
    known = sorted({p.parent.parent.name for p in shipped_dir().glob("*/target/target.json")})
    known += sorted({p.parent.name for p in (results_dir(results) / "artifacts/target").glob("*/target.json")})
    raise CheckpointError(
        f"no target '{name}' in {', '.join(map(str, places))}: train it with 'kerv train target name={name}'"
        + (f", or take one of {', '.join(dict.fromkeys(known))}" if known else "")
    )


def beside(target: Path, kind: str) -> Path:
    """The folder of this kind that belongs to the target. Shipped: pretrained/<name>/{target,<kind>}; trained:
    artifacts/target/<name> and artifacts/<kind>/<name>; else a folder inside the target's."""
    if target.name == "target":
        return target.parent / kind
    return target.parent.parent / kind / target.name if target.parent.name == "target" else target / kind
