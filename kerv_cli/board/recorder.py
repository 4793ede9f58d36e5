"""Record episodes in the background, one after the other, in a process of its own."""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

from kerv_cli.base.processes import Workers
from kerv_cli.catalogue.episodes import FoundEpisode
from kerv_cli.episodes.identity import Setting

IDLE_SECONDS = 60
"""Seconds without work after which the recording process ends, to free its memory."""


@dataclass(frozen=True)
class Job:
    """A recording that was asked for.

    Attributes:
        future: Its result is the error as text, or empty once the recording is written.
        asked: Time at which the user asked for it, seconds since 1970.
    """

    future: Future[str]
    asked: float

    @property
    def seconds(self) -> int:
        """Seconds since the user asked for the recording."""
        return int(time.time() - self.asked)

    @property
    def error(self) -> str:
        """Why the recording failed. Empty if it succeeded or still runs."""
        if not self.future.done():
            return ""
        lost = self.future.exception()
        return f"the recording process ended: {lost}" if lost else self.future.result()


class Recorder:
    """Records episodes. A recording that was asked for twice is made once."""

    def __init__(self) -> None:
        self._jobs: dict[Path, Job] = {}
        self._pool: Workers | None = None
        self._latest: Future[str] | None = None
        self._lock = threading.RLock()

    def job(self, path: Path) -> Job | None:
        """Return the newest job that writes this file. None if nobody asked for one."""
        return self._jobs.get(path)

    def record(self, found: FoundEpisode) -> None:
        """Start to record an episode, unless it is being recorded already.

        Call this method in a thread that lives as long as the board. The recording process ends with that thread.
        """
        path = found.recording
        with self._lock:
            job = self._jobs.get(path)
            if job is not None and not job.future.done():
                return
            if self._pool is None or self._pool.is_broken:
                self._pool = Workers(1)
            one, results = found.episode, str(found.store.database.results)
            seeds = [*found.earlier, one.seed]
            work = self._pool.submit(record_episode, one.setting, one.task, seeds, results, path)
            self._jobs[path], self._latest = Job(work, time.time()), work
        work.add_done_callback(self._rest)

    def _rest(self, work: Future[str]) -> None:
        """End the process after IDLE_SECONDS, unless another recording was asked for after this one."""

        def end() -> None:
            with self._lock:
                if work is self._latest:
                    self.close()

        timer = threading.Timer(IDLE_SECONDS, end)
        timer.daemon = True
        timer.start()

    def close(self) -> None:
        """End the process, whatever it is recording."""
        if self._pool is not None:
            self._pool.kill()
            self._pool = None


def record_episode(setting: Setting, task: str, seeds: list[int], results: str, path: Path) -> str:
    """Run an episode again and write its recording.

    Args:
        setting: Setting of the episode.
        task: Task of the episode.
        seeds: Seeds of the episodes that must run first, then the episode's own.
        results: The results folder, with the weights and data that the setting needs.
        path: File to write.

    Returns:
        The error in one line. Empty if all went well.
    """
    from kerv_cli.episodes.runner import Runner
    from kerv_cli.lab.work import checked, failure_of
    from kerv_cli.report.viewing import save_recording

    try:
        runner = Runner(checked(setting, [task], results).on(task), task)
        for seed in seeds[:-1]:
            runner.episode(seed)
        save_recording(runner.episode(seeds[-1], recorded=True), path, setting.label)
    except Exception as error:  # noqa: BLE001 - the page shows it, whatever it is
        return failure_of(error).reason
    return ""
