"""Where a result comes from: machine, versions, commit."""

from __future__ import annotations

import functools
import importlib.metadata
import platform
import shutil
import socket
import subprocess
from pathlib import Path

PACKAGES = ("kerv", "torch", "metaworld", "mujoco", "numpy")
_PACKAGE = Path(__file__).resolve().parents[1]


def provenance(device: str) -> dict[str, str]:
    """Host, name of the device (`cpu`, `cuda`, `cuda:1`), versions and git commit; every value a string."""
    versions = {f"{name}_version": importlib.metadata.version(name) for name in PACKAGES}
    return {
        "host": socket.gethostname(),
        "device_name": device_name(device),
        "python_version": platform.python_version(),
        **versions,
        "git_commit": git_commit(),
    }


@functools.cache
def device_name(device: str) -> str:
    """The product's name: of the GPU for a CUDA device, of the processor otherwise."""
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
def git_commit() -> str:
    """The checkout's commit, with `+changes` where tracked files differ from it; `none` outside a checkout of kerv."""
    if shutil.which("git") is None or not _git("ls-files", "--error-unmatch", "__init__.py"):
        return "none"  # an installed copy may lie inside somebody else's repository
    changes = _git("status", "--porcelain", "--untracked-files=no", "--", ".")
    return _git("rev-parse", "HEAD") + ("+changes" if changes else "")


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(_PACKAGE), *arguments], capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else ""
