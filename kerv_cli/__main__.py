"""Entry point of the command `kerv` and of `python -m kerv_cli`. Ctrl-C is handled before anything is imported."""

import os
import signal
import sys
from types import FrameType
from typing import NoReturn


def main() -> None:
    """Run the command `kerv`. SIGTERM, which schedulers and `timeout` send, has the same effect as Ctrl-C."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # the shell has closed it (`>&-`)
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - it stays open
    for number in (signal.SIGINT, signal.SIGTERM):
        # a signal that is ignored stays ignored: nohup, or a shell's job in the background
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)
    sys.unraisablehook = _unraisable
    from kerv_cli.cli.app import program

    program.main()


_is_interrupted = False


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt. On a second interrupt, end at once: the database rolls back, and locks are free.

    Also end at once while a module is loading: C++ code may be running it, and an exception would abort the process.
    """
    global _is_interrupted
    while frame is not None and not _is_interrupted:
        _is_interrupted = frame.f_code.co_name == "_load_unlocked"  # of importlib
        frame = frame.f_back
    if _is_interrupted:
        _end()
    _is_interrupted = True
    raise KeyboardInterrupt


def _end() -> NoReturn:
    os.write(2, b"kerv: interrupted\n")
    os._exit(130)


def _unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    """End if Ctrl-C came where Python cannot raise it: in a finaliser, or in a library's callback."""
    if unraisable.exc_type is KeyboardInterrupt:
        _end()
    sys.__unraisablehook__(unraisable)


if __name__ == "__main__":
    main()
