"""The board's pages of episodes and failures, their films and recordings, in a real browser."""

import html
import io
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urlsplit
from urllib.request import Request, urlopen

import pytest
import rerun_synthetic
import sqlalchemy as sa
from command import kerv
from conftest import served, until
from PIL import Image
from playwright.sync_api import expect
from starlette.testclient import TestClient
from studies_synthetic import episode, settings_of, study_of, swept, threshold_study

from kerv_cli.board.app import make_app
from kerv_cli.board.episode import command_of
from kerv_cli.board.episodes import phase_of
from kerv_cli.board.recorder import record_episode
from kerv_cli.catalogue.episodes import find_episode
from kerv_cli.engine.record import Delay
from kerv_cli.episodes.resolve import resolve_rollout
from kerv_cli.episodes.rows import decode_records, decodes_table
from kerv_cli.episodes.runner import Runner, close_worlds
from kerv_cli.lab.database import WANTED, Database, opened
from kerv_cli.lab.store import frame_of, remove_study, studies
from kerv_cli.report.viewing.token_outcomes import outcomes_of, tokens_hash

expect.set_options(timeout=120_000)
HERE = "http://127.0.0.1"
ROLLOUT = (
    "method=ar,spec_vla rectifier=compensate rectifier.drop=false task=reach policy=state "
    "policy.target=nano-state episodes=1 world.horizon=12 record=0"
)


@pytest.fixture(scope="module")
def rolled(policies, tmp_path_factory):
    """A results folder with the two short real episodes of a rollout, and its database."""
    results = tmp_path_factory.mktemp("rolled")
    (results / "artifacts").symlink_to(policies / "artifacts")
    kerv("rollout", "-m", *ROLLOUT.split(), f"results={results}")
    close_worlds()
    return opened(results)


@pytest.fixture
def client(tmp_path):
    with TestClient(make_app(opened(tmp_path)), base_url=HERE) as client:
        yield client


@pytest.fixture(scope="module")
def address(rolled):
    """The address of a board that shows the real episodes."""
    with served(rolled.results) as address:
        yield address


def rows_of_wanted(database: Database) -> list[int]:
    with database.reading() as connection:
        return list(connection.scalars(sa.select(WANTED.c.episode_id).order_by(WANTED.c.position)))


def test_a_failure_is_assigned_to_the_phase_in_which_it_happened():
    assert phase_of(0.3, 0.0) == "before contact"
    assert phase_of(0.019, 0.0) == "near contact"
    assert phase_of(0.03, 0.02) == phase_of(0.0, 0.01) == "after contact"  # a door's handle is 3 cm wide
    assert phase_of(0.02, None) == "before contact"
    assert phase_of(None, None) == "unknown"


def test_the_grid_says_which_episodes_the_baseline_or_the_setting_alone_solved(database, tmp_path, client):
    solved = {"ar": (True, True, False, False), "spec_vla r=9": (True, False, True, False)}

    def prepare(setting, task):
        return lambda seed: replace(
            episode(setting, task, seed), success=solved[setting.label][seed - 100_000], closest_approach=0.01
        )

    two = {"ar": settings_of("ar"), "spec_vla r=9": settings_of("spec_vla", 9)}
    swept(tmp_path, study_of(two, ["reach-v3"]), prepare)
    text = client.get("/studies/threshold/episodes").text
    cells = [part.split('"')[0] for part in text.partition("<tbody>")[2].split('title="')[1:]]
    # seeds that fail most often come first
    assert cells == [
        *("100003 failure", "100001 success", "100002 failure", "100000 success"),
        *("100003 failure", "100001 lost", "100002 won", "100000 success"),
    ]
    only = client.get("/studies/threshold/episodes", params={"setting": "spec_vla r=9", "task": "reach-v3"}).text
    assert only.count('title="1000') == 4
    failures = client.get("/studies/threshold/failures").text
    assert "2 of 4 episodes, the baseline solved 1 of them" in " ".join(failures.split())
    assert client.get("/studies/threshold/failures?setting=none").status_code == 404
    number = rows_of_wanted(database)[0]
    assert client.get(f"/episodes/{number}").status_code == 200


def test_what_does_not_exist_is_not_found(tmp_path, client):
    hostile = "/../../../../x"
    study = study_of({"ar": settings_of("ar"), hostile: settings_of("spec_vla", 9)}, ["reach-v3"])
    store, _ = swept(tmp_path, study)
    assert {Path(one.recording).name for one in study.episodes} == {one.recording for one in study.episodes}
    number = rows_of_wanted(store.database)[0]
    first = f"/episodes/{number}"
    absent = ("/studies/none/episodes", "/studies/..%2f/failures", "/episodes/0", f"/episodes/{10**30}", "/episodes/x")
    absent += (f"{first}/film.webp", f"{first}/frames/0", f"{first}/recording.rrd", "/rerun/x")
    for path in absent:
        assert client.get(path).status_code == 404, path
    assert client.post(f"{first}/record", headers={"origin": "http://attacker.example"}).status_code == 403
    recording = store.rollouts / find_episode(store.database, number).episode.recording
    recording.parent.mkdir(parents=True)
    recording.symlink_to(__file__)  # a link out of the results folder
    assert client.get(f"{first}/recording.rrd").status_code == 404


def test_decodes_that_are_read_back_are_those_that_were_written(rolled):
    found = find_episode(rolled, rows_of_wanted(rolled)[1])
    real = Runner(found.episode.setting.on("reach-v3"), "reach-v3").episode(100_000)
    close_worlds()
    assert any(decode.filled for decode in real.decodes)
    made_up = rerun_synthetic.episode("mixed")
    late = replace(made_up.decodes[0], delay=Delay(0.1, 8, 4, carried=2, held=6, dropped=1))
    for record in (real, replace(made_up, decodes=(late, *made_up.decodes[1:]))):
        read = decode_records(decodes_table(record))
        for before, after in zip(record.decodes, read, strict=True):
            assert outcomes_of(after, 16, 4) == outcomes_of(before, 16, 4)
            assert (after.actions == before.actions).all()
            for name in ("tokens", "rounds", "filled", "phases", "delay", "metric", "skipped", "mode"):
                assert getattr(after, name) == getattr(before, name), name
    assert tokens_hash(found.decodes()[0]) == tokens_hash(real.decodes)


def test_the_command_on_the_page_repeats_the_episode(rolled):
    numbers = rows_of_wanted(rolled)
    with TestClient(make_app(opened(rolled.results)), base_url=HERE) as client:
        text = client.get(f"/episodes/{numbers[1]}").text
    command = html.unescape(text.partition('<code id="command">')[2].partition("</code>")[0])
    kerv(*shlex.split(command)[1:], "record=0")
    close_worlds()
    newest = studies(rolled)[0]
    try:
        assert newest.kind == "rollout"
        again = frame_of(newest)["episode"].item()
        assert again not in numbers
        assert tokens_hash(find_episode(rolled, again).decodes()[0]) == tokens_hash(
            find_episode(rolled, numbers[1]).decodes()[0]
        )
    finally:
        remove_study(newest)


def test_settings_that_adapt_are_repeated_with_the_episodes_before(tmp_path):
    typed = ("method=spec_vla", "skip=similarity", "skip.up=0.01", "episodes=4")
    adapting = resolve_rollout([*typed, "task=reach-v3"], multirun=False).first
    store, _ = swept(tmp_path, study_of({"ar": settings_of("ar"), "spec_vla": adapting}, ["reach-v3"]))
    numbers = frame_of(store).set_index(["label", "seed"])["episode"].to_dict()
    last, plain = (find_episode(store.database, numbers[label, 100_003]) for label in ("spec_vla", "ar"))
    assert (last.earlier, plain.earlier) == ((100_000, 100_001, 100_002), ())
    episode = replace(last.episode, setting=replace(last.episode.setting, overrides=typed))
    words, _ = command_of(replace(last, episode=episode))
    assert words.startswith(" ".join(["kerv rollout", *typed[:3], "task=reach-v3 seed=100000 episodes=4"]))
    assert "record=-1" in words
    assert "presets in conf/ have changed" in command_of(last)[1]  # method=spec_vla alone gives other settings


def test_an_episode_whose_policy_has_changed_is_not_recorded(tmp_path):
    store, _ = swept(tmp_path, threshold_study(["reach-v3"]))
    found = find_episode(store.database, rows_of_wanted(store.database)[0])
    assert "of ar has changed" in record_episode(found)
    assert not store.recordings


def test_a_board_that_is_killed_leaves_no_process_that_records(rolled):
    words = [sys.executable, "-m", "kerv_cli", "board", "port=0", "open=false", f"results={rolled.results}"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as board:
        address = board.stdout.readline().split()[0]
        urlopen(Request(f"{address}episodes/{rows_of_wanted(rolled)[0]}/record", method="POST"))
        recording = subprocess.check_output(["ps", "-o", "pid=", "--ppid", str(board.pid)], text=True).split()
        assert len(recording) == 1
        board.kill()
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in recording), 10)


def test_a_person_gets_from_a_failure_to_its_film_a_decode_and_rerun(browser, address, rolled):
    (store,), page = studies(rolled), browser.new_page()
    page.set_default_timeout(120_000)
    page.goto(f"{address}/studies/{store.name}/episodes")
    page.get_by_role("link", name="Failures in groups").click()
    cluster = page.locator(".cluster", has_text="spec_vla")
    cluster.get_by_text("100000").click()
    cluster.get_by_role("button", name="Record it").click()
    expect(cluster.get_by_role("status")).to_contain_text("record")
    number = int(cluster.get_by_role("link", name="Open").get_attribute("href").rpartition("/")[2])
    # a second click, here from another program, does not record it a second time
    again = page.request.post(f"{address}/episodes/{number}/record").text()
    assert "Record it" not in again
    expect(cluster.get_by_text("same tokens as the stored episode")).to_be_visible()
    path = store.rollouts / find_episode(rolled, number).episode.recording
    written = path.stat().st_mtime_ns
    film = page.request.get(f"{address}/episodes/{number}/film.webp").body()
    assert Image.open(io.BytesIO(film)).n_frames == 5  # of 13 steps, at half the speed of 80 steps per second

    page.goto(f"{address}/studies/{store.name}/episodes")
    page.locator("tr", has_text="spec_vla").get_by_role("link").click()
    assert page.url == f"{address}/episodes/{number}"
    image, output = page.locator("film-player img"), page.locator("film-player output")
    page.locator(".tokens tbody tr").nth(2).click()
    expect(output).to_have_text("step 8")
    expect(page.locator("#decode")).to_contain_text("Decode 2 at step 8")
    assert page.url.endswith("?decode=2")
    page.locator(".tokens a").nth(2).press("ArrowUp")
    expect(page.locator("#decode")).to_contain_text("Decode 1 at step 4")
    page.get_by_role("button", name="play").click()
    expect(output).to_have_text("step 12")
    # the next frame may still be loading
    width = page.wait_for_function("image => image.complete && image.naturalWidth", arg=image.element_handle())
    assert width.json_value() == 240

    link = page.get_by_role("link", name="Open in Rerun")
    recording = parse_qs(urlsplit(link.get_attribute("href")).query)["url"]
    assert page.request.get(*recording).body() == path.read_bytes()
    asked = []
    page.context.on("request", lambda request: asked.append(request.url))
    with page.context.expect_page() as opened:
        link.click()
    # the viewer would now compile its program, for 5 to 40 s, and read the recording
    with opened.value as viewer, viewer.expect_response(lambda answer: answer.url.endswith(".wasm")) as answer:
        pass
    assert answer.value.ok
    assert all(url.startswith(address) for url in asked)
    assert path.stat().st_mtime_ns == written
