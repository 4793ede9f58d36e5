"""Executors under one protocol: the same cells, failures and errors on processes, jobs, tasks and threads."""

from __future__ import annotations

import importlib.util
import os
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from studies_synthetic import misbehave, prepare, slow_elsewhere, threshold_study

from kerv_cli.base.config import compose
from kerv_cli.base.errors import UnknownName, UsageError
from kerv_cli.base.settings import RolloutSettings, RuntimeSettings
from kerv_cli.engine.record import EpisodeRecord
from kerv_cli.lab.claims import is_claimed
from kerv_cli.lab.events import CellEnd, Event
from kerv_cli.lab.execute import RunEpisode, execute
from kerv_cli.lab.executors import check_executor
from kerv_cli.lab.plan import Cell
from kerv_cli.lab.store import StudyStore

PACKAGES = {"slurm": "submitit", "ray": "ray"}


def runtime(executor: str, **options: Any) -> RuntimeSettings:
    return RuntimeSettings(workers=2, executor=executor, executor_options=options)


@pytest.fixture(params=["slurm", "ray"])
def cluster(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[RuntimeSettings]:
    """Both kinds of cluster, on this machine."""
    pytest.importorskip(PACKAGES[request.param])
    # workers of both import this folder's modules
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))
    monkeypatch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # theirs: sockets and files left to the collector
        yield runtime(request.param, **({"cluster": "local"} if request.param == "slurm" else {}))


def test_a_cluster_loses_only_the_guilty_cells_and_resumes(cluster: RuntimeSettings, tmp_path: Path) -> None:
    """One cell kills its process, one raises what cannot be pickled; the others of the block are run all the same."""
    store = StudyStore(tmp_path, "threshold")
    cells = threshold_study(["reach-v3", "push-v3"], radii=(1, 5))
    guilty = [cell for cell in cells if cell.task == "push-v3"]
    events: list[Event] = []
    outcome = execute(cells[:2] + guilty, misbehave, store, cluster, events.append)
    reasons = {failure.cell.label: failure.reason for failure in outcome.failed}
    assert set(reasons) == {"spec_vla r=1", "spec_vla r=5"}
    assert "its worker process was lost" in reasons["spec_vla r=1"] or "its job" in reasons["spec_vla r=1"]
    assert reasons["spec_vla r=5"].startswith("Odd: 1 and 2")
    assert [(cell.task, cell.label) for cell in sorted(outcome.done, key=lambda c: (c.task, c.label))] == [
        (task, label) for task in ("push-v3", "reach-v3") for label in ("ar", "naive_sd")
    ]
    assert sum(isinstance(event, CellEnd) and not event.reason for event in events) == 4
    stored = [store.read_cell(cell.id) for cell in outcome.done]
    assert os.getpid() not in {cell.status["pid"] for cell in stored}
    assert {cell.status["executor"] for cell in stored} == {cluster.executor}
    assert {seconds for cell in stored for seconds in cell.episodes["wall_seconds"]} == {1.0}  # OMP_NUM_THREADS
    assert list(store.claims.iterdir()) == []
    again = execute(cells, prepare, store, RuntimeSettings())
    assert (len(again.reused), len(again.done)) == (4, 4)


def test_options_come_from_the_command_line() -> None:
    for executor, option, value in (("slurm", "partition", "short"), ("ray", "gpus", 0.5)):
        words = [f"runtime={executor}", f"runtime.executor_options.{option}={value}"]
        composed = compose("rollout", words, RolloutSettings).runtime
        assert (composed.executor, composed.executor_options) == (executor, {option: value})


def test_an_interrupt_ends_a_clusters_work(cluster: RuntimeSettings, tmp_path: Path) -> None:
    store = StudyStore(tmp_path, "threshold")
    cells = threshold_study(["reach-v3", "push-v3"])

    def interrupt(event: Event) -> None:
        if isinstance(event, CellEnd):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        execute(cells, slow_elsewhere, store, cluster, interrupt)
    assert [store.has_cell(cell.id) for cell in cells] == [True] * 4 + [False] * 4
    assert not any(is_claimed(store.claims, cell) for cell in cells)


def test_an_executor_from_outside(tmp_path: Path) -> None:
    """One file, `examples/thread_executor.py`, named in KERV_PLUGINS."""
    importlib.import_module("examples.thread_executor")
    threads = set()

    def noting(cell: Cell) -> RunEpisode:
        def run(seed: int) -> EpisodeRecord:
            threads.add(threading.current_thread().name)
            return prepare(cell)(seed)

        return run

    cells = threshold_study(["reach-v3", "push-v3", "door-open-v3"])
    outcome = execute(cells, noting, StudyStore(tmp_path, "threshold"), runtime("threads", name="mine"))
    assert len(outcome.done) == len(cells)
    assert threads <= {"mine_0", "mine_1"}
    with pytest.raises(UsageError, match=r"runtime\.executor_options: nam: unexpected"):
        check_executor(runtime("threads", nam="x"))


@pytest.mark.parametrize("name", ["slurm", "ray"])
def test_a_package_that_is_not_installed_is_named_with_its_command(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda package: None)
    with pytest.raises(UsageError, match=rf"needs the package {PACKAGES[name]}: pip install 'kerv\[{name}\]'"):
        check_executor(runtime(name))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (RuntimeSettings(executor="slrum"), "unknown executor 'slrum': did you mean slurm"),
        (RuntimeSettings(workers=0), r"runtime\.workers=0: from 1 to"),
        (runtime("slurm", minutes="long"), r"runtime\.executor_options: minutes: input should be a valid integer"),
        (runtime("local", partition="x"), r"runtime\.executor_options: partition: unexpected"),
    ],
)
def test_a_wrong_executor_is_refused_in_one_line(settings: RuntimeSettings, message: str) -> None:
    if settings.executor == "slurm":
        pytest.importorskip("submitit")
    with pytest.raises(UsageError, match=message) as caught:
        check_executor(settings)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, UnknownName) == (settings.executor == "slrum")


@pytest.mark.parametrize(("name", "options"), [("slurm", {}), ("ray", {"address": "127.0.0.1:1"})])
def test_an_unreachable_cluster_is_one_line(
    name: str, options: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(PACKAGES[name])
    monkeypatch.setenv("PATH", "")  # no srun, wherever the test runs
    with pytest.raises(UsageError, match=r"cannot be (used|reached)") as caught:
        execute(threshold_study(["reach-v3"]), prepare, StudyStore(tmp_path, "threshold"), runtime(name, **options))
    assert "\n" not in str(caught.value)
