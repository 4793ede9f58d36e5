"""Ctrl-C, or the end of a job's time, during a training: the current step is finished before the state is stored."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SAME_REQUEST = 2.0
"""Seconds in which a second signal is the same request: schedulers pass on what the process has received already."""


@contextmanager
def until_interrupted() -> Iterator[threading.Event]:
    """Yield an event that the first SIGINT or SIGTERM sets; a later one of the same kind raises KeyboardInterrupt.

    Outside the main thread nothing sets it. A signal that is ignored stays ignored.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    first_times: dict[int, float] = {}

    def handle(number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if now - first_times.setdefault(number, now) > SAME_REQUEST:
            raise KeyboardInterrupt
        if not stop.is_set():
            again = "Ctrl-C again" if number == signal.SIGINT else "a second one"
            print(f"stopping after this step; {again} stops at once and keeps the last saved state", file=sys.stderr)
        stop.set()

    # a shell's background job and nohup ignore SIGINT
    signals = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handle) for number in signals}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
