"""What must be the same after a kill, or after a file was damaged: hashes of a command's results."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

_FOLDERS = {
    "demos": "artifacts/demos",
    "train target": "artifacts/target",
    "train drafter": "artifacts/drafter",
    "build": "artifacts/datastore",
    "calibrate": "artifacts/calibration",
    "report": "report",
}
_NO_CLOCK = ["task", "seed", "success", "steps", "forwards", "tokens", "accepted"]


def state(results: Path, command: str) -> dict[str, str]:
    """What a command must make again after a kill: file -> hash. Of a sweep: the plan, and the columns that no clock
    decides."""
    if command == "sweep":
        return dict(_of_sweep(results))
    files = sorted(path for path in (results / _FOLDERS[command]).rglob("*") if path.is_file())
    return {str(path.relative_to(results)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _of_sweep(results: Path) -> Iterator[tuple[str, str]]:
    import pandas as pd

    plan = results / "studies/tortured/plan.yaml"
    yield "plan.yaml", hashlib.sha256(plan.read_bytes()).hexdigest()
    for path in sorted(results.glob("studies/tortured/cells/*/episodes.parquet")):
        yield path.parent.name, pd.read_parquet(path, columns=_NO_CLOCK).to_csv()
