"""Record episodes again for the board: one process per recording, one at a time.

The process is `python -m kerv_cli.board.recorder NUMBER RESULTS`. It ends when the board ends, however the board
ends, because its standard input is a pipe from the board.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from kerv_cli.base.processes import end_with_input
from kerv_cli.catalogue.episodes import FoundEpisode, find_episode
from kerv_cli.lab.command import STORE
from kerv_cli.lab.database import opened


@dataclass(frozen=True)
class Job:
    """A recording that the user asked for."""

    future: Future[str]  # its result is the error as text, or an empty text if the recording was written
    asked: float  # seconds since 1970

    @property
    def seconds(self) -> int:
        return int(time.time() - self.asked)

    @property
    def error(self) -> str:
        return self.future.result() if self.future.done() else ""


class Recorder:
    """Records episodes. A request for an episode that is already being recorded is ignored."""

    def __init__(self) -> None:
        self.jobs: dict[Path, Job] = {}
        self._pool = ThreadPoolExecutor(1)
        self._process: subprocess.Popen[str] | None = None

    def record(self, found: FoundEpisode) -> None:
        job = self.jobs.get(found.recording)
        if job is None or job.future.done():
            self.jobs[found.recording] = Job(self._pool.submit(self._run, found), time.time())

    def _run(self, found: FoundEpisode) -> str:
        database = found.store.database
        command = [sys.executable, "-m", "kerv_cli.board.recorder", str(found.id), str(database.results)]
        pipe, environment = subprocess.PIPE, {**os.environ, STORE: database.store}  # the address may have a password
        with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment) as self._process:
            assert self._process.stdout is not None
            said = self._process.stdout.read().strip()
        ended = self._process.returncode
        return "" if not ended else said or f"the recording process ended with status {ended}"

    def close(self) -> None:
        """End the recording process at once, even during a recording."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        if self._process is not None:
            self._process.kill()


RECORDER = Recorder()


def record_episode(found: FoundEpisode) -> str:
    """Run an episode again and write its recording. Return an error as one line, or an empty text on success.

    If the setting's skip rule adapts from episode to episode, the episodes before this one run first.
    """
    from kerv_cli.episodes.runner import Runner
    from kerv_cli.lab.work import checked, failure_of
    from kerv_cli.report.viewing import save_recording

    one, results = found.episode, str(found.store.database.results)
    try:
        runner = Runner(checked(one.setting, [one.task], results).on(one.task), one.task)
        for seed in found.earlier:
            runner.episode(seed)
        save_recording(runner.episode(one.seed, recorded=True), found.recording, one.setting.label)
    except Exception as error:  # noqa: BLE001 - the page shows it, whatever it is
        return failure_of(error).reason
    return ""


if __name__ == "__main__":
    end_with_input()
    if failure := record_episode(find_episode(opened(sys.argv[2]), int(sys.argv[1]))):
        print(failure)
        sys.exit(1)
