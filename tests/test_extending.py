"""Every kind of part is in the table of docs/extending.md, and each of its examples runs by the command given there."""

import re
import shlex
import sys
from pathlib import Path

import pytest
from command import kerv

from kerv_cli.base import registry
from kerv_cli.base.spaces import Observation
from kerv_cli.engine.chunk import Chunk

pytestmark = pytest.mark.usefixtures("quick_report")

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "tests/examples"
PAGE = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| (.+?) \| (\d) \| (.+?) \| `(.+)` \|$", PAGE, re.MULTILINE)
TRIED = [(command, *re.findall(r"`(\w+)`", kind)) for kind, _, _, command in ROWS if command.startswith("KERV_PLUGINS")]


@pytest.mark.parametrize("name", ["own_threshold.py", "own_repeat.py"])
def test_the_worked_example_is_the_file(name):
    assert f"```python\n{(EXAMPLES / name).read_text(encoding='utf-8')}```" in PAGE


def test_every_field_of_an_observation_and_a_chunk_that_the_page_names_exists():
    for part, named in ((Observation, "an `Observation`"), (Chunk, "a `Chunk`")):
        rows = PAGE.split(f"of {named}")[1].split("\n\n")[1].splitlines()[2:]
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
    own = {
        one: {name: part for name, part in registry.parts(one).items() if not part.module.startswith("examples")}
        for one in registry.kinds()
    }
    monkeypatch.setattr(registry, "_PARTS", own)  # of the examples, this one alone
    monkeypatch.delitem(sys.modules, plugins, raising=False)
    monkeypatch.setenv(registry.PLUGINS, plugins)
    before = set(registry.parts(kind))
    registry.load_plugins.__wrapped__()
    (name,) = set(registry.parts(kind)) - before
    assert name in command or kind in ("column", "environment")
    for line in command.split(" && "):
        words = shlex.split(line.replace(f"KERV_PLUGINS={plugins} ", ""))[1:]
        short = ["episodes=1", "world.horizon=6", "record=0"] if words[0] == "rollout" else []
        run = kerv(*words, *short, f"results={tmp_path}")
    if kind == "column":
        assert "longest" in run.output
