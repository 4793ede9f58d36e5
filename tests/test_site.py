"""The pages as a site: links lead somewhere, every page is listed, the reference has every command. mkdocs itself is
not needed: `make docs` runs it."""

import re
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


def test_the_site_lists_every_page(docs):
    settings = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    listed = re.findall(r"[\w-]+\.md", str(settings["nav"]))
    assert sorted(listed) == sorted([*(p.name for p in (ROOT / "docs").glob("*.md")), *docs.PAGES, "reference.md"])
    assert settings["strict"]


def test_links_of_the_repository_become_links_of_the_site(docs):
    text = "[a](docs/methods.md#7-measures) ![b](docs/decode.png) [c](results/README.md) [d](https://rerun.io)"
    expected = "[a](methods.md#7-measures) ![b](decode.png) [c](results.md) [d](https://rerun.io)"
    assert docs.relinked(text, "README.md") == expected
    assert docs.relinked("[a](LOG.md) ![b](plots/main.png)", "results/README.md") == "[a](log.md) ![b](plots/main.png)"
    assert docs.relinked("[a](../results/README.md) [b](#here)", "docs/shipped.md") == "[a](results.md) [b](#here)"


def test_the_reference_has_the_help_of_every_command(docs):
    page = docs.reference()
    for words in (("rollout",), ("train", "target"), ("runs", "compare")):
        assert f"## `kerv {' '.join(words)}`" in page
        shown = CliRunner().invoke(app, [*words, "--help"], prog_name="kerv", env={"COLUMNS": str(docs.WIDTH)})
        assert shown.output.rstrip() in page
    assert len(page.split("\n## ")) > 20


def test_the_first_page_fits_on_two_screens():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 100
