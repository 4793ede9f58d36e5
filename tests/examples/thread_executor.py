"""Example: an executor of your own: threads of this process."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kerv_cli.base.registry import add


@dataclass
class ThreadOptions:
    """`runtime.executor_options` of threads."""

    name: str = "kerv"  # prefix of the threads' names


class Threads:
    """See `kerv_cli.lab.executors.Executor`."""

    def __init__(self, slots: int, name: str) -> None:
        self.slots = slots
        self._pool = ThreadPoolExecutor(slots, thread_name_prefix=name)

    def submit(self, work: Any, /) -> Future[Any]:
        return self._pool.submit(work)

    def close(self, abandon: bool) -> None:
        self._pool.shutdown(wait=True, cancel_futures=abandon)


def build(options: ThreadOptions, slots: int, threads: int, folder: Path) -> Threads:
    return Threads(slots, options.name)


add("executor", "threads", f"{__name__}:build", ThreadOptions)
