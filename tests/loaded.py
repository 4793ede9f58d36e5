"""Loads what tests need in a special way: programs of scripts/, artifacts for a target."""

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from kerv_cli.targets.checkpoint import TargetDescription


def module_of(path: Path) -> Any:
    """What the file defines, executed anew at every call."""
    spec = importlib.util.spec_from_file_location(f"loaded_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def of_target(description: TargetDescription, target: object) -> Any:
    """What an artifact is loaded for: stands for `Artifacts`."""
    return SimpleNamespace(description=description, target=target)
