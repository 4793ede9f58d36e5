"""The pages as a site: links, the reference of commands, and figures that are those of the committed tables."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from loaded import module_of
from typer.testing import CliRunner

from kerv_cli.cli.app import app

ROOT = Path(__file__).resolve().parents[1]
SOURCES = (
    "README.md",
    "results/README.md",
    "results/details.md",
    "results/LOG.md",
    *(f"docs/{p.name}" for p in (ROOT / "docs").glob("*.md")),
)


@pytest.fixture(scope="module")
def docs():
    return module_of(ROOT / "scripts/docs.py")


def text_of(source: str) -> str:
    """A page without its blocks of code."""
    return re.sub(r"^```.*?^```", "", (ROOT / source).read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def anchors(source: str) -> set[str]:
    """Names of a page's headings in links, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", text_of(source), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("source", SOURCES)
def test_every_link_leads_to_a_file_and_a_heading(source):
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(source)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = ((ROOT / source).parent / path).resolve() if path else ROOT / source
        assert file.is_file(), f"{source}: {target}"
        if anchor and file.suffix == ".md":
            assert anchor in anchors(str(file.relative_to(ROOT))), f"{source}: {target}"


def test_the_pages_name_every_room_and_no_other():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    picture = "".join(re.findall(r"^```text\n(.*?)^```", text, re.MULTILINE | re.DOTALL))
    rooms = sorted(path.parent.name for path in (ROOT / "kerv_cli").glob("*/__init__.py"))
    assert sorted(re.findall(r"\w+", picture)) == sorted([*rooms, "api"])
    assert sorted(re.findall(r"^\| `(\w+)/` \|", text, re.MULTILINE)) == rooms


LONGEST = 180
"""Characters in a line of a page. Tables and commands may be longer."""


@pytest.mark.parametrize("source", [*SOURCES, "CONTRIBUTING.md"])
def test_no_line_of_a_page_is_too_long(source):
    lines = (ROOT / source).read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if len(line) > LONGEST and not line.startswith(("|", "<!--", "kerv "))] == []


def test_the_pages_stay_short():
    words = {path.name: len(path.read_text(encoding="utf-8").split()) for path in (ROOT / "docs").glob("*.md")}
    assert sum(words.values()) <= 16_000
    assert words["methods.md"] <= 6_000
    assert words["measuring.md"] <= 1_350
    assert words["formats.md"] <= 1_200


def test_docstrings_are_where_users_and_plugins_read_them():
    """At most 0.30 lines per line of code, and at most 45 % of functions have one."""
    code, lines, functions = 0, 0, []
    for path in (ROOT / "kerv_cli").rglob("*.py"):
        text, described = path.read_text(encoding="utf-8"), set()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                functions.append(ast.get_docstring(node, clean=False) is not None)
            can_have_one = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
            if can_have_one and ast.get_docstring(node, clean=False) is not None:
                described.update(range(node.body[0].lineno, node.body[0].end_lineno + 1))
        written = {number for number, line in enumerate(text.splitlines(), 1) if line.strip()}
        comments = {number for number, line in enumerate(text.splitlines(), 1) if line.lstrip().startswith("#")}
        lines += len(written & described)
        code += len(written - described - comments)
    assert lines <= 0.30 * code
    assert sum(functions) <= 0.45 * len(functions)


def test_the_site_lists_every_page(docs):
    settings = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    listed = re.findall(r"[\w-]+\.md", str(settings["nav"]))
    assert sorted(listed) == sorted([*(p.name for p in (ROOT / "docs").glob("*.md")), *docs.PAGES, "reference.md"])
    assert settings["strict"]


def test_links_of_the_repository_become_links_of_the_site(docs):
    text = "[a](docs/methods.md#7-measures) ![b](docs/film.webp) [c](results/README.md) [d](https://rerun.io)"
    expected = "[a](methods.md#7-measures) ![b](film.webp) [c](results.md) [d](https://rerun.io)"
    assert docs.relinked(text, "README.md") == expected
    assert docs.relinked("[a](LOG.md), [b](tables/main.csv)", "results/README.md") == "[a](log.md), b"
    assert docs.relinked("[a](../results/README.md) [b](#here)", "docs/shipped.md") == "[a](results.md) [b](#here)"


def test_the_reference_has_the_help_of_every_command(docs):
    page = docs.reference()
    for words in (("rollout",), ("train", "target"), ("runs", "export")):
        assert f"## `kerv {' '.join(words)}`" in page
        shown = CliRunner().invoke(app, [*words, "--help"], prog_name="kerv", env={"COLUMNS": str(docs.WIDTH)})
        assert shown.output.rstrip() in page
    assert len(page.split("\n## ")) > 20


def test_the_first_page_fits_on_two_screens():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 100


# --- pages

PAGES = ("README.md", "results/README.md", "results/details.md")


@pytest.fixture
def figures(tmp_path, monkeypatch):
    """The script over a table of two settings."""
    module = module_of(ROOT / "scripts/figures.py")
    module.table_of.cache_clear()
    monkeypatch.setattr(module, "TABLES", tmp_path)
    head = "averaging,label,baseline,successes,episodes,speedup,speedup_low,speedup_high,mcnemar_p"
    rows = (
        f"{head},only_baseline,only_method",
        "micro over tasks,ar,ar,9,10,1,,,,0,0",
        "micro over tasks,one pass,ar,8,10,2.044,1.97,2.106,0.5,2,1",
        "macro over difficulty groups,one pass,ar,8,10,3,2,4,0.5,2,1",  # an older table
    )
    (tmp_path / "small.csv").write_text("\n".join(rows), encoding="utf-8")
    return module


@pytest.mark.parametrize("page", PAGES)
def test_every_figure_on_a_page_is_the_tables(page):
    command = [sys.executable, str(ROOT / "scripts/figures.py"), "--check", str(ROOT / page)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_log_names_the_command_of_every_table():
    rows = (ROOT / "results/LOG.md").read_text(encoding="utf-8").partition("## Files")[2]
    files = [file.name for file in (ROOT / "results/tables").iterdir() if not file.name.startswith("demo")]  # ignored
    assert [name for name in files if f"`{name}`" not in rows] == []


def test_tables_and_figures_are_filled_and_stay_as_they_are_then(figures):
    page = (
        "<!-- table small: setting success lost/won speedup -->\nold\n<!-- /table -->\n"
        "It is <!-- figure small one_pass speedup -->9<!-- /figure -->× as fast.\n"
    )
    filled = figures.filled(page)
    assert "| ar | 9/10 |  | 1 |\n" in filled
    assert "| one pass | 8/10 | 2 / 1, 0.5 | 2.04 (1.97–2.11) |\n" in filled
    assert "-->2.04 (1.97–2.11)<!-- /figure -->×" in filled
    assert "old" not in filled
    assert figures.filled(filled) == filled


def test_a_page_that_differs_fails_the_check_and_is_mended_without(figures, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("<!-- figure small one_pass success -->7/10<!-- /figure -->", encoding="utf-8")
    assert figures.main(["--check", str(page)]) == 1
    assert "make pages" in capsys.readouterr().err
    assert "7/10" in page.read_text(encoding="utf-8")
    assert figures.main([str(page)]) == 0
    assert "8/10" in page.read_text(encoding="utf-8")
    assert figures.main(["--check", str(page)]) == 0


def test_the_first_page_and_the_results_stay_short():
    """Words with their tables; at most eight rows of at most seven columns on the first page, of six in the results."""
    for page, words, tables, columns in (("README.md", 650, 1, 7), ("results/README.md", 1_700, 8, 6)):
        text = (ROOT / page).read_text(encoding="utf-8")
        shown = [part.splitlines() for part in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)]
        said = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL).split()
        assert sum(any(map(str.isalnum, word)) for word in said) <= words, page
        assert len(shown) <= tables, page
        assert max(len(rows) - 2 for rows in shown) <= 8, page
        assert max(rows[0].count("|") - 1 for rows in shown) <= columns, page


SPEED, STEP, LOSS = "episode_speedup", "speedup", "difference"
VERIFIED = "spec_vla kerv last_action last_action_tree"
AMX = "last_action last_action_tree spec_vla spec_vla_chain kerv heisd one_pass early_unverified"
# A page, a part of one of its bold sentences, and what must hold: table (@*: its prices on two machines), settings,
# measure, and the limits between which the intervals lie, or "holds 1": neither faster nor slower is shown,
# "holds 0": neither gain nor loss.
CLAIMS = [
    ("README.md", "Spec-VLA and KERV are 1.6 to 1.8 times", "papers@*", "spec_vla kerv", SPEED, (1.55, 1.85)),
    ("README.md", "papers', 1.4 and 1.5)", "papers_few@*", "spec_vla_few kerv_few", SPEED, (1.3, 1.65)),
    ("README.md", "HeiSD 2.4 to 3.0 times", "papers@*", "heisd", SPEED, (2.35, 3.1)),
    ("README.md", "makes 1.7 to 1.9", "papers@*", "last_action last_action_tree", SPEED, (1.65, 1.95)),
    ("README.md", "KERV adds at most 2 %", "papers_against_spec_vla@*", "kerv", SPEED, (1, 1.02)),
    ("README.md", "trees of fifty tokens pay", "papers_amx", "spec_vla kerv last_action_tree", SPEED, (1, 9)),
    ("README.md", "without AMX they do not", "papers", "spec_vla kerv last_action_tree", SPEED, (0, 1)),
    (
        "results/README.md",
        "last action 1.6 to 2.1",
        "papers@*",
        VERIFIED,
        SPEED,
        (1.55, 2.1),
    ),
    (
        "results/README.md",
        "last action 1.6 to 2.1",
        "papers_libero_small@*",
        VERIFIED,
        SPEED,
        (1.55, 2.1),
    ),
    ("results/README.md", "HeiSD 2.4 to 4.8", "papers@*", "heisd", SPEED, (2.35, 4.8)),
    ("results/README.md", "HeiSD 2.4 to 4.8", "papers_libero_small@*", "heisd", SPEED, (2.35, 4.8)),
    ("results/README.md", "`one_pass` 2.6 to 6.2", "papers@*", "one_pass", SPEED, (2.55, 6.25)),
    ("results/README.md", "`one_pass` 2.6 to 6.2", "papers_libero_small@*", "one_pass", SPEED, (2.55, 6.25)),
    (
        "results/README.md",
        "KERV adds at most 2 %",
        "papers_libero_small_against_spec_vla@*",
        "kerv",
        STEP,
        (0.99, 1.02),
    ),
    (
        "results/README.md",
        "weak drafts up to 10",
        "papers_libero_small_against_spec_vla_few@*",
        "kerv_few kerv_literal_few",
        STEP,
        (1.03, 1.11),
    ),
    ("results/README.md", "with AMX all methods are faster", "papers_amx", AMX, SPEED, (1, 99)),
    ("results/README.md", "trees are slower", "papers", "spec_vla kerv last_action_tree", SPEED, (0, 1)),
    ("results/README.md", "chains and HeiSD faster", "papers", "spec_vla_chain heisd heisd_code", SPEED, (1, 9)),
    ("results/README.md", "HeiSD lose less than 3 points", "papers_small", "spec_vla kerv heisd", LOSS, (-0.03, 1)),
    ("results/README.md", "on LIBERO no loss of theirs", "papers_libero_small", "spec_vla kerv heisd", LOSS, "holds 0"),
    ("results/README.md", "loses over 30 points", "papers_libero_small", "kerv_without_rest", LOSS, (-1, -0.3)),
    ("results/README.md", "it loses over 45 points there", "coverage_unseen", "early_unverified", LOSS, (-1, -0.45)),
    ("results/README.md", "verified no loss is shown", "coverage_unseen", "one_pass one_pass_streak", LOSS, "holds 0"),
    ("results/README.md", "only unverified drafts are shown", "mt50_methods", "early_unverified", SPEED, (1, 9)),
    ("results/README.md", "only unverified drafts are shown", "mt50_methods", "one_pass_streak", SPEED, "holds 1"),
    ("results/README.md", "gain more than Meta-World's", "papers_libero_trees", "spec_vla_chain", SPEED, (1.6, 9)),
    ("results/README.md", "gain more than Meta-World's", "papers", "spec_vla_chain", SPEED, (1, 1.6)),
    ("results/README.md", "are slower than AR", "main", "spec_vla kerv", SPEED, (0, 1)),
    ("results/README.md", "are not shown to be faster", "main", "heisd one_pass", SPEED, "holds 1"),
]


@pytest.mark.parametrize(("page", "said", "table", "settings", "measure", "limits"), CLAIMS)
def test_a_bold_sentence_lies_within_its_intervals(page, said, table, settings, measure, limits):
    bold = " ".join(re.findall(r"\*\*(.*?)\*\*", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL))
    assert said in " ".join(bold.split())
    name, machine, _ = table.partition("@")
    wanted = settings.split()
    rows = module_of(ROOT / "scripts/figures.py").table_of(f"{name}_on" if machine else name)
    found = [row for row in rows if row["label"].replace(" ", "_") in wanted]
    found = [row for row in found if row.get("on") in (None, "h100-openvla-7b", "a100-openvla-7b-eager")]
    assert len(found) == len(wanted) * (2 if machine else 1)
    for row in found:
        low, high = (float(row[f"{measure}_{end}"]) for end in ("low", "high"))
        if isinstance(limits, str):
            assert low <= float(limits.removeprefix("holds ")) <= high
        else:
            assert limits[0] <= low <= high <= limits[1]
