"""Writes tests/golden/main.json, presets.json and engines.json: `python tests/golden/write.py`, when a change is meant
to change tokens and has raised `ENGINE`, or when it gives a preset other settings; in no other case."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

from kerv_cli.episodes.identity import ENGINE
from kerv_cli.episodes.resolve import resolve
from kerv_cli.episodes.runner import Runner, close_worlds

FILE = Path(__file__).with_name("main.json")
PRESETS = Path(__file__).with_name("presets.json")
CHANGED = ("spec_vla", "kerv", "heisd", "heisd_code")
"""The presets whose settings are not those of version 1.0.0."""
NEW = Path(__file__).with_name("last_action.yaml")
"""Presets that version 1.0.0 did not have."""
ENGINES = Path(__file__).with_name("engines.json")
"""ENGINE -> hash of the golden file that it was raised for."""
TASKS = ("drawer-close-v3",)
SEEDS = (100_000,)


def measure(study: str, labels: Collection[str] = ()) -> dict[str, Any]:
    """setting -> task -> seed -> success, steps, forwards and the hash of all tokens. Empty labels: the whole study."""
    found: dict[str, Any] = {}
    settings = resolve([f"study={study}", f"task=[{','.join(TASKS)}]", "record=0"]).settings
    settings = {label: setting for label, setting in settings.items() if not labels or label in labels}
    for task in TASKS:
        for label, setting in settings.items():
            for record in map(Runner(setting, task).episode, SEEDS):
                tokens = json.dumps([decode.tokens for decode in record.decodes])
                found.setdefault(label, {}).setdefault(task, {})[str(record.seed)] = {
                    "success": record.success,
                    "steps": record.steps,
                    "forwards": record.forwards,
                    "tokens": hashlib.sha256(tokens.encode()).hexdigest()[:16],
                }
    close_worlds()
    return found


def measure_engine() -> dict[str, Any]:
    """What main.json holds."""
    return measure(str(Path(__file__).with_name("engine.yaml")))


def measure_presets() -> dict[str, Any]:
    """What presets.json holds."""
    return measure("main", CHANGED) | measure(str(NEW))


def hash_of(golden: dict[str, Any]) -> str:
    """Of the contents of main.json."""
    return hashlib.sha256(json.dumps(golden, sort_keys=True).encode()).hexdigest()[:16]


def refusal(engines: dict[str, str], engine: int, digest: str) -> str:
    """Why these golden tokens and this ENGINE do not belong together; empty where they do. engines: as in ENGINES."""
    if engine < max(map(int, engines)):
        return f"ENGINE {engine} is an earlier one"
    if str(engine) in engines:
        return "" if engines[str(engine)] == digest else f"tokens changed: raise ENGINE from {engine}"
    return "ENGINE was raised and no token changed" if digest in engines.values() else ""


if __name__ == "__main__":
    measured, known = measure_engine(), json.loads(ENGINES.read_text())
    if told := refusal(known, ENGINE, hash_of(measured)):
        raise SystemExit(told)
    FILE.write_text(json.dumps(measured, indent=1) + "\n")
    PRESETS.write_text(json.dumps(measure_presets(), indent=1) + "\n")
    ENGINES.write_text(json.dumps(known | {str(ENGINE): hash_of(measured)}, indent=1) + "\n")
