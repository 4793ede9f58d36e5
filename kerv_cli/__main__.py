"""Entry point of the command `kerv` and of `python -m kerv_cli`. Ctrl-C is handled before anything is imported."""

import os
import signal
import sys
import time
from types import FrameType


def main() -> None:
    """Run the command `kerv`. SIGTERM, which schedulers and `timeout` send, has the same effect as Ctrl-C."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # the shell has closed it (`>&-`)
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - it stays open
    # a signal that is ignored stays ignored: nohup, or a shell's job in the background
    ours = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) is not signal.SIG_IGN]
    for number in ours:
        signal.signal(number, _end)
    from kerv_cli.cli.app import app

    for number in ours:
        signal.signal(number, _interrupt)
    sys.unraisablehook = _unraisable
    app()


def _end(number: int, frame: FrameType | None) -> None:
    """Handle a signal while modules are loading: end at once, because an exception inside an import could do harm."""
    os.write(2, b"kerv: interrupted\n")
    os._exit(130)


_UNSAFE = ("<frozen importlib", f"{os.sep}sqlalchemy{os.sep}", f"{os.sep}contextlib.py")
"""Code in files with these parts in their names must not be interrupted. An exception during an import can abort the
process, if C++ code is running Python. An exception in SQLAlchemy, or between a context manager's `yield` and the
`with` block, can leave a transaction open. Then this process itself keeps the database locked."""
_WAIT_SECONDS = 3.0
"""Longest wait for code that must not be interrupted, in seconds. The import that compiles kernels takes longer."""
_deadline = 0.0
"""Time of `time.monotonic` after which a signal ends code that must not be interrupted. 0 if no signal waits."""


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt. If the running code must not be interrupted, send the signal again a little later.

    If that code goes on for too long, end the process at once. The database then shows the command as interrupted.
    """
    global _deadline
    while frame is not None:
        if any(part in frame.f_code.co_filename for part in _UNSAFE):
            _deadline = _deadline or time.monotonic() + _WAIT_SECONDS
            if time.monotonic() > _deadline:
                _end(number, frame)
            _ask_again(number)
            return
        frame = frame.f_back
    sys.unraisablehook = _unraisable_at_the_end
    raise KeyboardInterrupt


def _unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    """Send Ctrl-C again if Python lost it, because it arrived in a finaliser or in a library's callback.

    This replaces `sys.unraisablehook`, which gets every exception that cannot be raised.
    """
    if unraisable.exc_type is KeyboardInterrupt:
        _ask_again(signal.SIGTERM if signal.getsignal(signal.SIGINT) is signal.SIG_IGN else signal.SIGINT)
    else:
        sys.__unraisablehook__(unraisable)


def _unraisable_at_the_end(unraisable: "sys.UnraisableHookArgs") -> None:
    """Hide exceptions of objects that Ctrl-C left half-built. If one of them is Ctrl-C itself, send it again."""
    if unraisable.exc_type is KeyboardInterrupt:
        _unraisable(unraisable)


def _ask_again(number: int) -> None:
    """Send a signal again a few milliseconds later.

    The kernel's timer sends the signal. A thread could send it only while the main thread waits in C code. The main
    thread always waits in the same few places, so the signal could come at a bad moment each time.
    """
    signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(number))
    signal.setitimer(signal.ITIMER_REAL, 0.005)


if __name__ == "__main__":
    main()
