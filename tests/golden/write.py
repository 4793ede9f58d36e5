"""Writes tests/golden/main.json: `python tests/golden/write.py`. Only when a change is meant to change results."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from kerv_cli.rollouts.run import close_worlds, run_task
from kerv_cli.studies.resolve import resolve

FILE = Path(__file__).with_name("main.json")
TASKS = ("drawer-close-v3", "window-open-v3")
SEEDS = (100_000,)


def measure() -> dict[str, Any]:
    """setting -> task -> seed -> success, steps, forwards and the hash of all tokens, of study=main."""
    found: dict[str, Any] = {}
    settings = resolve(["study=main", f"task=[{','.join(TASKS)}]", "record=0"]).settings
    for task in TASKS:
        for label, setting in settings.items():
            for record in run_task(setting, task, SEEDS):
                tokens = json.dumps([decode.tokens for decode in record.decodes])
                found.setdefault(label, {}).setdefault(task, {})[str(record.seed)] = {
                    "success": record.success,
                    "steps": record.steps,
                    "forwards": record.forwards,
                    "tokens": hashlib.sha256(tokens.encode()).hexdigest()[:16],
                }
    close_worlds()
    return found


if __name__ == "__main__":
    FILE.write_text(json.dumps(measure(), indent=1) + "\n")
