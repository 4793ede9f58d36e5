"""Every command in README.md, docs/ and on the results page runs: with --cfg where it has it, which composes and checks
all of its settings and computes nothing."""

import re
import shlex
from pathlib import Path

import pytest
from loaded import module_of
from typer.testing import CliRunner

from kerv_cli.base.config import conf_dir, groups
from kerv_cli.cli.app import app
from kerv_cli.episodes.resolve import resolve

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "results/README.md"]
_BLOCK = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r"^```yaml\n# (\S+\.yaml)\n(.*?)^```", re.MULTILINE | re.DOTALL)


_OPEN = {
    "task=NAME": "task=reach",
    "method=NAME": "method=ar",
    "study=NAME": "study=demo",
    "proposer=NAME": "proposer=hold",
    "drafter=NAME": "drafter=early",
    "drafter.KEY=VALUE": "drafter.width=64",
}


def commands() -> list[str]:
    """Those in blocks of shell text and those in running text, without comments, each once."""
    found: list[str] = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        lines = [line.split("   #")[0].strip() for block in _BLOCK.findall(text) for line in block.splitlines()]
        lines += re.findall(r"`((?:kerv|make) [^`\n…]+)`", text)
        parts = [part for line in lines for part in line.split(" && ")]
        found += [part for part in parts if part.startswith(("kerv ", "make "))]
    return list(dict.fromkeys(found))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The YAML files that the pages show, under their names."""
    place = tmp_path_factory.mktemp("pages")
    for page in PAGES:
        for name, text in _FILE.findall(page.read_text(encoding="utf-8")):
            (place / name).write_text(text)
    return place


def test_every_choice_that_a_page_a_preset_or_a_help_text_names_is_there():
    known = groups()
    del known["target"]  # in other commands a policy's name, or a family of policies
    texts = {page.name: page.read_text(encoding="utf-8") for page in [*PAGES, *conf_dir().rglob("*.yaml")]}
    made = set(re.findall(r"\bname=(\w+)", "\n".join(texts.values()))) | {"NAME", "S"}
    plugins = "\n".join(path.read_text() for path in (ROOT / "tests/examples").rglob("*.py"))
    texts["help"] = module_of(ROOT / "scripts/docs.py").reference()
    choice = re.compile(rf"(?<![\w.])({'|'.join(known)})=([\w,.-]*\w)")
    for place, text in texts.items():
        for group, names in choice.findall(text):
            for name in {*names.split(",")} - {*known[group]} - made:
                shown = name.endswith(".yaml") and f"# {name}\n" in text
                assert shown or f'add("{group}", "{name}"' in plugins, f"{place}: {group}={name}"


def test_the_pages_show_commands():
    assert len(commands()) > 40


@pytest.mark.parametrize("command", [line for line in commands() if line.startswith("kerv ")])
def test_a_documented_command_runs(command, folder, monkeypatch):
    monkeypatch.chdir(folder)
    words = shlex.split(command)[1:]
    monkeypatch.setenv("HOME", str(folder))
    words = [_OPEN.get(word, word) for word in words]  # what a page leaves to the reader
    runner = CliRunner()
    if words[0] in ("runs", "--version", "compare", "power"):
        result = runner.invoke(app, [*words[:2], "--help"] if words[0] == "runs" else words)
        options = [word for word in words if word.startswith("--")]
        assert all(option in result.output for option in options if words[0] == "runs"), command
    else:
        result = runner.invoke(app, [*words, "--cfg"])
    assert result.exit_code == 0, f"{command}: {result.output}"


def test_documented_rules_of_make_are_there():
    rules = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    for command in commands():
        words = command.split()
        if words[0] == "make":
            assert words[1] in rules, command


@pytest.mark.parametrize("study", groups()["study"])
def test_every_study_resolves(study):
    """Beside the documented commands: what one composes, the other has."""
    resolved = resolve([f"study={study}"])
    assert resolved.study.name == study
    assert resolved.study.baseline in resolved.settings
    assert len({r.seed for r in resolved.settings.values()}) == 1
