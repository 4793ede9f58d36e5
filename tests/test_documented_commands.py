"""Every command in README.md, docs/, on the results page and in a message of kerv runs: with --cfg where it has it,
which composes and checks all of its settings and computes nothing."""

import ast
import re
import shlex
from pathlib import Path

import pytest
from command import refusal
from loaded import module_of
from typer.testing import CliRunner

from kerv_cli.base.config import conf_dir, groups
from kerv_cli.cli.app import app
from kerv_cli.episodes.resolve import resolve

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    ROOT / "results/README.md",
    ROOT / "results/details.md",
]
_BLOCK = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r"^```yaml\n# (\S+\.yaml)\n(.*?)^```", re.MULTILINE | re.DOTALL)


_OPEN = {
    "task=NAME": "task=reach",
    "method=NAME": "method=ar",
    "study=NAME": "study=demo",
    "target=TARGET": "target=vla-150m",
    "proposer=NAME": "proposer=hold",
    "drafter=NAME": "drafter=early",
    "drafter.KEY=VALUE": "drafter.width=64",
}


_VALUES = {
    "command.replace('_', ' ')": "rollout",
    "override": "method=ar,kerv",
    "kind": "drafter",
    "self.kind": "drafter",
    "' '.join(self.command)": "build datastore",
    "line": "train drafter drafter=early",
    "'task' if stands_for_tasks(path.name) else 'name'": "name",
    "','.join([*windows, str(window)])": "5,30",
    "' '.join(command)": "demos task=reach",
}
"""Expression within a message -> what it can be. Any other is a name."""


def _text(node: ast.AST) -> str:
    """Return a string of the code, with the value of each expression in it. Empty if the node is no string."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if not isinstance(node, ast.JoinedStr):
        return ""
    return "".join(
        part.value if isinstance(part, ast.Constant) else _VALUES.get(ast.unparse(part.value), "NAME")
        for part in node.values
    )


def commands_in_messages() -> list[str]:
    """Those in quotes in strings of the code and between <code> in templates, each once. Docstrings do not count."""
    found: list[str] = []
    for path in sorted((ROOT / "kerv_cli").rglob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        within = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
        within |= {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        for text in (_text(node) for node in nodes if id(node) not in within):
            found += [command for _, command in re.findall(r"(['`])(kerv [a-z].*?)\1", text)]
    for path in sorted((ROOT / "kerv_cli").rglob("*.html")):
        found += re.findall(
            r"<code>(kerv [^<]+)</code>", re.sub(r"{{.*?}}", "NAME", path.read_text().replace("{{ results }}", ""))
        )
    return list(dict.fromkeys(found))


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
                assert shown or re.search(rf'@\w+Part\("{name}"', plugins), f"{place}: {group}={name}"


def test_the_pages_show_commands():
    assert len(commands()) > 40


def check_runs(command: str) -> None:
    """Run a command as far as its settings, in the current folder."""
    words = [_OPEN.get(word, word) for word in shlex.split(command)[1:]]  # what a page leaves to the reader
    runner = CliRunner()
    if words[0] in ("runs", "--version"):
        result = runner.invoke(app, [*words[:2], "--help"] if words[0] == "runs" else words)
        options = [word for word in words if word.startswith("--")]
        assert all(option in result.output for option in options if words[0] == "runs"), command
    else:
        result = runner.invoke(app, words if "--cfg" in words else [*words, "--cfg"])
    assert result.exit_code == 0, f"{command}: {result.output}"


@pytest.mark.parametrize("command", [line for line in commands() if line.startswith("kerv ")])
def test_a_documented_command_runs(command, folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("HOME", str(folder))
    check_runs(command)


@pytest.mark.parametrize("command", commands_in_messages())
def test_a_command_in_a_message_runs(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check_runs(command)


REMEDIES = {
    "rollout method=ar,one_pass": "kerv rollout -m method=ar,one_pass",
    "rollout policy.target=mine": "kerv train target name=mine",
    "rollout policy.target=mt10-150m": "kerv train target name=mt10-150m",
    "sweep study=papers_libero": "kerv sweep study=papers_libero --cfg",
    "rollout method=spec_vla policy.artifacts.drafter=few": (
        "kerv train drafter policy.target=mt10-h1 policy.artifacts.drafter=few"
    ),
    "rollout nonsense=3": "kerv rollout --cfg",
    "report study=nosuch": "kerv runs list",
    "report study=papers": "kerv sweep study=papers",
    "report": "kerv sweep study=demo",
    "runs show last": "kerv rollout method=spec_vla task=reach",
    "view": "kerv rollout method=ar task=reach-v3",
    "train target name=mine demos=none": "kerv demos name=none",
    "calibrate demos=none": "kerv demos name=none task=MT10",
}
"""A line as typed -> the command that its refusal names."""


@pytest.mark.parametrize(("line", "remedy"), REMEDIES.items())
def test_a_remedy_is_for_the_folder_that_was_typed(line, remedy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = refusal(*line.split(), "results=größe mit leerzeichen")
    *_, named = re.findall(r"(['`])(kerv .*?)\1(?!\w)", said)
    assert shlex.split(named[1]) == [*remedy.split(), "results=größe mit leerzeichen"], said
    check_runs(named[1])


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
