"""Write requirements/*.txt, the versions that `make setup` installs, from what is installed; with hashes of the files.

uv resolves what pyproject.toml needs under every supported Python and system. The installed versions are constraints.
Hashes of files for other Pythons and systems are left out, because they would take four times the space.
"""

import re
import subprocess
import sys
import tempfile
import tomllib
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from packaging.utils import parse_wheel_filename

ROOT = Path(__file__).resolve().parents[1]
HEAD = "# {}. Written by `make lock` (scripts/lock.py); pyproject.toml says what is needed.\n"
COMMON = "Versions and hashes of all that make setup installs, but PyTorch"
CUDA = "PyTorch for NVIDIA GPUs, and for systems without a CPU build"
CPU = "PyTorch's CPU build, which has an index of its own: by version alone"
PYTHONS = re.compile(r"py3|py2\.py3|cp31[123]")
SYSTEMS = re.compile(r"any|manylinux.*_(x86_64|aarch64)|macosx_.*_(x86_64|arm64|universal2)")


def resolved(constraints: Path) -> list[dict[str, Any]]:
    """The packages that are needed, as uv writes them (PEP 751)."""
    with tempfile.TemporaryDirectory() as tools:
        subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "--target", tools, "uv"], check=True)
        command = [f"{tools}/bin/uv", "pip", "compile", "pyproject.toml", "--extra=dev", "--universal"]
        command += ["--python-version=3.11", f"--constraint={constraints}", "--format=pylock.toml", "--quiet"]
        lock = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    packages: list[dict[str, Any]] = tomllib.loads(lock)["packages"]
    return packages


def is_used(wheel: dict[str, Any]) -> bool:
    """Whether a supported Python on a supported system can install a wheel."""
    for tag in parse_wheel_filename(wheel["url"].rpartition("/")[2])[3]:
        python = PYTHONS.fullmatch(tag.interpreter) or tag.abi == "abi3"
        if python and SYSTEMS.fullmatch(tag.platform):
            return True
    return False


def line_of(package: dict[str, Any]) -> str:
    """The requirement of one package: its version, where it is needed, and the hashes of its files."""
    files = [wheel for wheel in package.get("wheels", ()) if is_used(wheel)] or [package["sdist"]]
    where = f" ; {package['marker']}" if "marker" in package else ""
    hashes = sorted(file["hashes"]["sha256"] for file in files)
    return " \\\n".join(
        [f"{package['name']}=={package['version']}{where}", *(f"  --hash=sha256:{one}" for one in hashes)]
    )


def main() -> None:
    """Write the three files."""
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as constraints:
        for one in distributions():
            if one.name not in ("kerv", "pip"):
                constraints.write(f"{one.name}=={one.version.partition('+')[0]}\n")
        constraints.flush()
        packages = resolved(Path(constraints.name))
    lines: dict[str, list[str]] = {"common": [HEAD.format(COMMON)], "cuda": [HEAD.format(CUDA)]}
    for package in packages:
        of_torch = package["name"] in ("torch", "triton") or package["name"].startswith(("nvidia-", "cuda-"))
        lines["cuda" if of_torch else "common"].append(f"{line_of(package)}\n")
        if package["name"] == "torch":
            lines["cpu"] = [HEAD.format(CPU), f"torch=={package['version']}+cpu\n"]
    for name, text in lines.items():
        (ROOT / f"requirements/{name}.txt").write_text("".join(text))


if __name__ == "__main__":
    main()
