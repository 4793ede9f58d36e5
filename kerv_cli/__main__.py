"""The `kerv` command, also `python -m kerv_cli`: nothing is imported before Ctrl-C has its answer."""

import os
import signal
from types import FrameType


def main() -> None:
    """Entry point of the `kerv` script. SIGTERM (schedulers, `timeout`) is Ctrl-C to every command."""
    # one that is ignored stays so: a job in the background of a shell, or behind nohup
    ours = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) is not signal.SIG_IGN]
    for number in ours:
        signal.signal(number, _end)
    from kerv_cli.cli.app import main as run

    for number in ours:
        signal.signal(number, signal.default_int_handler)
    run()


def _end(number: int, frame: FrameType | None) -> None:
    """Ends the process while it only loads: an exception could surface anywhere in the middle of an import."""
    os.write(2, b"kerv: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    main()
