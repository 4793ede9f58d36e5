"""Every kind of part is in the table of docs/extending.md, and each of its examples runs by the command given there."""

import re
import shlex
import sys
from pathlib import Path

import pytest
from command import kerv

from kerv_cli.base import registry
from kerv_cli.base.registry import Part
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.chunk import Chunk

pytestmark = pytest.mark.usefixtures("quick_report")

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "tests/examples"
TABLE = re.compile(r"^\| (.+?) \| (\d) \| (.+?) \| `(.+)` \|$", re.MULTILINE)
SHORT = ["episodes=1", "world.horizon=6", "record=0"]
ROWS = TABLE.findall((ROOT / "docs/extending.md").read_text(encoding="utf-8"))
TRIED = [(command, *re.findall(r"`(\w+)`", kind)) for kind, _, _, command in ROWS if command.startswith("KERV_PLUGINS")]


def own_parts() -> dict[str, dict[str, Part]]:
    """kerv's parts, by kind and name."""
    return {
        kind: {name: part for name, part in registry.parts(kind).items() if not part.module.startswith("examples")}
        for kind in registry.kinds()
    }


@pytest.mark.parametrize("name", ["own_threshold.py", "own_repeat.py"])
def test_the_worked_example_is_the_file(name):
    page = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
    assert f"```python\n{(EXAMPLES / name).read_text(encoding='utf-8')}```" in page


def test_every_field_of_an_observation_and_a_chunk_that_the_page_names_exists():
    page = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
    for part, named in ((Observation, "an `Observation`"), (Chunk, "a `Chunk`")):
        rows = page.split(f"of {named}")[1].split("\n\n")[1].splitlines()[2:]
        fields = {name for row in rows for name in re.findall(r"`([a-z]+)", row.split("|")[1])}
        known = {*vars(part), *part.__dataclass_fields__}
        assert fields <= known
    assert set(Observation.__dataclass_fields__) == {"proprioception", "state", "instruction", "images", "readings"}


def test_every_kind_is_named_with_its_files():
    named = {kind for first, *_ in ROWS for kind in re.findall(r"`(\w+)`", first)}
    assert named >= {*registry.kinds(), "column"}
    for _, files, example, _ in ROWS:
        assert int(files) <= 2
        for path in re.findall(r"`(\S+)`", example):
            assert (EXAMPLES / path).exists() or (ROOT / path).exists(), path


@pytest.mark.parametrize(("command", "kind"), TRIED, ids=[row[1] for row in TRIED])
def test_an_example_runs_by_its_documented_command(command, kind, tmp_path, monkeypatch):
    (plugins,) = re.findall(r"KERV_PLUGINS=(\S+)", command)
    monkeypatch.setattr(registry, "_PARTS", own_parts())  # of the examples, this one alone
    monkeypatch.delitem(sys.modules, plugins, raising=False)
    monkeypatch.setenv(registry.PLUGINS, plugins)
    before = set(registry.parts(kind))
    registry.load_plugins.__wrapped__()
    (name,) = set(registry.parts(kind)) - before
    assert name in command or kind in ("column", "environment")
    for line in command.split(" && "):
        words = shlex.split(line.replace(f"KERV_PLUGINS={plugins} ", ""))[1:]
        short = SHORT if words[0] == "rollout" else []
        run = kerv(*words, *short, f"results={tmp_path}")
    if kind == "column":
        assert "longest" in run.output
