"""Strange requests and damaged files for torture.py, drawn at random."""

from __future__ import annotations

import functools
import hashlib
import json
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from kerv_cli.base import settings
from kerv_cli.base.config import groups, keys_of

TASK = "handle-press"  # its episodes are short
PLANNED = {  # command of conf/ -> its words; all are plans, so that nothing long begins
    "rollout": "rollout --plan",
    "grid": "rollout -m --plan",
    "sweep": "sweep --plan study=tortured",
    "demos": "demos --plan",
    "train_target": f"train target --plan demos=few task={TASK}",
    "train_drafter": "train drafter --plan demos=few",
    "build_datastore": f"build datastore --plan demos=few task={TASK}",
    "calibrate": f"calibrate --plan demos=few task={TASK}",
}
NAMED = ("runs list", "runs show", "runs compare", "runs rerun --plan", "runs export --to")
STRANGE_KEYS = ("nothing", "threshold.", ".r", "", "a.b.c", "study.common", "study.settings", "study.repeats")
_WORDS = """
=cmd|x +x\tx kind=sweep last tortured tortured:ar certified mlflow csv
0 -1 1 2 33 4294967296 99999999999999999999 1e400 nan inf -inf 0.5 true null reach MT10 ar spec_vla heisd kerv expert
[] {} [[]] {a:1} [reach] [[reach]] [null] [1,[2]] glob(*) [glob(*)] 1,2 ar,spec_vla range(0,3) range(0,10,0)
range(0,5,-1) range(0,100000000) range(nan,3) range(0,1,1e-300)
interval(0,1) choice(1,2) shuffle(1,2,3) sort(range(0,100000000))
.. . ../../x / /dev/null a/b ~ ' " \\ \\ ${x} ${oc.env:HOME} ${ $ %s ü 🤖 method=ar = == a=b # *a &a --- _target_
int(3) float(x) str([1]) json_str({}) extend_list(1) {_target_:os.system} !!python/object:os.system
"""
_LONG = ("a" * 300, "a" * 70000, "a" * 200_000, "[" * 200, "{" * 3000, "{a:" * 50 + "1" + "}" * 50)
VALUES = ("", "a b", "a\tb", "\n", *_LONG, *_WORDS.split())
PREFIXES = ("", "", "", "", "", "", "", "+", "++", "~", "@")


@functools.cache
def keys_for(command: str) -> tuple[str, ...]:
    """Groups, settings and strange keys of a command of PLANNED."""
    of = "rollout" if command == "grid" else command
    schema = getattr(settings, "".join(map(str.title, of.split("_"))) + "Settings")
    return (*groups(), *keys_of(of, [], schema), *STRANGE_KEYS)


def wrong_request(draw: random.Random) -> list[str]:
    """A command line with one to three strange overrides, or strange names."""
    if draw.random() < 0.1:
        return [*draw.choice(NAMED).split(), *draw.choices(VALUES, k=draw.choice((1, 2, 3)))]
    command = draw.choice([*PLANNED])
    prefixes = [draw.choice(PREFIXES) for _ in range(draw.choice((1, 1, 1, 2, 3)))]
    words = [f"{prefix}{draw.choice(keys_for(command))}={draw.choice(VALUES)}" for prefix in prefixes]
    return [*PLANNED[command].split(), *words]


FILES = {  # what is damaged below the results -> the commands that read it
    "artifacts/target/mine/target.json": ("rollout", "list"),
    "artifacts/target/mine/model.safetensors": ("rollout",),
    "artifacts/target/mine/log.csv": ("list", "export"),
    "artifacts/target/mine/resume.safetensors": ("resume",),
    "artifacts/drafter/*/*": ("rollout", "list"),
    "artifacts/early/*/early.json": ("list",),
    "artifacts/datastore/*/*": ("rollout", "list"),
    "artifacts/calibration/*/calibration.json": ("rollout", "list"),
    "artifacts/certificate/*/*": ("list", "success"),
    "artifacts/demos/few/manifest.json": ("build", "list"),
    "artifacts/demos/few/recording.json": ("record",),
    "artifacts/demos/few/episodes/*/*0.safetensors": ("build", "record"),
    "lerobot/few/**/*.*": ("import",),
    "studies/*/plan.yaml": ("report", "rerun", "list", "show"),
    "studies/*/run.json": ("rerun", "list", "sweep"),
    "studies/*/cells/*/*": ("report", "rerun", "compare"),
    "studies/*/cells/*/status.json": ("sweep", "list", "repair"),
    "rollouts/*/rollouts/*.rrd": ("view",),
}


def damage(draw: random.Random, results: Path) -> tuple[str, str]:
    """Damages a file, half of the time with renewed hashes -> what was done, and the command that reads the file."""
    pattern = draw.choice([*FILES])
    path = draw.choice(sorted(path for path in results.glob(pattern) if path.is_file()))
    what, reader = path.relative_to(results), draw.choice(FILES[pattern])
    if draw.random() < 0.15:
        kind = draw.choice([*PLACES])
        path.unlink()
        PLACES[kind](path)
        return f"{what} {kind}, {reader}", reader
    kind = draw.choice(TEXT if path.suffix in (".json", ".yaml", ".csv") else BINARY)
    content = KINDS[kind](draw, path.read_bytes())
    renewed = draw.random() < 0.5 and _renew(path, hashlib.sha256(content).hexdigest())
    path.write_bytes(content)
    return f"{what} {kind}{', hashes renewed' if renewed else ''}, {reader}", reader


PLACES: dict[str, Callable[[Path], Any]] = {
    "a folder": Path.mkdir,
    "a link to itself": lambda path: path.symlink_to(path.name),
    "missing": lambda path: None,
}
"""What stands in a file's place."""


def _renew(path: Path, digest: str) -> bool:
    """Writes a file's new hash into the description beside it -> whether there is one."""
    names = ("manifest.json", "target.json", "drafter.json", "status.json")
    described = next((path.parent / n for n in names if n != path.name and (path.parent / n).is_file()), None)
    if described is not None:
        value = json.loads(described.read_text())
        if "files" in value:
            value["files"][path.name] = digest
            value.pop("sha256", None)
        else:
            value["sha256"] = digest
        described.write_text(json.dumps(value))
    return described is not None


def _flipped(draw: random.Random, whole: bytes) -> bytes:
    at = draw.randrange(max(1, len(whole)))
    return whole[:at] + bytes([whole[at] ^ 1 << draw.randrange(8)]) + whole[at + 1 :] if whole else b"x"


def _swapped(draw: random.Random, whole: bytes) -> bytes:
    """A value of a JSON or YAML file taken away or replaced by one of another type."""
    try:
        value = json.loads(whole)
    except ValueError:
        lines = whole.split(b"\n")
        at = draw.randrange(len(lines))
        lines[at] = lines[at].split(b":")[0] + b": " + draw.choice((b"[]", b"{}", b"nan", b"-1", b"x", b"", b"1e999"))
        return b"\n".join(lines)
    holder, key = draw.choice([*_places(value)])
    if draw.random() < 0.3 and isinstance(holder, dict):
        del holder[key]
    else:
        holder[key] = draw.choice((None, [], {}, -1, 0, 1e308, "x", True, [[]], "a" * 5000, 2**70))
    return json.dumps(value).encode()


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(items):
        yield value, key
        yield from _places(inner)


def _not_finite(draw: random.Random, whole: bytes) -> bytes:
    """Eight bytes of the second half, where numbers are, as two NaN."""
    at = draw.randrange(len(whole) // 2, max(len(whole) // 2 + 1, len(whole) - 8))
    return whole[:at] + b"\xff\xff\xff\x7f" * 2 + whole[at + 8 :]


KINDS: dict[str, Callable[[random.Random, bytes], bytes]] = {
    "flipped": _flipped,
    "swapped": _swapped,
    "not finite": _not_finite,
    "cut": lambda draw, whole: whole[: draw.randrange(len(whole))],
    "empty": lambda draw, whole: b"",
    "a list": lambda draw, whole: b"[1, 2]",
    "a zip": lambda draw, whole: b"PK\x03\x04" + bytes(60),
    "appended": lambda draw, whole: whole + draw.randbytes(100),
    "noise": lambda draw, whole: draw.randbytes(len(whole)),
}
TEXT = ("flipped", "cut", "empty", "a list", *("swapped",) * 8)
BINARY = ("flipped", "flipped", "cut", "empty", "a zip", "appended", "noise", "not finite")
