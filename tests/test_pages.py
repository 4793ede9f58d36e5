"""The page of a study in a browser without a network: charts, hovering, picking a setting, more columns, sorting."""

import io

import pytest
from PIL import Image
from studies_synthetic import swept, threshold_study

from kerv_cli.report.report import Report, render
from kerv_cli.report.tables import load_study
from kerv_cli.report.viewing.viewer import Film


@pytest.fixture(scope="module")
def page(browser, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    store, _ = swept(folder, threshold_study(["reach-v3", "push-v3"], axis="", note="Made up."))
    path = folder / "page.html"
    path.write_text(render(Report(load_study(store))), encoding="utf-8")
    page = browser.new_context(viewport={"width": 1300, "height": 900}, offline=True).new_page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(path.as_uri())
    page.wait_for_selector("figure.chart svg .mark-symbol path")
    yield page
    assert not errors


def test_hovering_a_point_shows_its_numbers_and_intervals(page):
    page.locator("figure.chart svg .mark-symbol path").nth(3).hover()
    page.wait_for_selector("dl.tip:not([hidden])")
    cells = page.locator("tr[data-setting]").nth(3).locator("td:not(.more)").all_text_contents()
    assert [one.strip() for one in page.locator("dl.tip dd").all_text_contents()] == [one.strip() for one in cells]


def test_a_click_on_a_setting_shows_how_it_differs_and_fades_the_others(page):
    points = page.locator("figure.chart svg .mark-symbol path")
    page.locator(".pick").nth(2).click()
    assert "threshold.r" in page.locator("tr.detail").inner_text()
    page.wait_for_function("document.querySelector('figure.chart svg .mark-symbol path').getAttribute('opacity') < 1")
    assert points.nth(2).get_attribute("opacity") == "1"
    points.nth(3).click()
    assert page.locator("tr.picked").get_attribute("data-setting") == "spec_vla r=9"
    page.locator(".pick").nth(3).click()
    assert page.locator("tr.detail").count() == 0


def test_more_columns_and_another_order_on_a_click(page):
    heads = page.locator(".overview thead th:visible")
    assert heads.all_text_contents() == [
        "setting", "success", "speed, per episode", "change in success", "tokens unverified",
    ]  # fmt: skip
    page.get_by_label("more columns").first.check()
    assert heads.count() > 10
    page.get_by_role("button", name="speed, per episode", exact=True).click()
    texts = page.locator(".overview tbody tr td:nth-child(3)").all_text_contents()
    speeds = [float(text.split("×")[0]) for text in texts]
    assert speeds == sorted(speeds, reverse=True)


def test_a_report_has_a_film_of_one_success_and_one_failure_per_method(tmp_path, monkeypatch):
    """Recordings are made up: what matters is which are chosen."""
    study = threshold_study(["reach-v3"], episodes=12, radii=(20,))
    store, _ = swept(tmp_path, study)
    data = load_study(store)
    store.rollouts.mkdir(parents=True, exist_ok=True)
    for one in study.episodes:
        (store.rollouts / one.recording).touch()
    buffer = io.BytesIO()
    Image.new("RGB", (8, 8)).save(buffer, "jpeg")
    monkeypatch.setattr(
        "kerv_cli.report.report.film_of", lambda path: Film((buffer.getvalue(),), 80.0, {"steps": 4}, 0)
    )
    monkeypatch.setattr("kerv_cli.report.report.library", str)
    page = render(Report(data))
    expected = data.episodes.groupby("label")["success"].nunique().sum()
    assert page.count("data:image/webp;base64,") == expected > 3
    assert page.count('class="lost"') == expected - 3
