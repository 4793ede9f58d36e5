"""kerv as a library: `import kerv_cli as kerv`. It loads nothing until a name of `kerv_cli.api` is used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

__all__ = ["KervError", "Policy", "Study", "load_policy", "load_study", "rollout", "runs", "sweep"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("kerv_cli.api"), name)
