"""Describe how a result or a file was made: machine, versions of packages, git commit."""

from __future__ import annotations

import functools
import platform
import shutil
import socket
import subprocess
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = ("kerv", "torch", "metaworld", "mujoco", "numpy", "onnxruntime")
_HERE = Path(__file__).resolve().parent


def provenance_of(command: str, settings: Any, device: str, **figures: Any) -> dict[str, Any]:
    """Return the provenance of an artifact: command, settings, figures, versions, commit and device."""
    made = {"versions": versions(), "git_commit": git_commit(), "device": device, "device_name": device_name(device)}
    return {"command": command, "settings": asdict(settings), **figures, **made}


def stamp(device: str) -> dict[str, str]:
    """Return host, device, versions and commit. The keys are columns of the table of episodes."""
    numbers = {f"{name}_version": number for name, number in versions().items()}
    return {"host": socket.gethostname(), "device_name": device_name(device), **numbers, "git_commit": git_commit()}


@functools.cache
def versions() -> dict[str, str]:
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"


@functools.cache
def device_name(device: str) -> str:
    """Return the model name of the GPU for a CUDA device, else of the CPU."""
    if device.startswith("cuda"):
        import torch

        return torch.cuda.get_device_name(device)
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    return platform.processor() or platform.machine()


@functools.cache
def git_commit(folder: Path = _HERE) -> str:
    """Return kerv's commit, with `+changes` if a tracked file was modified.

    `none` if the folder is in no checkout of kerv.
    """
    if shutil.which("git") is None or not _git(folder, "ls-files", "--error-unmatch", "__init__.py"):
        return "none"  # an installed copy may be inside another project's repository
    changes = _git(folder, "status", "--porcelain", "--untracked-files=no", "--", ":/")
    return _git(folder, "rev-parse", "HEAD") + ("+changes" if changes else "")


def _git(folder: Path, *arguments: str) -> str:
    process = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=False)
    return process.stdout.strip() if process.returncode == 0 else ""
