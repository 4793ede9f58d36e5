"""Strange requests and damaged files for torture.py, drawn at random."""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

TASK = "handle-press"  # its episodes are short
PLANNED = {
    "rollout": ["rollout", "--plan"],
    "grid": ["rollout", "-m", "--plan"],
    "sweep": ["sweep", "--plan", "study=demo"],
    "demos": ["demos", "--plan"],
    "train_target": ["train", "target", "--plan", "demos=few", f"task={TASK}"],
    "train_drafter": ["train", "drafter", "--plan", "demos=few"],
    "build_datastore": ["build", "datastore", "--plan", "demos=few", f"task={TASK}"],
    "calibrate": ["calibrate", "--plan", "demos=few", f"task={TASK}"],
}
KEYS = {
    "rollout": (
        *("task", "episodes", "seed", "policy", "policy.target", "policy.drafter", "policy.kind", "policy.others"),
        *("method", "proposer", "proposer.kind", "proposer.depth", "acceptance", "threshold", "threshold.r", "skip"),
        *("rectifier", "boundary", "boundary.f_star", "skip.up", "skip.s_min", "chunk", "datastore", "prefill_draft"),
        *("world.horizon", "world.camera.size", "world.camera.name", "world.camera.fovy", "deviation_every", "record"),
        *("record_size", "runtime", "runtime.device", "runtime.dtype", "runtime.threads", "runtime.executor_options"),
        *("results", "nothing", "threshold.", ".r", "", "a.b.c"),
    ),
    "sweep": (
        *("study", "study.name", "study.title", "study.baseline", "study.common", "study.settings", "study.axis"),
        *("study.block", "study.repeats", "runtime.workers", "runtime.executor", "episodes", "task", "seed"),
    ),
    "train_target": (
        *("name", "demos", "target", "target.width", "target.layers", "target.heads", "target.chunk", "target.grid"),
        *("target.image_size", "target.observation", "train.steps", "train.batch", "train.lr", "train.ema"),
        *("train.held_out", "train.init", "train.validate_every", "train.seed", "train.label_sigma", "task"),
    ),
    "train_drafter": ("drafter", "drafter.kind", "drafter.layers", "drafter.samples", "policy.target", "train.steps"),
    "demos": ("name", "episodes", "seed", "perturbed", "frame_stride", "task", "world.horizon"),
    "build_datastore": ("name", "key", "stride", "components", "episodes", "half", "task", "policy.target"),
    "calibrate": ("name", "window", "epsilon", "confidence", "boundary_windows", "decodes", "history", "fit_steps"),
}
KEYS["grid"] = KEYS["rollout"]
VALUES = (
    *(
        "",
        "0",
        "-1",
        "1",
        "2",
        "33",
        "4294967296",
        "99999999999999999999",
        "1e400",
        "nan",
        "inf",
        "-inf",
        "0.5",
        "true",
    ),
    *("null", "reach", "MT10", "ar", "spec_vla", "heisd", "kerv", "expert", "[]", "{}", "[[]]", "{a:1}", "[reach]"),
    *("[[reach]]", "[null]", "[1,[2]]", "glob(*)", "[glob(*)]", "1,2", "ar,spec_vla", "range(0,3)", "range(0,10,0)"),
    *("range(0,100000000)", "range(nan,3)", "range(0,1,1e-300)", "interval(0,1)", "choice(1,2)", "shuffle(1,2,3)"),
    *("sort(range(0,100000000))", "..", ".", "../../x", "/", "/dev/null", "a/b", "~", "a b", "'", '"', "\\", "\\\\"),
    *("${x}", "${oc.env:HOME}", "${", "$", "%s", "\n", "ü", "🤖", "a" * 300, "a" * 70000, "[" * 200, "{" * 3000),
    *("{a:" * 50 + "1" + "}" * 50, "method=ar", "=", "==", "a=b", "int(3)", "float(x)", "str([1])", "json_str({})"),
    *("extend_list(1)", "_target_", "{_target_:os.system}", "!!python/object:os.system", "*a", "&a", "---", "#"),
)
PREFIXES = ("", "", "", "", "", "", "", "+", "++", "~", "@")


def wrong_request(draw: random.Random) -> list[str]:
    """A command line with one to three strange overrides. All are plans, so that nothing long begins."""
    command = draw.choice([*PLANNED])
    words = [
        f"{draw.choice(PREFIXES)}{draw.choice(KEYS[command])}={draw.choice(VALUES)}"
        for _ in range(draw.choice((1, 1, 1, 2, 3)))
    ]
    return [*PLANNED[command], *words]


@dataclass(frozen=True)
class Damage:
    """Other contents of a file below the results, and the command that reads it. files: by path below the results; a
    description whose hashes are renewed is one of them."""

    name: str
    reader: str
    files: dict[Path, bytes]

    def apply(self, results: Path) -> None:
        """Changes the files."""
        for path, content in self.files.items():
            (results / path).write_bytes(content)


def damage(draw: random.Random, results: Path) -> Damage:
    """A damaged description, weights, datastore, training state, calibration, plan or cell."""
    reader, pattern = draw.choice(_PATTERNS)
    path = draw.choice(sorted(results.glob(pattern)))
    kind = draw.choice(_TEXT if path.suffix in (".json", ".yaml") else _BINARY)
    content = _MADE[kind](draw, path.read_bytes())
    also = _renewed(path, content) if draw.random() < 0.5 else {}
    place = path.relative_to(results)
    files = {file.relative_to(results): made for file, made in {path: content, **also}.items()}
    return Damage(f"{place} {kind}{', hashes renewed' if also else ''}", reader, files)


_PATTERNS = (
    ("rollout", "artifacts/target/*/target.json"),
    ("rollout", "artifacts/target/*/model.safetensors"),
    ("rollout", "artifacts/drafter/*/drafter.json"),
    ("rollout", "artifacts/drafter/*/model.safetensors"),
    ("rollout", "artifacts/datastore/*/*"),
    ("rollout", "artifacts/calibration/*/calibration.json"),
    ("resume", "artifacts/target/*/resume.safetensors"),
    ("build", "artifacts/demos/*/manifest.json"),
    ("build", "artifacts/demos/*/episodes/*/*0.safetensors"),
    ("report", "studies/*/plan.yaml"),
    ("report", "studies/*/cells/*/*"),
    ("sweep", "studies/*/cells/*/status.json"),
)


def _renewed(path: Path, content: bytes) -> dict[Path, bytes]:
    """The description beside a file with the hash that fits its new content, where there is one."""
    for name in ("manifest.json", "target.json", "drafter.json", "status.json"):
        described = path.parent / name
        if path.name == name or not described.is_file():
            continue
        value = json.loads(described.read_text())
        digest = hashlib.sha256(content).hexdigest()
        if "files" in value:
            value["files"][path.name] = digest
            value.pop("sha256", None)
        else:
            value["sha256"] = digest
        return {described: json.dumps(value).encode()}
    return {}


def _flipped(draw: random.Random, whole: bytes) -> bytes:
    at = draw.randrange(max(1, len(whole)))
    return whole[:at] + bytes([whole[at] ^ 1 << draw.randrange(8)]) + whole[at + 1 :] if whole else b"x"


def _swapped(draw: random.Random, whole: bytes) -> bytes:
    """A value of a JSON or YAML file replaced by one of another type."""
    try:
        value = json.loads(whole)
    except ValueError:
        lines = whole.split(b"\n")
        at = draw.randrange(len(lines))
        lines[at] = lines[at].split(b":")[0] + b": " + draw.choice((b"[]", b"{}", b"nan", b"-1", b"x", b"", b"1e999"))
        return b"\n".join(lines)
    places = list(_places(value))
    holder, key = draw.choice(places)
    odd = (None, [], {}, -1, 0, 1e308, "x", True, [[]], "a" * 5000, 2**70)
    if draw.random() < 0.3 and isinstance(holder, dict):
        del holder[key]
    else:
        holder[key] = draw.choice(odd)
    return json.dumps(value).encode()


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(items):
        yield value, key
        yield from _places(inner)


def _not_finite(draw: random.Random, whole: bytes) -> bytes:
    """The last eight bytes of a run of numbers as NaN."""
    at = draw.randrange(len(whole) // 2, max(len(whole) // 2 + 1, len(whole) - 8))
    return whole[:at] + b"\xff\xff\xff\x7f\xff\xff\xff\x7f" + whole[at + 8 :]


_BOMB = b"a: &a [x,x,x,x,x,x,x,x,x]\n" + b"".join(
    b"%c: &%c [*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c]\n" % (n, n, *(n - 1,) * 9) for n in range(ord("b"), ord("m"))
)
_MADE = {
    "flipped": _flipped,
    "cut": lambda draw, whole: whole[: draw.randrange(len(whole))],
    "empty": lambda draw, whole: b"",
    "a list": lambda draw, whole: b"[1, 2]",
    "a zip": lambda draw, whole: b"PK\x03\x04" + bytes(60),
    "deep": lambda draw, whole: b"[" * 100_000 + b"]" * 100_000,
    "bomb": lambda draw, whole: _BOMB,
    "swapped": _swapped,
    "appended": lambda draw, whole: whole + draw.randbytes(100),
    "noise": lambda draw, whole: draw.randbytes(len(whole)),
    "not finite": _not_finite,
}
_TEXT = ("flipped", "cut", "empty", "a list", "deep", "bomb", *("swapped",) * 8)
_BINARY = ("flipped", "flipped", "cut", "empty", "a zip", "appended", "noise", "not finite")
