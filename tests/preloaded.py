"""What the scripts of tests import, and what takes long when it is called first.

`conftest.python` runs them in processes that are forked from one that has imported this module.
"""

import os
import sys
from collections.abc import Mapping, Sequence

import pandas  # noqa: F401
import studies_synthetic  # noqa: F401

from kerv_cli.targets.provenance import stamp

stamp("cpu")


def run(script: str, arguments: Sequence[str], environment: Mapping[str, str], path: list[str]) -> None:
    """Run a script in this process, as if it were `python -c`."""
    os.environ.clear()
    os.environ.update(environment)
    sys.argv, sys.path = ["-c", *arguments], path
    exec(compile(script, "<script>", "exec"), {"__name__": "__main__"})
