"""The `kerv` command, also `python -m kerv_cli`. Ctrl-C is handled before anything is imported."""

import os
import signal
import sys
import threading
from types import FrameType


def main() -> None:
    """Run the `kerv` script. SIGTERM, from schedulers and `timeout`, is Ctrl-C to every command."""
    # one that is ignored stays so: a job in the background of a shell, or behind nohup
    ours = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) is not signal.SIG_IGN]
    for number in ours:
        signal.signal(number, _end)
    from kerv_cli.cli.app import app

    for number in ours:
        signal.signal(number, _interrupt)
    sys.unraisablehook = _unraisable
    app()


def _end(number: int, frame: FrameType | None) -> None:
    """End the process while it loads. An exception could surface anywhere in the middle of an import."""
    os.write(2, b"kerv: interrupted\n")
    os._exit(130)


_UNSAFE = ("<frozen importlib", f"{os.sep}sqlalchemy{os.sep}pool{os.sep}")
"""Parts of file names whose code must not be interrupted. In the middle of an import, C++ code that runs Python while
it loads would abort the process. SQLAlchemy's pool prints the traceback of an exception that interrupts it."""


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt. Inside code that is unsafe to interrupt, ask again a little later instead."""
    while frame is not None:
        if any(part in frame.f_code.co_filename for part in _UNSAFE):
            _ask_again(number)
            return
        frame = frame.f_back
    sys.unraisablehook = _unraisable_at_the_end
    raise KeyboardInterrupt


def _unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    """Ask again for an interrupt that reached code which cannot raise, such as a finaliser or a library's callback."""
    if unraisable.exc_type is KeyboardInterrupt:
        _ask_again(signal.SIGTERM if signal.getsignal(signal.SIGINT) is signal.SIG_IGN else signal.SIGINT)
    else:
        sys.__unraisablehook__(unraisable)


def _unraisable_at_the_end(unraisable: "sys.UnraisableHookArgs") -> None:
    """Ignore libraries' half-made objects that fail to clean up after Ctrl-C."""
    if unraisable.exc_type is KeyboardInterrupt:
        _unraisable(unraisable)


def _ask_again(number: int) -> None:
    # to the main thread: where it waits for an answer, a signal to another one would not wake it
    timer = threading.Timer(0.05, signal.pthread_kill, (threading.main_thread().ident, number))
    timer.daemon = True
    timer.start()


if __name__ == "__main__":
    main()
