"""No process of a command outlives it, however it ends."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import until

DEMOS = """
import sys, time
from joblib import delayed, Parallel, parallel_config
from kerv_cli.worlds.demos import recording
def sleep(*arguments):
    open(sys.argv[1], "a").write(f"{__import__('os').getpid()}\\n")
    time.sleep(60)
class Config:
    workers = 2
recording._record_seeds = sleep
list(recording._run_jobs(Config, None, [("a", range(1)), ("b", range(1))], None))
"""
IMPORT = """
import os, sys, time
os.kill(os.getpid(), int(sys.argv[1]))
time.sleep(0.3)
print("loaded", flush=True)
"""
FINALISER = """
import os, sys
class Handle:
    def __del__(self):
        os.kill(os.getpid(), int(sys.argv[1]))
        print("not here", flush=True)
def use():
    Handle()
    print("loaded", flush=True)
"""
COMMAND = """
import signal, sys, time
import kerv_cli.__main__ as kerv
import kerv_cli.cli.app

def run():
    try:
        import library
        getattr(library, "use", int)()
        time.sleep(60)
    except KeyboardInterrupt:
        print("cleared", flush=True)

kerv_cli.cli.app.app = run
kerv.main()
"""


def ended(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
def test_workers_that_record_end_with_a_killed_command(tmp_path):
    """One that is stopped, too, and what else the command has started."""
    path = tmp_path / "pids"
    with subprocess.Popen([sys.executable, "-c", DEMOS, str(path)]) as process:
        until(lambda: path.exists() and len(path.read_text().split()) == 2, 120)
        found = [int(pid) for pid in path.read_text().split()]
        found += map(int, Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split())
        os.kill(found[0], signal.SIGSTOP)
        process.kill()
    until(lambda: all(map(ended, found)), 5)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("library", [IMPORT, FINALISER])
def test_an_interrupt_waits_for_code_that_cannot_raise(library, number, tmp_path):
    (tmp_path / "library.py").write_text(library)
    run = subprocess.run(
        [sys.executable, "-c", COMMAND, str(number.value)], capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    )  # fmt: skip
    assert (run.returncode, run.stdout) == (0, "loaded\ncleared\n"), run.stderr
