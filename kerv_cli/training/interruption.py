"""Ctrl-C, or the end of a job's time, while training: the current step is finished before the state is stored."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SAME_REQUEST = 2.0
"""Seconds after a signal in which another one of its kind is a repetition and no second request."""


@contextmanager
def until_interrupted() -> Iterator[threading.Event]:
    """Yields an event that the first SIGINT or SIGTERM sets (schedulers and `timeout` send the latter); a second one of
    the same kind raises KeyboardInterrupt at once. One that follows within seconds is the same request: schedulers pass
    on a signal that the process has received already. Outside the main thread no signal sets it, and a
    signal that is ignored stays ignored."""
    stop = threading.Event()
    first_times: dict[int, float] = {}
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def handle(number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if now - first_times.setdefault(number, now) > SAME_REQUEST:
            raise KeyboardInterrupt
        if stop.is_set():
            return
        stop.set()
        again = "Ctrl-C again" if number == signal.SIGINT else "a second one"
        print(f"stopping after this step; {again} stops at once and keeps the last saved state", file=sys.stderr)

    # a job in the background of a shell, or behind nohup, ignores SIGINT
    signals = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handle) for number in signals}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
