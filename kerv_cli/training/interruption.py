"""Ctrl-C while training: the step that runs is finished, so that the state that is stored is a whole one."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Stop:
    """Whether the user asked to stop."""

    def __init__(self) -> None:
        self.requested = False


@contextmanager
def until_interrupted() -> Iterator[Stop]:
    """Yields a Stop that the first SIGINT sets; the second one raises KeyboardInterrupt at once. Outside the main
    thread, and where SIGINT is ignored, it stays unset."""
    stop = Stop()
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN  # a job in the background of a shell, nohup
    if ignored or threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def caught(number: int, frame: FrameType | None) -> None:
        if stop.requested:
            raise KeyboardInterrupt
        stop.requested = True
        print("stopping after this step; Ctrl-C again stops at once and keeps the last saved state", file=sys.stderr)

    before = signal.signal(signal.SIGINT, caught)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)
