"""kerv as a library: `import kerv_cli as kerv`.

The names come from `kerv_cli.api`. That module is imported when one of the names is first used. `import kerv_cli`
itself loads nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__all__ = ["KervError", "Policy", "Study", "load_policy", "load_study", "rollout", "runs", "sweep"]


def __getattr__(name: str) -> Any:
    """Return a name of the API."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("kerv_cli.api"), name)
