"""Small real policies for the tests: untrained weights on disk, made by the code that makes trained ones."""

import contextlib
import gc
import multiprocessing
import os
import secrets
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from multiprocessing import forkserver
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

import examples.insertion  # noqa: F401 - registers the environment with seven degrees of freedom
import hypothesis
import pytest
import server

from kerv_cli.base import registry
from kerv_cli.base.errors import KervError
from kerv_cli.lab.command import STORE
from kerv_cli.lab.database import opened

os.environ.setdefault("OMP_NUM_THREADS", "1")
signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background, commands inherit to ignore it
hypothesis.settings.register_profile("shared machine", deadline=None)
hypothesis.settings.load_profile("shared machine")

ENVIRONMENTS = dict(registry.parts("environment"))
"""kerv's own and the example `insertion`, taken before test modules are imported."""


LONGEST = (
    *("test_execute", "test_cli", "test_packaging", "test_golden", "test_studies_tables", "test_proposers"),
    *("test_prepare", "test_program", "test_lerobot", "test_runs", "test_training", "test_board", "test_stress"),
    *("test_database", "test_plan", "test_documented_commands", "test_reprice", "test_calibration"),
    *("test_extending", "test_views", "test_vla_eval", "test_api", "test_sim_demos", "test_sim_world"),
)
"""Files that take longest, begun first: no process is left with one of them at the end while the others idle."""


def pytest_configure(config: pytest.Config) -> None:
    """Files are begun in the order of collection: pytest-xdist would begin with those of the most tests."""
    config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, the others as they were."""
    items.sort(key=lambda item: LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST))


def pytest_collection_finish() -> None:
    """Leaves libraries and collected tests out of garbage collection: they stay, and a look at all of them takes 0.3 s
    each time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def idle_machine(monkeypatch):
    """Pretend that no other program runs, so that no line says so."""
    monkeypatch.setattr("os.getloadavg", lambda: (0.0, 0.0, 0.0))


@pytest.fixture(scope="module", autouse=True)
def registered_environments():
    """A module begins with these environments, and what it registers is gone when it ends.

    Opening a dataset of a recording, or importing an example, registers an environment for the process, and which
    modules share a process is decided anew in every parallel run.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._PARTS, "environment", dict(ENVIRONMENTS))
        yield


def write_policy(results: Path, name: str, observation: str, seed: int = 0) -> None:
    """A nano target and its drafter below `results`, as `kerv train` leaves them."""
    import torch

    from kerv_cli.base.config import compose
    from kerv_cli.methods.artifacts import MadeFor
    from kerv_cli.methods.eagle import DrafterSettings
    from kerv_cli.methods.eagle.drafter import EagleDrafter
    from kerv_cli.targets.compact.target import CompactTarget, save_target
    from kerv_cli.training.settings import TrainTargetSettings
    from kerv_cli.training.target import vocabulary
    from kerv_cli.worlds.metaworld.spec import SPEC

    torch.manual_seed(seed)
    settings = compose("train_target", ["target=nano", f"target.observation={observation}"], TrainTargetSettings)
    camera = settings.world.camera.name
    target = CompactTarget(settings.target, SPEC.actions, SPEC.observation, vocabulary(SPEC.name), camera)
    provenance = {"parameters": sum(p.numel() for p in target.parameters())}
    digest = save_target(results / "artifacts" / "target" / name, target, "metaworld", provenance)
    drafter = EagleDrafter().network(DrafterSettings(), target)
    folder, made_for = results / "artifacts" / "drafter" / name, MadeFor(digest, target.actions)
    EagleDrafter().save(folder, drafter, made_for, provenance, settings=asdict(drafter.settings))


@pytest.fixture(scope="session")
def policies(tmp_path_factory):
    """A results folder with the policies `nano-state` and `nano-vision`. Read only: copy it to change it."""
    results = tmp_path_factory.mktemp("policies")
    write_policy(results, "nano-state", "state")
    write_policy(results, "nano-vision", "vision", seed=1)
    return results


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """A results folder with `few`: real demonstrations of one task. Read only: copy it to change it."""
    from kerv_cli.worlds.demos.recording import DemoConfig, record

    folder = tmp_path_factory.mktemp("recorded")
    record(DemoConfig(("drawer-close-v3",), 6, frame_stride=8, workers=1), folder / "artifacts/demos/few")
    return folder


@pytest.fixture(scope="module")
def demonstrated(policies, recorded, tmp_path_factory):
    """The policies and the demonstrations in one folder, which a module may change."""
    folder = tmp_path_factory.mktemp("demonstrated")
    for one in (policies, recorded):
        shutil.copytree(one, folder, dirs_exist_ok=True)
    return folder


@pytest.fixture
def results(policies, tmp_path):
    """A results folder with a copy of the policies, which a test may change."""
    return Path(shutil.copytree(policies, tmp_path / "results"))


@pytest.fixture
def quick_training(monkeypatch):
    """A drafter in training is validated on 4 observations, not on 60 of which each is decoded twice. The picture of a
    training's curves is empty."""
    from kerv_cli.methods.eagle import drafter
    from kerv_cli.report import plots

    monkeypatch.setattr(drafter, "VALIDATED", 4)
    monkeypatch.setattr(plots, "png", lambda *_: b"")


@pytest.fixture(scope="module")
def quick_report():
    """The charts of reports are empty in this module: to draw them takes most of the time of a short sweep."""
    import altair

    from kerv_cli.report import plots

    with pytest.MonkeyPatch.context() as patch:
        for name in ("lines_figure", "_tradeoff"):
            patch.setattr(plots, name, lambda *_: altair.concat())
        yield


@contextlib.contextmanager
def refused(*says: str, error: type[KervError] = KervError) -> Iterator[None]:
    """Expect that the block is refused in one line that holds these words."""
    with pytest.raises(error) as caught:
        yield
    assert [words for words in says if words not in str(caught.value)] == []
    assert "\n" not in str(caught.value)


def until(condition: Callable[[], Any], seconds: float = 60.0) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


@contextlib.contextmanager
def served(results: Path) -> Iterator[str]:
    """The address of a board of a results folder, which runs in a thread."""
    from kerv_cli.board.app import web_server

    server = web_server(opened(results), port=0)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        until(lambda: server.started)
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()


@pytest.fixture(scope="module")
def browser():
    """A real browser. No longer than a module: its event loop keeps others from running theirs."""
    chromium = Path("/usr/bin/chromium")
    if not chromium.exists():
        pytest.skip("no browser here: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield opened
        opened.close()


@contextlib.contextmanager
def python(script: str, *arguments: object) -> Iterator[ForkServerProcess]:
    """Run a script, which can import this folder's modules, in a new process until the end of the block.

    The process is forked from one that has imported the libraries: to import them takes longer than most scripts.
    """
    from preloaded import run

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["preloaded"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))
        forkserver.ensure_running()
        process = context.Process(target=run, args=(script, [*map(str, arguments)], dict(os.environ), sys.path))
        process.start()
    try:
        yield process
    finally:
        process.kill()
        process.join()


def raising(error: BaseException, label: str = "", seeds: Sequence[int] = ()) -> Any:
    """Episodes of which those of a label and these seeds raise; of all labels or seeds if none is given."""
    from studies_synthetic import episode

    def prepare(setting, task):
        def run(seed):
            if setting.label == (label or setting.label) and seed in (seeds or (seed,)):
                raise error
            return episode(setting, task, seed)

        return run

    return prepare


@pytest.fixture(scope="session")
def postgresql():
    """URL of a PostgreSQL server for this session, without the name of a database."""
    try:
        with server.running() as url:
            yield url
    except FileNotFoundError as error:
        pytest.skip(str(error))


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request, tmp_path, monkeypatch):
    """The empty database of the results folder `tmp_path`: in its file, or on a server."""
    monkeypatch.delenv(STORE, raising=False)
    if request.param == "sqlite":
        yield opened(tmp_path)
        return
    psycopg = pytest.importorskip("psycopg")
    server, name = request.getfixturevalue("postgresql"), f"kerv_{secrets.token_hex(4)}"
    monkeypatch.setenv(STORE, f"{server}/{name}")
    with psycopg.connect(f"{server}/postgres", autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
        made = opened(tmp_path)
        yield made
        made.close()
        connection.execute(f"DROP DATABASE {name} WITH (FORCE)")
