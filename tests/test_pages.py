"""The figures on the committed pages are those of the committed tables."""

import subprocess
import sys
from pathlib import Path

import pytest
from loaded import module_of

ROOT = Path(__file__).resolve().parent.parent
PAGES = ("README.md", "results/README.md")


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
        "macro over difficulty groups,one pass,ar,8,10,3,2,4,0.5,2,1",
    )
    (tmp_path / "small.csv").write_text("\n".join(rows), encoding="utf-8")
    return module


@pytest.mark.parametrize("page", PAGES)
def test_every_figure_on_a_page_is_the_tables(page):
    command = [sys.executable, str(ROOT / "scripts/figures.py"), "--check", str(ROOT / page)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("folder", ["tables", "plots"])
def test_the_log_names_the_command_of_every_file(folder):
    rows = (ROOT / "results/LOG.md").read_text(encoding="utf-8").partition("## Files")[2]
    files = [file.name for file in (ROOT / "results" / folder).iterdir() if not file.name.startswith("demo")]  # ignored
    assert [name for name in files if f"`{name}`" not in rows] == []


def test_tables_and_figures_are_filled_and_stay_as_they_are_then(figures):
    page = (
        "<!-- table small: setting success lost/won speedup -->\nold\n<!-- /table -->\n"
        "It is <!-- figure small one_pass speedup -->9<!-- /figure -->× as fast, macro "
        "<!-- figure small macro one_pass speedup -->9<!-- /figure -->.\n"
    )
    filled = figures.filled(page)
    assert "| ar | 9/10 |  | 1 |\n" in filled
    assert "| one pass | 8/10 | 2 / 1, 0.5 | 2.04 (1.97–2.11) |\n" in filled
    assert "-->2.04 (1.97–2.11)<!-- /figure -->×" in filled
    assert "-->3.00 (2.00–4.00)<!--" in filled
    assert "old" not in filled
    assert figures.filled(filled) == filled


@pytest.mark.parametrize(
    ("page", "says"),
    [
        ("<!-- table none: setting -->\n<!-- /table -->", "no table none.csv"),
        ("<!-- table small: colour -->\n<!-- /table -->", "no column colour"),
        ("<!-- figure small two_pass speedup --><!-- /figure -->", "0 settings two_pass"),
    ],
)
def test_a_wrong_reference_is_named(figures, page, says):
    with pytest.raises(figures.BadReference, match=says):
        figures.filled(page)


def test_a_page_that_differs_fails_the_check_and_is_mended_without(figures, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("<!-- figure small one_pass success -->7/10<!-- /figure -->", encoding="utf-8")
    assert figures.main(["--check", str(page)]) == 1
    assert "make pages" in capsys.readouterr().err
    assert "7/10" in page.read_text(encoding="utf-8")
    assert figures.main([str(page)]) == 0
    assert "8/10" in page.read_text(encoding="utf-8")
    assert figures.main(["--check", str(page)]) == 0


def test_the_results_page_stays_a_page():
    assert len((ROOT / "results/README.md").read_text(encoding="utf-8").splitlines()) <= 250
